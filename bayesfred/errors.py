"""The exception for input that a user can correct, and the warning of a result that says little.

The command line prints the exception and exits with 2. And what ends it as a Ctrl-C does.
"""

import signal

# Windows has no hang-up
ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


def printable(text: str) -> str:
    r"""Escape what a terminal cannot print: control characters, line ends and undecodable bytes.

    Parameters
    ----------
    text : str

    Returns
    -------
    str

    Examples
    --------
    >>> print(printable("two\nlines\x1b[31m"))
    two\nlines\x1b[31m
    """
    if text.isprintable():  # images in pages are long
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


class InputError(ValueError):
    """Bad input: one printable line says what was got, what was expected and what to do.

    Parameters
    ----------
    text : str
        Characters that a terminal cannot print are escaped.
    """

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


class ExtrapolationWarning(UserWarning):
    """Points are beyond the sources: only the terms of the distortion say what happens there."""
