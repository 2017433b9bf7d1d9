"""`bayesfred` and `python -m bayesfred`: the command line, which a Ctrl-C ends at any time.

It may come while modules are imported, which takes seconds the first time, and between callbacks of
Python's own that let no exception through.
"""

import gc
import signal
import sys
from _thread import interrupt_main
from threading import Timer
from types import FrameType
from typing import Any

from bayesfred.errors import ENDINGS

SOON = 0.01  # seconds: until then the callback is over


def main() -> None:
    """Run the command line."""
    sys.unraisablehook = _again
    handled = [
        number
        for number in (signal.SIGINT, *ENDINGS)
        if signal.getsignal(number) is not signal.SIG_IGN  # as by nohup
    ]
    for number in handled:
        signal.signal(number, _end)
    gc.disable()  # until all is imported: nothing of it is garbage
    try:
        from bayesfred.cli import app  # noqa: PLC0415 - where Ctrl-C is known already

        app()
    finally:
        for number in handled:  # what there was to do is done
            signal.signal(number, signal.SIG_IGN)


def _end(number: int, frame: FrameType | None) -> None:
    """End before a command has begun; commands have a handler of their own."""
    sys.stderr.write("bayesfred: interrupted\n")
    sys.exit(130)


def _again(lost: Any, otherwise: Any = sys.unraisablehook) -> None:
    """Interrupt again where a callback has swallowed an interrupt."""
    if issubclass(lost.exc_type, (KeyboardInterrupt, SystemExit)):
        Timer(SOON, interrupt_main).start()
    else:
        otherwise(lost)


if __name__ == "__main__":
    main()
