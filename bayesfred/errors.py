"""The one exception for input that a user can correct.

The command line turns it into one line and exit code 2.
"""


def printable(text: str) -> str:
    r"""Text with its control characters, line ends and undecodable bytes escaped.

    Examples
    --------
    >>> print(printable("two\nlines\x1b[31m"))
    two\nlines\x1b[31m
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


class InputError(ValueError):
    """Bad input: one printable line that says what was got, what was expected and what to do.

    Parameters
    ----------
    text : str
        Characters that no terminal prints are escaped.
    """

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))
