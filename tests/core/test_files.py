"""Files are whole or not there, and folders belong to one job."""

import errno
import os
import pathlib
import stat

import numpy as np
import pytest

from radejax.core import files
from radejax.core.errors import DataError, UserError


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    files.write_json(path, {"x": 1})
    with pytest.raises(RuntimeError), files.atomic_path(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert files.read_json(path) == {"x": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_replaced_whole_from_within(tmp_path, monkeypatch):
    # A mounted folder is on another disk than its parent, which may be read-only.
    monkeypatch.chdir(tmp_path)
    with files.swapped_in(".", "old*") as folder:
        (folder / "a").write_text("1")
        (tmp_path / "old.txt").touch()
        assert folder.parent.samefile(tmp_path)
    with pytest.raises(RuntimeError), files.swapped_in("new") as folder:  # noqa: PT012
        (folder / "b").touch()
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.skipif(not pathlib.Path("/dev/full").exists(), reason="only on Linux")
def test_a_short_write_of_numpy_is_a_full_disk(tmp_path):
    """NumPy raises an OSError without an error number."""
    with (
        pytest.raises(UserError, match="no space left on the disk of"),
        files.atomic_path(tmp_path / "a.npy"),
        open("/dev/full", "wb") as file,
    ):
        np.save(file, np.zeros(100_000))
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="Input/output"), files.disk_full("x/a.json"):
        raise OSError(errno.EIO, "Input/output error")


def test_temporary_paths_differ_in_one_process(tmp_path):
    # Two containers may have equal host names and process ids.
    paths = {files.temporary_path(tmp_path / "a.npy") for _ in range(100)}
    assert len(paths) == 100


def test_damaged_json_is_named(tmp_path):
    (tmp_path / "a.json").write_text('{"x": ')
    with pytest.raises(DataError, match=r"a\.json is not valid JSON"):
        files.read_json(tmp_path / "a.json")


def test_files_have_the_mode_that_the_umask_says(tmp_path):
    for umask, mode in ((0o022, 0o644), (0o002, 0o664), (0o077, 0o600)):
        before = os.umask(umask)
        try:
            files.write_json(tmp_path / "a.json", {})
        finally:
            os.umask(before)
        assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == mode


def test_a_folder_is_one_jobs(tmp_path):
    path = tmp_path / "new" / "plan.json"
    plan = {"a": {"b": (1, 2), "long": list(range(90))}, "seed": 0, "watch": 1}
    files.claim(path, plan, "another job")
    assert files.read_json(path)["a"]["b"] == [1, 2]
    changed = {**plan, "watch": 2, "a": {**plan["a"], "b": 3}}
    files.claim(path, changed, "another job", ignore=("watch", "a.b"))
    other = {"a": {"b": (1, 3), "long": []}, "watch": 1}
    text = r"new holds another job: a\.b is \[1, 2\] there and \[1, 3\] here; "
    text += r"a\.long differs; seed is 0 there and None here; give --out"
    with pytest.raises(UserError, match=text):
        files.claim(path, other, "another job", fix="give --out")


def test_files_are_found_through_links_once(tmp_path):
    root, disk = tmp_path / "root", tmp_path / "disk"
    for name in ("5/a.npy", "5/b.txt", "5/deep/c.npy"):
        (disk / name).parent.mkdir(parents=True, exist_ok=True)
        (disk / name).touch()
    root.mkdir()
    (root / "5").symlink_to(disk / "5")
    (root / "again").symlink_to(disk / "5")
    (disk / "5" / "loop").symlink_to(root)
    assert files.find_files(root, "*.npy") == [root / "5/a.npy", root / "5/deep/c.npy"]
    assert len(files.find_files(root, "*.npy", "*.txt")) == 3
    with pytest.raises(FileNotFoundError):
        files.find_files(tmp_path / "none", "*")


def test_the_home_folder_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    files.write_json("~/new/a.json", [1])
    assert files.read_json("~/new/a.json") == [1]
    assert (tmp_path / "new/a.json").is_file()
    assert files.as_path("a/~/b") == pathlib.Path("a/~/b")
    with pytest.raises(UserError, match="~no_such_user/x: there is no home folder"):
        files.as_path("~no_such_user/x")
