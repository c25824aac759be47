"""The one exception that the command line shows to its user without a traceback."""


class UserError(Exception):
    """A mistake the user can mend: the message says what, where and how. `python -m train` exits with code
    2."""
