"""Errors caused by users and by files.

Command line programs print every `ValueError` with an `exit_code` as one line without a
traceback. They exit with 2 for wrong use, and with 1 for a corrupted file or a full disk.
"""

_LONGEST = 2000


def one_line(error: BaseException | str) -> str:
    """Returns the message of another library's error on one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]


class _OneLine(ValueError):
    """A `ValueError` whose message is one line and is cut after `_LONGEST` characters."""

    def __init__(self, message: object = "") -> None:
        text = str(message).replace("\n", " ")
        super().__init__(text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ...")


class UserError(_OneLine):
    """Raised for a wrong argument, config field or folder, or a wrong combination of them."""

    exit_code = 2


class DiskFullError(UserError):
    """Raised if no space is left on the disk.

    The exit code is 1, because the command itself was correct.
    """

    exit_code = 1


class DataError(_OneLine):
    """Raised for an incomplete, malformed or corrupted file, which the message names."""

    exit_code = 1


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Raises `UserError` unless a setting is in its range.

    Args:
        holds: Whether the value is in its range.
        name: Name of the setting for users, such as "config.train.batch_size".
        value: Value of the setting.
        expected: Description of the range, such as "an integer of at least 1".

    Example:
        >>> require(2 >= 1, "config.train.batch_size", 2, "an integer of at least 1")
    """
    if not holds:
        raise UserError(f"{name} is {value!r}, expected {expected}")
