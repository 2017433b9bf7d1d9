"""Progress on standard error: a live display in a terminal, a line now and then elsewhere.

In a notebook, a pipe, a dumb terminal, or where NO_COLOR asks for plain text, nothing is redrawn:
a run of more than half a minute prints a line every half minute, a shorter one nothing.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

__all__ = ["progress_bar", "working"]

SEARCHING = "searching for the maximum (the first run on a machine compiles: half a minute)"

INTERVAL = 30.0  # seconds between lines


@contextmanager
def working(
    what: str = SEARCHING,
    *,
    show: bool = True,
    console: Console | None = None,
    interval: float = INTERVAL,
) -> Iterator[None]:
    """Says, within its `with` block, what is being done, and for how long.

    Parameters
    ----------
    what : str
    show : bool
        Whether anything is shown at all.
    console : Console, optional
        Where it is shown; by default on standard error.
    interval : float, seconds
        Between the lines that are printed where nothing is redrawn.
    """
    console = console or _standard_error()
    if show and _live(console):
        columns = (SpinnerColumn(), TextColumn(what), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as display:
            display.add_task("", total=None)
            yield
    elif show:
        begun, ended = time.monotonic(), Event()

        def tell() -> None:
            while not ended.wait(interval):
                line = f"{what}: {time.monotonic() - begun:.0f} s"
                console.print(line, markup=False, highlight=False, soft_wrap=True)

        teller = Thread(target=tell, name="bayesfred-wait", daemon=True)
        teller.start()
        try:
            yield
        finally:
            ended.set()
            teller.join()
    else:
        yield


@contextmanager
def progress_bar(
    label: str,
    *,
    show: bool = True,
    console: Console | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[float, float | None, str], None]]:
    """A function that is told how much is done, how much there is to do, and the state in words.

    Parameters
    ----------
    label : str
        What is being done.
    show : bool
        Whether anything is shown at all.
    console : Console, optional
        Where it is shown; by default on standard error.
    clock : callable
        Returns the time in seconds.

    Yields
    ------
    callable
        Takes what is done, the total, None while it is not known, and the state.

    Examples
    --------
    >>> with progress_bar("sampling", show=False) as update:
    ...     update(3, 10, "3 steps")
    """
    console = console or _standard_error()
    live = show and _live(console)
    bar = Progress(
        TextColumn(label), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=not live,
    )  # fmt: skip
    told = clock()
    with bar:
        task = bar.add_task("", total=None, state="")

        def update(done: float, total: float | None, state: str) -> None:
            nonlocal told
            if live:
                bar.update(task, completed=done, total=total, state=state)
            elif show and clock() - told >= INTERVAL:
                told = clock()
                line = f"{label}: {state}" + (f", {done / total:.0%}" if total else "")
                console.print(line, markup=False, highlight=False, soft_wrap=True)

        yield update


def _standard_error() -> Console:
    # rich would show widgets in a notebook, or warn at every redraw that it cannot
    return Console(stderr=True, force_jupyter=False)


def _live(console: Console) -> bool:
    return console.is_terminal and not console.is_dumb_terminal and not console.no_color
