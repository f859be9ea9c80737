"""Worker processes: their number, their start, Ctrl-C, and ends that are not their own."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from radejax.core import workers
from radejax.core.errors import DataError, UserError
from radejax.core.workers import default_workers, process_pool, usable_cpus


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_is_started_once_survives_ctrl_c_and_errors_and_ends(tmp_path):
    with process_pool(1, os.chdir, tmp_path) as submit:
        pid = submit(os.getpid).result()
        submit(signal.raise_signal, signal.SIGINT).result()
        assert submit(os.getpid).result() == pid != os.getpid()
        assert submit(pathlib.Path.cwd).result() == tmp_path
        with pytest.raises(DataError, match="line 3"):
            submit(exec, "raise error", {"error": DataError("line 3")}).result()
        assert submit(os.getpid).result() == pid
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


def test_a_worker_that_is_killed_or_cannot_start_is_one_line(tmp_path):
    def dies(start_folder):
        with process_pool(2, os.chdir, start_folder) as submit:
            submit(signal.raise_signal, signal.SIGKILL).result()

    for start_folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UserError, match=r"process ended early.*fewer workers"):
            dies(start_folder)


@pytest.mark.parametrize("first_line", ["end_rerun()", "pass"])
def test_a_script_without_a_guard_names_what_it_lacks(tmp_path, first_line):
    """Once: the workers, which run the script again, have no tracebacks."""
    script = tmp_path / "script.py"
    script.write_text(
        "import os\n"
        "from radejax.core.workers import end_rerun, process_pool\n"
        f"{first_line}\n"
        "print('begun')\n"
        "with process_pool(2, os.chdir, '.') as submit:\n"
        "    [submit(os.getpid) for _ in range(3)][0].result()\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stdout == "begun\n" or first_line == "pass"
    assert done.stderr.count("Traceback") == 1
    assert "UserError: a worker process ended early" in done.stderr.splitlines()[-1]
    assert '`if __name__ == "__main__":`' in done.stderr.splitlines()[-1]


# Numbers of CPUs and workers -------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity here")
def test_cpus_are_those_of_the_affinity():
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert usable_cpus() == default_workers() == 1
    finally:
        os.sched_setaffinity(0, before)


CONTAINER = {
    "proc/self/cgroup": "2:memory:/job\n0::/job/step\n",
    "groups/job/step/cpu.max": "max 100000\n",
}
MEMORY = {"proc/meminfo": "MemTotal:  9000000 kB\nMemAvailable:  7200000 kB\n"}
MEMORY_OF_VERSION_2 = MEMORY | {"proc/self/cgroup": "0::/job\n"}


@pytest.mark.parametrize(
    ("texts", "num_cpus", "num_workers"),
    [
        ({}, 64, 64),
        # A limit in the group of the process or in one above it, of either version.
        (CONTAINER | {"groups/job/cpu.max": "300000 100000\n"}, 3, 3),
        # Each worker needs 450 MB of a half of the memory.
        (MEMORY, 64, 8),
        (MEMORY_OF_VERSION_2 | {"groups/job/memory.max": "100000000\n"}, 64, 1),
    ],
)
def test_workers_fit_into_the_cpus_and_the_memory(
    texts, num_cpus, num_workers, tmp_path, monkeypatch
):
    """A machine of 64 CPUs with these files of its kernel."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    monkeypatch.setattr(workers, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(workers, "_CONTROL_GROUPS", tmp_path / "groups")
    for name, text in texts.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert (usable_cpus(), default_workers()) == (num_cpus, num_workers)
