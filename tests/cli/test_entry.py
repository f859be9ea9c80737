"""One line and an exit code for the user's errors; a traceback for ours."""

import errno
import os
import subprocess
import sys

import click
import pytest

from radejax.cli import entry
from radejax.core.errors import DataError, DiskFullError, UserError

READ_ONLY = OSError(errno.EROFS, "Read-only file system", "/cdrom/records")
FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UserError("no such field"), 2, "no such field"),
        (DataError("a.txt:3: half a line"), 1, "a.txt:3: half a line"),
        (FileNotFoundError(errno.ENOENT, "No such file", "/x"), 2, "No such file: /x"),
        (PermissionError(errno.EACCES, "denied", "/root"), 2, "denied: /root"),
        (READ_ONLY, 2, "Read-only file system: /cdrom/records; name another place (--"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (FULL, 1, "[Errno 28] No space left on device"),
        (DiskFullError("no space left"), 1, "no space left"),
    ],
)
def test_user_errors_end_in_one_line(error, code, text, capsys):
    with pytest.raises(SystemExit) as ended, entry.exit_codes():
        raise error
    assert ended.value.code == code
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    assert written.startswith(f"error: {text}")


def test_defects_keep_their_traceback():
    with pytest.raises(KeyError), entry.exit_codes():
        raise KeyError("ours")
    with pytest.raises(OSError, match="gone"), entry.exit_codes():
        raise OSError(errno.EIO, "gone")


def test_an_accelerator_that_is_not_there_is_one_line():
    command = [sys.executable, "-m", "radejax", "demo", "--out", "demo.png"]
    environment = {**os.environ, "JAX_PLATFORMS": "cuda"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == entry.WRONG_USE
    assert done.stderr.startswith("error: JAX_PLATFORMS is 'cuda', and JAX cannot use")
    assert done.stderr.count("\n") == 1


def test_home_folders_in_arguments(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    given = ["--data=~/a,~/b,/c~", "~", "--config.data.roots=('~/a',)", "a~/b", "x=~me"]
    wanted = ["--data=/home/me/a,/home/me/b,/c~", "/home/me"]
    wanted += ["--config.data.roots=('/home/me/a',)", "a~/b", "x=~me"]
    assert entry.expand_home(given) == wanted


def test_numbers_of_options_are_finite_and_in_their_range():
    command = click.Command("x", params=[click.Option(["--y"], type=entry.FRACTION)])
    for text in ("nan", "inf", "-0.1", "30"):
        with pytest.raises(click.BadParameter):
            command.make_context("x", ["--y", text])
    assert command.make_context("x", ["--y", "0.5"]).params == {"y": 0.5}
