"""One line and an exit code for the user's errors; a traceback for ours."""

import errno

import pytest

from radejax import entry
from radejax.errors import DataError, UserError


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UserError("no such field"), 2, "error: no such field\n"),
        (DataError("a.txt:3: half a line"), 1, "error: a.txt:3: half a line\n"),
        (
            FileNotFoundError(errno.ENOENT, "No such file", "/nowhere"),
            2,
            "error: no such file or folder: /nowhere\n",
        ),
        (FileNotFoundError("no run in x"), 2, "error: no run in x\n"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, None),
    ],
)
def test_user_errors_end_in_one_line(
    error: Exception, code: int, text: str | None, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as ended, entry.exit_codes():
        raise error
    assert ended.value.code == code
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    assert text is None or written == text


def test_defects_keep_their_traceback() -> None:
    with pytest.raises(KeyError), entry.exit_codes():
        raise KeyError("ours")
    with pytest.raises(OSError, match="gone"), entry.exit_codes():
        raise OSError(errno.EIO, "gone")


def test_debug_lets_the_traceback_through() -> None:
    with pytest.raises(UserError), entry.exit_codes(debug=True):
        raise UserError("wrong")
