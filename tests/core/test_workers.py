"""Worker processes: their start, Ctrl-C, and ends that are not their own."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from radejax.core.errors import DataError, UserError
from radejax.core.workers import process_pool


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_is_started_once_leaves_ctrl_c_alone_and_ends(tmp_path):
    with process_pool(1, os.chdir, tmp_path) as submit:
        pid = submit(os.getpid).result()
        submit(signal.raise_signal, signal.SIGINT).result()
        assert submit(os.getpid).result() == pid != os.getpid()
        assert submit(pathlib.Path.cwd).result() == tmp_path
    assert not is_running(pid)


def test_an_error_beside_the_work_ends_the_workers(tmp_path):
    waiting = []

    def fails():
        with process_pool(1, os.chdir, tmp_path) as submit:
            waiting.extend(submit(time.sleep, 60) for _ in range(50))
            raise ValueError("beside")

    start = time.monotonic()
    with pytest.raises(ValueError, match="beside"):
        fails()
    assert all(future.done() for future in waiting)
    assert time.monotonic() - start < 30


def test_a_killed_worker_is_one_line(tmp_path):
    def dies():
        with process_pool(2, os.chdir, tmp_path) as submit:
            submit(signal.raise_signal, signal.SIGKILL).result()

    with pytest.raises(UserError, match=r"a worker process ended early.*fewer workers"):
        dies()


def test_errors_of_a_worker_are_raised_here(tmp_path):
    with process_pool(1, os.chdir, tmp_path) as submit:
        with pytest.raises(DataError, match="line 3"):
            submit(exec, "raise error", {"error": DataError("line 3")}).result()
        assert submit(os.getpid).result() != os.getpid()  # it continues to work


def test_a_start_that_fails_is_one_line(tmp_path):
    def fails():
        with process_pool(1, os.chdir, tmp_path / "nowhere") as submit:
            submit(os.getpid).result()

    with pytest.raises(UserError, match="a worker process ended early"):
        fails()


def test_a_script_without_a_guard_names_what_it_lacks(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os\n"
        "from radejax.core.workers import process_pool\n"
        "with process_pool(1, os.chdir, '.') as submit:\n"
        "    submit(os.getpid).result()\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "UserError: a worker process ended early" in done.stderr.splitlines()[-1]
    assert '`if __name__ == "__main__":`' in done.stderr.splitlines()[-1]
