"""Errors that are the user's to mend, told apart from defects of the program.

Command line programs turn both into one line without a traceback: exit code 2 for
`UserError` (wrong use), 1 for `DataError` (a file is not what it should be).
"""


class UserError(ValueError):
    """A wrong argument, config field, folder or combination of them."""


class DataError(ValueError):
    """A file that is missing parts, malformed or damaged; the message names it."""
