"""One line and an exit code for the user's errors; a traceback for ours."""

import errno
import json
import os
import pathlib
import socket
import subprocess
import sys

import jax
import pytest

from radejax.cli import entry
from radejax.core.errors import DataError, DiskFullError, UserError
from radejax.geometry.calibration import CalibrationError, CalibrationFileError


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UserError("no such field"), 2, "error: no such field\n"),
        (
            CalibrationFileError("cam_1.yml: lacks k3"),
            1,
            "error: cam_1.yml: lacks k3\n",
        ),
        (CalibrationError("image must be raw"), 2, "error: image must be raw\n"),
        (DataError("a.txt:3: half a line"), 1, "error: a.txt:3: half a line\n"),
        (
            FileNotFoundError(errno.ENOENT, "No such file", "/nowhere"),
            2,
            "error: no such file or folder: /nowhere\n",
        ),
        (FileNotFoundError("no run in x"), 2, "error: no run in x\n"),
        (
            PermissionError(errno.EACCES, "Permission denied", "/root/x"),
            2,
            "error: Permission denied: /root/x\n",
        ),
        (
            IsADirectoryError(errno.EISDIR, "Is a directory", "/tmp"),
            2,
            "error: Is a directory: /tmp\n",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), 1, None),
        (DiskFullError("no space left"), 1, "error: no space left\n"),
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


REPOSITORY = pathlib.Path(__file__).resolve().parents[2]


def test_a_coordinator_that_is_not_reached_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def initialize(*_: object) -> None:
        raise RuntimeError("DEADLINE_EXCEEDED: Barrier timed out.\nmuch more")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    with pytest.raises(
        UserError, match=r"cannot join the processes at h:1: DEADLINE.*timed out\.$"
    ):
        entry.join_processes("h:1", 2, 1)


def test_a_port_that_is_taken_is_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=rf"cannot listen on port {port} .*in use"):
            entry.join_processes(f"127.0.0.1:{port}", 2, 0)
    with pytest.raises(UserError, match="must be HOST:PORT, got 1234"):
        entry.join_processes("1234", 2, 0)


def test_processes_without_a_coordinator_are_wrong_use(tmp_path: pathlib.Path) -> None:
    command = [sys.executable, "train.py", "--config=configs/quickstart.py:short"]
    command += [f"--workdir={tmp_path / 'run'}", "--num_processes=2", "--process_id=1"]
    ended = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == entry.WRONG_USE
    assert "--num_processes and --process_id together" in ended.stderr
    assert not (tmp_path / "run").exists()


def test_words_are_repeated_or_with_commas() -> None:
    assert entry.words(["a, b", "c", ""]) == ("a", "b", "c")


def test_a_second_folder_without_its_flag_is_wrong_use(tmp_path: pathlib.Path) -> None:
    command = [sys.executable, "train.py", "--config=configs/quickstart.py:short"]
    command += [f"--workdir={tmp_path / 'run'}", "--data", "disk1", "disk2"]
    ended = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == entry.WRONG_USE
    assert ended.stderr == (
        "error: unexpected arguments: disk2; several folders are --data A,B or "
        "--data A --data B\n"
    )
    assert not (tmp_path / "run").exists()


def test_train_takes_a_part_of_the_data(tmp_path: pathlib.Path) -> None:
    command = [sys.executable, "train.py", "--config=configs/radenet.py"]
    command += [f"--data={tmp_path}", f"--workdir={tmp_path / 'run'}"]
    for words, message in (
        (["--sequences=1,x"], "error: --sequences: 'x' is no number, expected 1,5,58"),
        (["--weather=fog", "--weather=mist"], "config.data.weather is ('fog', 'mist')"),
        (["--sequences=1,58", "--weather=fog", "--weather=rain"], "no sequence"),
    ):
        ended = subprocess.run(
            [*command, *words],
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            timeout=120,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
        )
        assert ended.returncode == entry.WRONG_USE
        assert message in ended.stderr
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["data"]["sequences"] == [1, 58]
    assert config["data"]["weather"] == ["fog", "rain"]
