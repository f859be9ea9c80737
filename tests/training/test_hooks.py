"""Hooks of the training loop, and the loop itself with a step that is not compiled."""

import itertools
import json
from types import SimpleNamespace
from unittest import mock

import jax.numpy as jnp
import pytest

from radejax.config import Config
from radejax.core.errors import UserError
from radejax.training import hooks, loop
from radejax.training.metric_writer import MetricWriter


def _step(state, batch):
    after = SimpleNamespace(step=state.step + 1, seen=[*state.seen, batch])
    return after, {"loss": jnp.float32(batch)}


def test_hooks_are_called_in_order_after_each_step():
    calls = []

    def named(name):
        return lambda step, state, metrics: calls.append((name, step, state.seen[-1]))

    called = [named("a"), hooks.every(5, 2, named("b")), hooks.every(5, 0, named("c"))]
    state = SimpleNamespace(step=1, seen=[])
    state = loop.train(state, _step, itertools.count(7), called, num_steps=5)
    assert (state.step, state.seen) == (5, [7, 8, 9, 10])
    a, b = ([c[1:] for c in calls if c[0] == name] for name in "ab")
    assert a == [(2, 7), (3, 8), (4, 9), (5, 10)]
    assert b == [(2, 7), (4, 9), (5, 10)]
    assert calls[:2] == [("a", 2, 7), ("b", 2, 7)]


def test_the_loop_stops_between_steps_of_which_two_are_under_way(monkeypatch):
    wait = mock.Mock()
    monkeypatch.setattr(loop.jax, "block_until_ready", wait)
    should_stop = mock.Mock(side_effect=[False] * 5 + [True])
    state, batches = SimpleNamespace(step=0, seen=[]), itertools.count()
    options = {"num_steps": 9, "should_stop": should_stop}
    state = loop.train(state, _step, batches, [], **options)
    assert state.seen == [0, 1, 2, 3, 4]
    # From the third step on, for that two steps before.
    assert [call.args[0]["loss"] for call in wait.call_args_list] == [0, 1, 2]


def test_values_that_an_own_hook_returns_are_logged(tmp_path):
    def own(step, *_):
        return {3: {"norm": 2.5}, 4: "text"}.get(step)

    with MetricWriter(tmp_path, Config(), 0) as writer:
        hook = hooks.logged(own, writer)
        for step in (2, 3):
            hook(step, None, {})
        message = r"of own in config\.train\.hooks is 'text'"
        with pytest.raises(UserError, match=message):
            hook(4, None, {})
    row = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert (row["step"], row["norm"]) == (3, 2.5)


@pytest.fixture
def wait(monkeypatch):
    """Function that sets the hooks' clock forward, which moves by 1 ns per look at it."""
    now = 0.0

    def go_on(seconds=1e-9):
        nonlocal now
        now += seconds
        return now

    monkeypatch.setattr(hooks, "time", SimpleNamespace(perf_counter=go_on))
    return go_on


def _batches(wait, *seconds):
    """Batches that take some seconds to read."""
    return (SimpleNamespace(frame=wait(x)) for x in seconds)


def test_waiting_for_data_is_warned_of_once(wait, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(hooks, "usable_cpus", lambda: 7)
    config = Config()
    throughput = hooks.Throughput(_batches(wait, 0.0, 0.2, 0.2), 0)
    bar = hooks.ProgressBar(0, 10)
    with MetricWriter(tmp_path, config, 0) as writer:
        log = hooks.Log(config, 10, throughput, writer, bar)
        for step in (1, 2, 3):
            next(throughput)
            wait(0.1)  # training
            metrics = {"focal": jnp.float32(1).block_until_ready()}
            for hook in (throughput, bar, log):
                hook(step, None, metrics)
            assert len(caplog.records) == min(step - 1, 1)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    first, row, _ = map(json.loads, lines)
    assert list(first) == ["step", "minutes", "focal", "learning_rate", "epoch"]
    assert (row["step"], row["focal"], row["epoch"], bar.n) == (2, 1.0, 0.2, 3)
    assert row["frames_per_s"] == pytest.approx(10 / 0.3)
    assert row["data_wait_share"] == pytest.approx(2 / 3)
    assert caplog.text.count("training waits for data for 67 %") == 1
    assert "raise config.data.num_threads (7 threads" in caplog.text
    assert "on 7 CPUs" in caplog.text
