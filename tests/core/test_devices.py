"""Meshes, placements, processes and signals; tests/test_two_processes.py trains in two."""

import os
import signal
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from radejax.core import devices
from radejax.core.errors import UserError

from .. import processes


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes this process one of two; returns what happens between them, in order."""
    events: list[str] = []

    def wait(*_: Any, **__: Any) -> None:
        events.append("wait")

    def become(index: int, *, main_is_fine: bool = True) -> list[str]:
        def gather(value: np.ndarray) -> np.ndarray:
            events.append("gather")
            return np.stack([value if index == 0 else np.int32(main_is_fine), value])

        monkeypatch.setattr(jax, "process_count", lambda: 2)
        monkeypatch.setattr(jax, "process_index", lambda: index)
        client = SimpleNamespace(wait_at_barrier=wait)
        monkeypatch.setattr(devices.jax_distributed.global_state, "client", client)
        monkeypatch.setattr(devices.multihost_utils, "process_allgather", gather)
        return events

    return become


def test_the_others_wait_while_the_main_process_works(two: Any) -> None:
    events = two(0)
    assert devices.main_only(lambda: events.append("work") or 5) == 5
    assert events == ["work", "wait", "gather"]
    events.clear()
    two(1)
    assert devices.main_only(lambda: events.append("work")) is None
    assert events == ["wait", "gather"]


def test_an_error_of_the_main_process_reaches_the_others(two: Any) -> None:
    def fail() -> None:
        raise OSError("broken")

    events = two(0)
    with pytest.raises(OSError, match="broken"):
        devices.main_only(fail)
    assert events == ["wait", "gather"]
    two(1, main_is_fine=False)
    with pytest.raises(UserError, match="process 0 stopped with an error"):
        devices.main_only(fail)


# Two processes ask each other until one of them is killed or fails.
TALK = (
    processes.JOIN
    + """
with devices.end_with_others():
    print("ready", flush=True)
    while devices.all_agree(sys.argv[1] == "nobody fails"):
        pass
    if index == 1:
        raise OSError("a defect")
    devices.all_agree(True)
"""
)


@pytest.mark.parametrize("victim", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_killed_process_ends_the_other_in_one_line(victim: int) -> None:
    started = processes.start(2, "-c", TALK, "nobody fails")
    processes.wait_for("ready", started)
    started[victim].kill()
    output = processes.outputs_of(started, timeout_s=30)[1 - victim]
    assert started[1 - victim].returncode == 1
    assert output.splitlines().count(processes.lost(victim)) == 1
    assert "Traceback" not in output


def test_a_process_that_fails_ends_the_other() -> None:
    started = processes.start(2, "-c", TALK, "one fails")
    outputs = processes.outputs_of(started, timeout_s=60)
    assert [process.returncode for process in started] == [1, 1]
    line = processes.lost(1).replace(
        "was lost", "stopped with an error, see its output"
    )
    assert line in outputs[0].splitlines()
    assert "Traceback" not in outputs[0]
    assert outputs[1].splitlines()[-1] == "OSError: a defect"


@pytest.fixture
def stop() -> Iterator[Any]:
    mesh = devices.make_mesh(1)
    with devices.stop_on_signal(mesh) as should_stop:
        yield should_stop


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGUSR1"])
def test_signals_ask_to_stop(stop: Any, name: str) -> None:
    assert not stop()
    os.kill(os.getpid(), signal.Signals[name])
    assert stop()


def test_the_second_signal_of_a_closed_terminal_is_ignored_and_that_of_a_user_is_not(
    stop: Any,
) -> None:
    # The shell and the kernel both send SIGHUP when a terminal is closed.
    for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGUSR1):
        os.kill(os.getpid(), number)
    assert stop()
    with pytest.raises(KeyboardInterrupt, match="second SIGTERM"):
        os.kill(os.getpid(), signal.SIGTERM)


def test_under_nohup_a_closed_terminal_is_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with devices.stop_on_signal(devices.make_mesh(1)) as should_stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not should_stop()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_put_batch_splits_the_leading_axis() -> None:
    mesh = devices.make_mesh(4)
    batch = {"x": np.arange(24.0).reshape(8, 3), "i": np.arange(8)}
    placed = devices.put_batch(batch, mesh)
    chex.assert_trees_all_equal(placed, batch)
    assert [s.data.shape for s in placed["x"].addressable_shards] == [(2, 3)] * 4


def test_fsdp_splits_the_widest_axis_that_divides() -> None:
    mesh = devices.make_mesh(4)
    state = {
        "kernel": jax.ShapeDtypeStruct((3, 3, 128, 256), jnp.float32),
        "bias": jax.ShapeDtypeStruct((256,), jnp.float32),
        "odd": jax.ShapeDtypeStruct((333, 333), jnp.float32),
    }
    placed = devices.state_sharding(state, mesh, "fsdp")
    assert placed["kernel"].spec == PartitionSpec(None, None, None, "data")
    assert placed["bias"].spec == placed["odd"].spec == PartitionSpec()
    whole = devices.state_sharding(state, mesh, "replicated")
    assert {s.spec for s in whole.values()} == {PartitionSpec()}
