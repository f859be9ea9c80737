"""One line and an exit code for the user's errors; a traceback for ours."""

import errno
import os
import subprocess
import sys

import click
import jax
import pytest

from radejax.cli import entry
from radejax.cli.train import join_processes
from radejax.core.errors import DataError, DiskFullError, UserError

READ_ONLY = OSError(errno.EROFS, "Read-only file system", "/cdrom/records")
FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UserError("no such field"), 2, "no such field"),
        (DataError("a.txt:3: half a line"), 1, "a.txt:3: half a line"),
        (FileNotFoundError(errno.ENOENT, "No such file", "/x"), 2, "No such file: /x"),
        (FileNotFoundError("no run in x"), 2, "no run in x"),
        (PermissionError(errno.EACCES, "denied", "/root"), 2, "denied: /root"),
        (FileExistsError(errno.EEXIST, "File exists", "/x"), 2, "File exists: /x"),
        (IsADirectoryError(errno.EISDIR, "a directory", "/x"), 2, "a directory: /x"),
        (READ_ONLY, 2, "Read-only file system: /cdrom/records; name another place (--"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (KeyboardInterrupt("second SIGINT"), 130, "interrupted (second SIGINT)"),
        (FULL, 1, "[Errno 28] No space left on device"),
        (DiskFullError("no space left"), 1, "no space left"),
    ],
)
def test_user_errors_end_in_one_line(
    error: BaseException, code: int, text: str, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as ended, entry.exit_codes():
        raise error
    assert ended.value.code == code
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    assert written.startswith(f"error: {text}")


def test_closed_standard_error_says_nothing_and_keeps_the_exit_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def work() -> None:
        sys.stderr.write("progress")
        raise UserError("wrong")

    monkeypatch.setattr(sys, "stderr", None)  # as Python has it for 2>&-
    with pytest.raises(SystemExit) as ended, entry.exit_codes():
        work()
    assert ended.value.code == entry.WRONG_USE
    sys.stderr.close()


def test_defects_keep_their_traceback() -> None:
    with pytest.raises(KeyError), entry.exit_codes():
        raise KeyError("ours")
    with pytest.raises(OSError, match="gone"), entry.exit_codes():
        raise OSError(errno.EIO, "gone")


def test_a_coordinator_that_is_not_reached_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def initialize(*_: object) -> None:
        raise RuntimeError("DEADLINE_EXCEEDED: Barrier timed out.\nmuch more")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    with pytest.raises(
        UserError, match=r"cannot join the other processes \(DEADLINE.*"
    ):
        join_processes("h:1", 2, 1)


def test_an_accelerator_that_is_not_there_is_one_line() -> None:
    command = [sys.executable, "-m", "radejax", "demo", "--out", "demo.png"]
    environment = {**os.environ, "JAX_PLATFORMS": "cuda"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == entry.WRONG_USE
    assert done.stderr.startswith(
        "error: JAX_PLATFORMS is 'cuda', and JAX cannot use it"
    )
    assert done.stderr.count("\n") == 1


def test_home_folders_in_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    given = ["--data=~/a,~/b,/c~", "~", "--config.data.roots=('~/a',)", "a~/b", "x=~me"]
    wanted = ["--data=/home/me/a,/home/me/b,/c~", "/home/me"]
    wanted += ["--config.data.roots=('/home/me/a',)", "a~/b", "x=~me"]
    assert entry.expand_home(given) == wanted


def test_numbers_of_options_are_finite_and_in_their_range() -> None:
    command = click.Command("x", params=[click.Option(["--y"], type=entry.FRACTION)])
    for text in ("nan", "inf", "-0.1", "30"):
        with pytest.raises(click.BadParameter):
            command.make_context("x", ["--y", text])
    assert command.make_context("x", ["--y", "0.5"]).params == {"y": 0.5}
