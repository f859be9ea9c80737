"""Meshes, placements, processes and signals; tests/test_two_processes.py trains in two."""

import os
import signal

import pytest

from radejax.core import devices

from .. import processes

# Two processes ask each other until one of them is killed or fails.
TALK = (
    processes.JOIN
    + """
import pathlib
import time

from radejax.core.errors import UserError

def write():
    time.sleep(0.3)
    pathlib.Path(sys.argv[1]).write_text("written")

def fail():
    raise OSError("no data")

with devices.end_with_others():
    devices.main_only(write)
    assert pathlib.Path(sys.argv[1]).read_text() == "written"  # the others have waited
    try:
        devices.main_only(fail)
    except (OSError, UserError) as error:
        print(type(error).__name__, error, flush=True)
    print("ready", flush=True)
    while devices.all_agree(sys.argv[2] == "nobody fails"):
        pass
    if index == 1:
        raise OSError("a defect")
    devices.all_agree(True)
"""
)


@pytest.mark.parametrize("victim", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_killed_process_ends_the_other_in_one_line(victim, tmp_path):
    path = str(tmp_path / "a.txt")
    started = processes.start(2, "-c", TALK, path, "nobody fails")
    processes.wait_for("ready", started)
    started[victim].kill()
    output = processes.outputs_of(started, timeout_s=30)[1 - victim]
    assert started[1 - victim].returncode == 1
    assert output.splitlines().count(processes.lost(victim)) == 1
    assert "Traceback" not in output


def test_a_process_that_fails_ends_the_other(tmp_path):
    path = str(tmp_path / "a.txt")
    started = processes.start(2, "-c", TALK, path, "one fails")
    outputs = processes.outputs_of(started, timeout_s=60)
    assert [process.returncode for process in started] == [1, 1]
    assert "OSError no data" in outputs[0].splitlines()
    reason = "stopped with an error, see its output"
    assert f"UserError process 0 {reason}" in outputs[1].splitlines()
    assert processes.lost(1).replace("was lost", reason) in outputs[0].splitlines()
    assert "Traceback" not in outputs[0]
    assert outputs[1].splitlines()[-1] == "OSError: a defect"


@pytest.fixture
def stop():
    mesh = devices.make_mesh(1)
    with devices.stop_on_signal(mesh) as should_stop:
        yield should_stop


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGUSR1"])
def test_signals_ask_to_stop(stop, name):
    assert not stop()
    os.kill(os.getpid(), signal.Signals[name])
    assert stop()


def test_only_the_second_signal_of_a_closed_terminal_is_ignored(stop):
    # The shell and the kernel both send SIGHUP when a terminal is closed.
    for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGUSR1):
        os.kill(os.getpid(), number)
    assert stop()
    with pytest.raises(KeyboardInterrupt, match="second SIGTERM"):
        os.kill(os.getpid(), signal.SIGTERM)


def test_under_nohup_a_closed_terminal_is_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with devices.stop_on_signal(devices.make_mesh(1)) as should_stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not should_stop()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
