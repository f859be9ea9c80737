"""Errors that are the user's to mend, told apart from defects of the program.

Command line programs turn every `ValueError` with an `exit_code` into one line without a
traceback: 2 for wrong use, 1 for a file that is not what it should be and a full disk.
"""

_LONGEST = 2000


def one_line(error: BaseException | str) -> str:
    """What an error of another library says, as a message of ours quotes it."""
    return " ".join(str(error).split())[:200]


class _OneLine(ValueError):
    """Whatever a message quotes, it is one line and not endless."""

    def __init__(self, message: object = "") -> None:
        text = str(message).replace("\n", " ")
        super().__init__(text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ...")


class UserError(_OneLine):
    """A wrong argument, config field, folder or combination of them."""

    exit_code = 2


class DiskFullError(UserError):
    """No space is left: exit code 1, as the command itself was right."""

    exit_code = 1


class DataError(_OneLine):
    """A file that is missing parts, malformed or damaged; the message names it."""

    exit_code = 1


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Raises `UserError` unless a setting is in its range.

    The constructors of what config sections configure check their fields with it.

    Args:
        holds: Whether the value is in its range.
        name: Field as a user knows it, such as "config.train.batch_size".
        value: What it is.
        expected: The range, such as "an integer of at least 1".

    Example:
        >>> require(2 >= 1, "config.train.batch_size", 2, "an integer of at least 1")
    """
    if not holds:
        raise UserError(f"{name} is {value!r}, expected {expected}")
