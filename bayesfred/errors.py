"""The one exception for input that a user can mend; the command line turns it into one line and exit code 2."""


class InputError(ValueError):
    """Bad input: the text is one line that says what was got, what was expected and what to do."""
