"""Worker processes: their start, Ctrl-C, and ends that are not their own."""

import os
import pathlib
import signal
import time

import pytest

from radejax.core.errors import UserError
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
