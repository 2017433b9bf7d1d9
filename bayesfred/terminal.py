"""A command's work in a terminal: what is asked for first, signals, exit codes."""

import gc
import io
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import typer

import bayesfred as bf
from bayesfred.errors import ENDINGS, InputError
from bayesfred.io.reading import require_file


def say_to(as_json: bool) -> Callable[[str], None]:
    """Where lines go that are told while a command works."""
    return partial(typer.echo, err=True) if as_json else print


def run(work: Callable[[], bool], *files: Path) -> None:
    """Do a command's work, which says whether all is well, and turn the outcome into exit codes.

    Files that it needs are asked for first: to import what works takes seconds.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack characters of a path
            stream.reconfigure(errors="backslashreplace")
    before = {  # all end as a Ctrl-C does; what is ignored, as by nohup, stays so
        number: signal.signal(number, signal.default_int_handler)
        for number in (signal.SIGINT, *ENDINGS)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        for file in files:
            require_file(file)
        from bayesfred.sampling.progress import working  # noqa: PLC0415 - this takes time, too

        with working("loading"):
            _ = bf.commands, bf.show
        if not gc.isenabled():  # it rests from the program's first line on
            gc.freeze()  # what is imported is never looked through again
            gc.enable()
        well = work()
    except InputError as error:
        typer.echo(f"bayesfred: {error}", err=True)
        raise typer.Exit(2) from None
    except KeyboardInterrupt as stop:
        kept = "; ".join(getattr(stop, "__notes__", []))
        typer.echo(f"bayesfred: interrupted; {kept or 'nothing had to be saved'}", err=True)
        raise typer.Exit(130) from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if not well:
        raise typer.Exit(3)
