"""Worker processes: their start, Ctrl-C, and ends that are not their own."""

import os
import pathlib
import pickle
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


def test_an_error_beside_the_work_ends_what_waits(tmp_path):
    waiting = []

    def fails():
        with process_pool(1, os.chdir, tmp_path) as submit:
            waiting.extend(submit(time.sleep, 0.2) for _ in range(50))
            raise ValueError("beside")

    with pytest.raises(ValueError, match="beside"):
        fails()
    assert waiting[-1].cancelled()


def test_a_killed_worker_is_one_line(tmp_path):
    def dies():
        with process_pool(2, os.chdir, tmp_path) as submit:
            submit(signal.raise_signal, signal.SIGKILL).result()

    with pytest.raises(UserError, match=r"a worker process was killed.*fewer workers"):
        dies()


_KILLED_AMID_ITS_RESULT = """
import os, signal
from multiprocessing.connection import Connection

def send_half(self, message, write=None):
    os.write(self._handle, message[: len(message) // 2])
    signal.raise_signal(signal.SIGKILL)

Connection._send = send_half
"""


def test_a_worker_killed_amid_its_result_is_one_line(tmp_path):
    def dies():
        with process_pool(2, os.chdir, tmp_path) as submit:
            submit(exec, _KILLED_AMID_ITS_RESULT, {}).result()

    with pytest.raises(UserError, match="a worker process was killed"):
        dies()


def test_other_workers_finish_when_one_is_killed(tmp_path):
    with process_pool(2, os.chdir, tmp_path) as submit:
        slow = submit(eval, "__import__('time').sleep(0.5) or 'finished'")
        with pytest.raises(UserError, match="a worker process was killed"):
            submit(signal.raise_signal, signal.SIGKILL).result()
        assert slow.result() == "finished"


_NO_PICKLE_CARRIES = """
error = ValueError("of a lambda")
error.function = lambda: None
raise error
"""


def test_errors_of_a_worker_say_where_they_were_raised(tmp_path):
    with process_pool(1, os.chdir, tmp_path) as submit:
        with pytest.raises(DataError, match="line 3") as raised:
            submit(exec, "raise error", {"error": DataError("line 3")}).result()
        assert 'File "<string>", line 1' in raised.value.__notes__[0]
        with pytest.raises(RuntimeError, match="ValueError: of a lambda"):
            submit(exec, _NO_PICKLE_CARRIES, {}).result()
        with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
            submit(lambda: None).result()
        with pytest.raises(SystemExit):
            submit(sys.exit, 1).result()
        assert submit(os.getpid).result() != os.getpid()  # goes on


def test_an_error_of_the_start_is_that_of_the_work(tmp_path):
    with process_pool(1, os.chdir, tmp_path / "nowhere") as submit:
        for _ in range(2):
            with pytest.raises(FileNotFoundError, match="nowhere"):
                submit(os.getpid).result()


def test_a_script_without_a_guard_is_told_what_it_lacks(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os\n"
        "from radejax.core.workers import process_pool\n"
        "with process_pool(1, os.chdir, '.') as submit:\n"
        "    submit(os.getpid).result()\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "UserError: no worker process could start" in done.stderr.splitlines()[-1]
    assert '`if __name__ == "__main__":`' in done.stderr.splitlines()[-1]
