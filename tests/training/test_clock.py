"""Traces of steps: written, or said not to be."""

import pathlib

import jax.numpy as jnp
import pytest

from radejax.training.clock import Trace


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
