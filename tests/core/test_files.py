"""Files are whole or not there."""

import errno
import pathlib

import pytest

from radejax.core import files
from radejax.core.errors import DataError, UserError


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "a.json"
    files.write_json(path, {"x": 1})
    with pytest.raises(RuntimeError), files.atomic_path(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert files.read_json(path) == {"x": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_is_one_clear_error(tmp_path: pathlib.Path) -> None:
    with (
        pytest.raises(UserError, match="no space left on the disk of"),
        files.atomic_path(tmp_path / "a.json"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_damaged_json_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "a.json").write_text('{"x": ')
    with pytest.raises(DataError, match=r"a\.json is not valid JSON"):
        files.read_json(tmp_path / "a.json")
