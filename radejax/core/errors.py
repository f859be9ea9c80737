"""Errors that are the user's to mend, told apart from defects of the program.

Command line programs turn every `ValueError` with an `exit_code` into one line without a
traceback: 2 for wrong use, 1 for a file that is not what it should be and a full disk.
"""


class UserError(ValueError):
    """A wrong argument, config field, folder or combination of them."""

    exit_code = 2


class DiskFullError(UserError):
    """No space is left: exit code 1, as the command itself was right."""

    exit_code = 1


class DataError(ValueError):
    """A file that is missing parts, malformed or damaged; the message names it."""

    exit_code = 1
