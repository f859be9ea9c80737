"""Errors that are the user's to mend, told apart from defects of the program.

Command line programs turn them into one line without a traceback: exit code 2 for
`UserError` (wrong use), 1 for `DataError` (a file is not what it should be) and
`DiskFullError`.
"""


class UserError(ValueError):
    """A wrong argument, config field, folder or combination of them."""


class DiskFullError(UserError):
    """No space is left: exit code 1, as the command itself was right."""


class DataError(ValueError):
    """A file that is missing parts, malformed or damaged; the message names it."""
