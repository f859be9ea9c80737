"""Times by part, and traces of steps: written, or said not to be."""

import pathlib
import time
from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from radejax.training.clock import StepClock, Trace


def test_waiting_behind_busy_devices_is_no_waiting_for_data() -> None:
    clock = StepClock()
    for is_ready in (True, False):
        with clock.timing(
            "data", behind=[SimpleNamespace(is_ready=lambda r=is_ready: r)]
        ):
            time.sleep(0.01 if is_ready else 0.03)
    with clock.timing("other"):
        time.sleep(0.1)
    time.sleep(0.02)
    seconds = clock.take()
    assert seconds["compute"] > seconds["data"] >= 0.01
    assert 0.02 <= seconds["host"] < 0.1
    assert sum(clock.take().values()) < 0.01


def _trace(folder: pathlib.Path, first: int, last: int, steps: int) -> None:
    trace = Trace(str(folder), first, last)
    for _ in range(steps):
        trace.before_step()
        trace.after_step(jnp.zeros(1))
    trace.close()


def test_a_trace_that_was_never_begun_is_said(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    _trace(tmp_path / "none", 5, 7, steps=4)
    assert "none: this start took 4 steps" in caplog.text
    assert "begins at step 5" in caplog.text
    assert not (tmp_path / "none").exists()


def test_one_step_is_traced_without_a_word(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    _trace(tmp_path, 2, 2, steps=4)
    assert list(tmp_path.rglob("*.xplane.pb"))
    assert not caplog.text
