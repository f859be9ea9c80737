"""Training from start to end, interrupted, damaged, stopped."""

import dataclasses
import functools
import json
import os
import pathlib
import signal
from collections.abc import Iterator
from typing import Any

import chex
import flax.linen as nn
import grain
import jax
import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.models.layers import Dense
from radejax.training import loop, processes, sharding, start
from radejax.training.checkpoints import Checkpoints, abstract_state
from radejax.training.start import Plan
from radejax.training.watch import Scores

Tiny = Any  # the fixture `tiny` of conftest.py
STEPS_PER_EPOCH = 4


@pytest.fixture(scope="module", autouse=True)
def compiled_once() -> Iterator[None]:
    """Plans of one optimizer share it and their step, which JAX then traces once.

    Runs differ in what goes on around their steps, and tracing takes the longest.
    """
    optimizers, steps = {}, {}
    make_optimizer, make_step = Plan.optimizer, start.make_train_step
    fields = ("learning_rate", "final_learning_rate", "warmup_steps", "schedule")
    fields += ("weight_decay", "gradient_clip_norm")

    def optimizer(plan: Plan) -> Any:
        assert plan.options.schedule == "cosine"  # does not count epochs
        key = (plan.num_steps, *(plan.options[name] for name in fields))
        return optimizers.setdefault(key, make_optimizer(plan))

    def step(*parts: Any, **options: Any) -> Any:
        key = (*map(id, parts), repr(options))
        return steps.setdefault(key, make_step(*parts, **options))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plan, "optimizer", optimizer)
        patch.setattr(start, "make_train_step", step)
        yield


@pytest.fixture(scope="module")
def run(tiny: Tiny) -> Any:
    """`train` on the tiny data, on one device unless told otherwise."""

    def train(
        workdir: pathlib.Path, loader: Any = None, config: Any = None, **others: Any
    ) -> Any:
        config = tiny.config if config is None else config
        plan = Plan(
            options=config.train,
            loss=config.loss,
            watch=config.logging,
            seed=config.seed,
            info={"config": {"seed": 0}},
            steps_per_epoch=STEPS_PER_EPOCH,
        )
        names = {field.name for field in dataclasses.fields(plan)} & set(others)
        plan = dataclasses.replace(plan, **{name: others.pop(name) for name in names})
        return loop.train(
            tiny.model,
            tiny.variables,
            tiny.loader() if loader is None else loader,
            tiny.map_grid,
            workdir,
            plan,
            **({"mesh": sharding.make_mesh(1)} | others),
        )

    return train


@pytest.fixture(scope="module")
def undisturbed(run: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Result and folder of a run from start to end."""
    folder = tmp_path_factory.mktemp("undisturbed")
    return run(folder), folder


class Stopping(grain.DatasetIterator):
    """A loader that has something happen at its n-th batch from the start."""

    def __init__(self, loader: Any, at: int, what: Any) -> None:
        super().__init__()
        self._loader, self._at, self._what = loader, at, what
        self._count = 0

    def __next__(self) -> Any:
        self._count += 1
        if self._count == self._at:
            self._what()
        return next(self._loader)

    def get_state(self) -> Any:
        return self._loader.get_state()

    def set_state(self, state: Any) -> None:
        self._loader.set_state(state)


def _losses(folder: pathlib.Path) -> list[tuple[int, float]]:
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [(r["step"], r["focal"]) for r in map(json.loads, lines)]


def test_a_run_ends_after_its_epochs_and_learns(undisturbed: Any) -> None:
    result, folder = undisturbed
    assert result.finished
    assert result.step == int(result.state.step) == 8
    losses = _losses(folder)
    assert [step for step, _ in losses] == list(range(1, 9))
    assert losses[-1][1] < losses[0][1]


def test_two_runs_of_one_seed_are_equal_bit_for_bit(
    run: Any, undisturbed: Any, workdir: pathlib.Path
) -> None:
    again = run(workdir)
    chex.assert_trees_all_equal(again.state, undisturbed[0].state)
    assert _losses(workdir) == _losses(undisturbed[1])


class Layers(nn.Module):
    """A model of three layers, which fails where it is run and not only initialised."""

    @nn.compact
    def __call__(self, projection: jax.Array, train: bool) -> jax.Array:
        for features in (3, 4, 5):
            projection = Dense(features)(projection)
        return jax.pure_callback(lambda x: 1 / 0, projection, projection)


def test_a_seed_draws_its_variables(
    tiny: Tiny, tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    def drawn(seed: int) -> Any:
        plan = Plan(
            options=tiny.config.train,
            loss={},
            watch=tiny.config.logging,
            seed=seed,
            info={},
            steps_per_epoch=STEPS_PER_EPOCH,
        )
        init = start.initial(Layers(), None, tiny.loader(), plan.optimizer(), plan)
        with Checkpoints(tmp_path) as checkpoints:
            mesh = sharding.make_mesh(1)
            state, step = start.restore(checkpoints, tiny.loader(), init, mesh, plan)
        assert step == 0
        return state

    jax.clear_caches()  # an earlier test may have drawn with the same program
    with jax.log_compiles():
        first = drawn(0)
    # One for six shapes.
    assert caplog.text.count("Finished XLA compilation of jit(_uniform)") == 1
    chex.assert_trees_all_equal(first, drawn(0))
    kernels = [drawn(seed).params["Dense_0"]["kernel"] for seed in (0, 1)]
    assert np.abs(kernels[0] - kernels[1]).min() > 0


@pytest.mark.parametrize("batch", [2, pytest.param(6, marks=pytest.mark.slow)])
def test_a_crash_costs_the_steps_since_the_checkpoint_and_no_digit(
    batch: int, run: Any, tiny: Tiny, undisturbed: Any, workdir: pathlib.Path
) -> None:
    def crash() -> None:
        raise RuntimeError("power cut")

    # One batch is looked at for its shapes before the first step.
    with pytest.raises(RuntimeError, match="power cut"):
        run(workdir, Stopping(tiny.loader(), batch + 1, crash))
    again = run(workdir)
    chex.assert_trees_all_equal(again.state.params, undisturbed[0].state.params)
    assert _losses(workdir) == _losses(undisturbed[1])


def test_sigterm_saves_and_stops(
    run: Any, tiny: Tiny, undisturbed: Any, workdir: pathlib.Path
) -> None:
    terminate = functools.partial(os.kill, os.getpid(), signal.SIGTERM)
    stopped = run(workdir, Stopping(tiny.loader(), 6, terminate))
    assert not stopped.finished
    with Checkpoints(workdir / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps()[-1] == stopped.step == 5
    again = run(workdir)
    assert again.finished
    chex.assert_trees_all_equal(again.state.params, undisturbed[0].state.params)


def test_sigterm_in_an_evaluation_saves_and_stops(
    run: Any, tiny: Tiny, undisturbed: Any, workdir: pathlib.Path
) -> None:
    config = tiny.config.copy_and_resolve_references()
    config.train.evaluate_every_epochs = 1
    cut_at = []

    def evaluate(state: Any, step: int, should_stop: Any) -> Scores:
        assert not should_stop()
        if step not in cut_at:
            cut_at.append(step)
            os.kill(os.getpid(), signal.SIGTERM)
        if should_stop():
            raise processes.Stopped
        raise AssertionError("the signal was not told")

    def start() -> Any:
        return run(workdir, config=config, evaluate=evaluate)

    stopped = start()
    assert (stopped.step, stopped.finished) == (4, False)
    with Checkpoints(workdir / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps()[-1] == 4
    last = start()  # cut in the evaluation at the end
    assert (last.step, last.finished) == (8, False)
    again = start()
    assert again.finished
    chex.assert_trees_all_equal(again.state.params, undisturbed[0].state.params)


def test_a_run_continues_with_the_same_data_and_frozen_weights_only(
    run: Any, workdir: pathlib.Path
) -> None:
    same = {"frames to train on": 16, "sha256 of their keys": "ab"}
    first = run(workdir, info={"same": same})
    losses = _losses(workdir)
    with pytest.raises(
        UserError,
        match=r"something else: sha256 of their keys is 'ab' there and 'cd' here; give",
    ):
        run(workdir, info={"same": same | {"sha256 of their keys": "cd"}})
    assert _losses(workdir) == losses
    assert run(workdir, info={"same": same}).step == first.step


def test_no_more_than_two_steps_are_under_way(
    run: Any, workdir: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited = []
    wait = loop.jax.block_until_ready

    def spy(metrics: Any) -> Any:
        waited.append(metrics)
        return wait(metrics)

    monkeypatch.setattr(loop.jax, "block_until_ready", spy)
    run(workdir)
    # The first step's for its time, then that of two steps before, from the third on.
    steps = [waited[0], *waited]
    assert len(steps) == 8
    losses = [float(m["focal"]) for m in waited[1:]]
    assert losses == pytest.approx([v for _, v in _losses(workdir)][:6])


def test_a_damaged_newest_checkpoint_falls_back(
    run: Any,
    undisturbed: Any,
    workdir: pathlib.Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    result = run(workdir)
    newest = workdir / "checkpoints" / str(result.step)
    for path in (newest / "state").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    again = run(workdir)
    assert "checkpoint 8 does not restore" in caplog.text
    assert (workdir / "checkpoints_damaged" / "8").is_dir()
    chex.assert_trees_all_equal(again.state.params, undisturbed[0].state.params)


@pytest.mark.parametrize(
    ("first", "then"), [pytest.param(4, 1, marks=pytest.mark.slow), (1, 4)]
)
def test_a_state_comes_back_bit_for_bit_on_another_number_of_devices(
    first: int, then: int, undisturbed: Any, tmp_path: pathlib.Path, tiny: Tiny
) -> None:
    state = undisturbed[0].state

    def placed(count: int) -> Any:
        return sharding.state_sharding(state, sharding.make_mesh(count), "fsdp", 64)

    saved = jax.device_put(state, placed(first))
    assert first == 1 or any(
        not x.is_fully_replicated for x in jax.tree.leaves(saved.params)
    )
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(8, saved, tiny.loader(), info={})
        checkpoints.wait()
        wanted = abstract_state(state, placed(then))
        restored, _, _ = checkpoints.restore(wanted, tiny.loader())
    chex.assert_trees_all_equal(restored, state)
    assert jax.tree.leaves(restored)[0].sharding.device_set == set(jax.devices()[:then])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "then"), [pytest.param(4, 1, marks=pytest.mark.slow), (1, 4)]
)
def test_a_run_continues_on_another_number_of_devices(
    first: int,
    then: int,
    run: Any,
    tiny: Tiny,
    undisturbed: Any,
    workdir: pathlib.Path,
) -> None:
    def stop() -> None:
        raise RuntimeError("moved")

    with pytest.raises(RuntimeError, match="moved"):
        run(workdir, Stopping(tiny.loader(), 6, stop), mesh=sharding.make_mesh(first))
    again = run(workdir, mesh=sharding.make_mesh(then))
    assert again.finished
    losses, expected = _losses(workdir), _losses(undisturbed[1])
    np.testing.assert_allclose(
        [v for _, v in losses], [v for _, v in expected], rtol=0.05
    )


def test_steps_without_finite_loss_end_the_run_and_name_the_frames(
    run: Any, tiny: Tiny, workdir: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Poisoned(Stopping):
        def __next__(self) -> Any:
            batch = super().__next__()
            if self._count > self._at:
                return batch
            return batch.replace(projection=batch.projection * np.float16(np.nan))

    names = [f"7/frame{i}" for i in range(16)]
    # The row has ended when the next look is taken.
    rare = tiny.config.copy_and_resolve_references()
    rare.train.update(log_every_steps=8, checkpoint_every_steps=8)
    with pytest.raises(DataError, match=r"3 steps in a row .*batch: 7/frame\d+, "):
        run(
            workdir / "row",
            Poisoned(tiny.loader(), 4, lambda: None),
            frame_names=names,
            config=rare,
        )
    with pytest.raises(
        DataError, match=r"3 steps in a row .*batch: 7/frame\d+, 7/frame\d+, "
    ):
        run(workdir, Poisoned(tiny.loader(), 99, lambda: None), frame_names=names)
    assert "1 steps so far were skipped, as their loss" in caplog.text
    assert "frames of the last batch: 7/frame" in caplog.text


def test_evaluation_on_the_way_is_logged_and_the_best_kept(
    run: Any, tiny: Tiny, workdir: Any
) -> None:
    config = tiny.config.copy_and_resolve_references()
    config.train.update(evaluate_every_epochs=1, num_epochs=4, checkpoints_to_keep=1)
    seen = []

    def evaluate(state: Any, step: int, should_stop: Any) -> Scores:
        seen.append((step, int(state.step)))
        best = {2: 1.5, 4: 3.5, 6: 2.5, 8: 2.0}[step]
        picture = np.zeros((4, 6, 3), np.uint8)
        return Scores({"validation/ap_bev_iou30/exact": best}, best, {"a": picture})

    run(workdir, config=config, evaluate=evaluate, steps_per_epoch=2)
    assert seen == [(2, 2), (4, 4), (6, 6), (8, 8)]
    rows = map(json.loads, (workdir / "metrics.jsonl").read_text().splitlines())
    name = "validation/ap_bev_iou30/exact"
    assert [row[name] for row in rows if name in row] == [1.5, 3.5, 2.5, 2.0]
    with Checkpoints(workdir / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps() == [4, 8]
        assert checkpoints.best_step() == 4


@pytest.mark.slow
def test_times_of_a_step_are_split_and_a_trace_is_written(
    run: Any, workdir: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", logger="radejax"):
        run(workdir, trace_folder=str(workdir / "trace"))
    assert "first step" in caplog.text
    rows = [*map(json.loads, (workdir / "metrics.jsonl").read_text().splitlines())]
    for row in rows[1:]:
        parts = [row[f"{part}_ms_per_step"] for part in ("data", "compute", "host")]
        assert min(parts) >= 0
        np.testing.assert_allclose(sum(parts), 4e3 / row["frames_per_s"], rtol=1e-6)
    assert list((workdir / "trace").rglob("*.xplane.pb"))
