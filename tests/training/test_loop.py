"""Training from start to end, interrupted, corrupted, stopped."""

import functools
import json
import os
import re
import shutil
import signal

import chex
import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.traverse_util import flatten_dict
from matplotlib.figure import Figure

from radejax.core import devices
from radejax.core.errors import DataError, UserError
from radejax.runs import experiment
from radejax.training import loop
from radejax.training.checkpoints import Checkpoints
from radejax.training.metric_writer import Scores
from radejax.training.step import count_steps, create_state, make_schedule

STEPS_PER_EPOCH = 4


@pytest.fixture(scope="module", autouse=True)
def compiled_once():
    """Steps of equal options are the same function, which JAX traces once."""

    found = {}

    def once(make, key):
        def call(*parts, **options):
            name = make, key(*parts)
            return found.setdefault(name, (make(*parts, **options), parts))[0]

        return call

    # The tests change nothing else that a step depends on.
    keys = {
        "make_schedule": lambda train, n: (count_steps(train, n), train.learning_rate),
        "make_optimizer": lambda train, schedule: id(schedule),
        "make_train_step": lambda *parts: tuple(map(id, parts)),
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, key in keys.items():
            patch.setattr(experiment, name, once(getattr(experiment, name), key))
        yield


@pytest.fixture(scope="module")
def run(tiny):
    """`fit` on the tiny data."""
    return tiny.fit


SAME = {"frames to train on": 16, "sha256 of their keys": "ab"}


@pytest.fixture(scope="module")
def undisturbed(run, tmp_path_factory):
    """Result and folder of a run from start to end."""
    folder = tmp_path_factory.mktemp("undisturbed")
    return run(folder, info={"same": SAME}), folder


@pytest.fixture
def finished(undisturbed, workdir):
    """Copy of the folder of that run."""
    return shutil.copytree(undisturbed[1], workdir, dirs_exist_ok=True)


class Stopping(grain.DatasetIterator):
    """A loader that has something happen at its n-th batch from the start."""

    def __init__(self, loader, at, what):
        super().__init__()
        self._loader, self._at, self._what = loader, at, what
        self._count = 0

    def __next__(self):
        self._count += 1
        if self._count == self._at:
            self._what()
        return next(self._loader)

    def get_state(self):
        return self._loader.get_state()

    def set_state(self, state):
        self._loader.set_state(state)


def _losses(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [(r["step"], r["focal"]) for r in map(json.loads, lines)]


def check_equal(result, undisturbed):
    """A run that is finished has the state of the undisturbed one, bit for bit."""
    state, is_finished = result
    assert is_finished
    chex.assert_trees_all_equal(state, undisturbed[0][0])


def test_a_run_ends_after_its_epochs_and_learns(undisturbed):
    (state, is_finished), folder = undisturbed
    assert is_finished
    assert state.step == 8
    losses = _losses(folder)
    assert [step for step, _ in losses] == list(range(1, 9))
    assert losses[-1][1] < losses[0][1]


@pytest.mark.slow
def test_a_seed_initializes_the_variables(run, tiny, tmp_path):
    def initial(name, seed):
        rates = {"learning_rate": 1e-30, "final_learning_rate": 0.0}
        config = tiny.config.replace(seed=seed, train={"num_epochs": 1} | rates)
        options = {"steps_per_epoch": 1, "weights": None, "config": config}
        return run(tmp_path / name, **options)[0].params

    first = initial("a", 0)
    chex.assert_trees_all_equal(first, initial("b", 0))
    different = jax.tree.map(lambda x, y: bool((x != y).any()), first, initial("c", 1))
    assert any(jax.tree.leaves(different))


@pytest.mark.parametrize("batch", [2, pytest.param(6, marks=pytest.mark.slow)])
def test_a_crash_costs_the_steps_since_the_checkpoint_and_no_digit(
    batch, run, tiny, undisturbed, workdir
):
    def crash():
        raise RuntimeError("power cut")

    # One batch is looked at for its shapes before the first step. A crash before the first
    # checkpoint is a second run of one seed.
    with pytest.raises(RuntimeError, match="power cut"):
        run(workdir, Stopping(tiny.loader(), batch + 1, crash))
    check_equal(run(workdir), undisturbed)
    assert _losses(workdir) == _losses(undisturbed[1])


def test_sigterm_saves_and_stops(run, tiny, undisturbed, workdir):
    config = tiny.config.replace(train={"evaluate_every_epochs": 1})

    def evaluate(_, should_stop):
        assert not should_stop()
        os.kill(os.getpid(), signal.SIGTERM)
        if should_stop():
            raise devices.Stopped
        raise AssertionError("the signal was not seen")

    def start(*batches):
        return run(workdir, *batches, config=config, validate=evaluate)

    terminate = functools.partial(os.kill, os.getpid(), signal.SIGTERM)
    # While a batch is loaded, in an evaluation, and in the one at the end.
    interrupted = [(Stopping(tiny.loader(), 3, terminate),), (), ()]
    for step, batches in zip((2, 4, 8), interrupted, strict=True):
        state, is_finished = start(*batches)
        assert (int(state.step), is_finished) == (step, False)
        with Checkpoints(workdir / "checkpoints", read_only=True) as checkpoints:
            assert checkpoints.steps()[-1] == step
    check_equal(start(), undisturbed)


def test_a_run_continues_with_the_same_data_and_frozen_weights_only(
    run, undisturbed, finished
):
    message = r"something else: sha256 of their keys is 'ab' there and 'cd' here; give"
    with pytest.raises(UserError, match=message):
        run(finished, info={"same": SAME | {"sha256 of their keys": "cd"}})
    assert _losses(finished) == _losses(undisturbed[1])
    check_equal(run(finished, info={"same": SAME}), undisturbed)


@pytest.mark.slow
def test_frozen_parameters_are_saved_and_stay_as_they_were(run, tiny, workdir):
    def train(steps):
        changes = {"freeze": ("backbone/encoder_*",), "max_steps": steps}
        state = run(workdir, config=tiny.config.replace(train=changes))[0]
        return state

    train(3)
    whole = flatten_dict(dict(tiny.variables["params"]), sep="/")
    for state in (train(6), train(6)):  # from a checkpoint
        frozen = flatten_dict(dict(state.frozen), sep="/")
        assert frozen.keys() == {n for n in whole if n.startswith("backbone/encoder_")}
        for name, values in frozen.items():
            np.testing.assert_array_equal(values, whole[name])
        trained = flatten_dict(dict(state.params), sep="/")
        assert trained.keys() == whole.keys() - frozen.keys()
        assert all((trained[name] != whole[name]).any() for name in trained)


def test_a_corrupted_newest_checkpoint_falls_back(run, undisturbed, finished, caplog):
    for path in (finished / "checkpoints/8/state").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    check_equal(run(finished, info={"same": SAME}), undisturbed)
    assert "/checkpoints is corrupted" in caplog.text
    assert (finished / "checkpoints_corrupted" / "8").is_dir()


@pytest.mark.parametrize(
    ("first", "then"), [pytest.param(4, 1, marks=pytest.mark.slow), (1, 4)]
)
def test_a_state_comes_back_bit_for_bit_on_another_number_of_devices(
    first, then, undisturbed, tmp_path, tiny
):
    state = undisturbed[0][0]

    def placed(count):
        return devices.state_sharding(state, devices.make_mesh(count), "fsdp", 64)

    saved = jax.device_put(state, placed(first))
    is_whole = [x.is_fully_replicated for x in jax.tree.leaves(saved.params)]
    assert first == 1 or not all(is_whole)
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(8, saved, tiny.loader(), info={})
        checkpoints.wait()
        wanted = jax.tree.map(
            lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s),
            *(state, placed(then)),
        )
        restored, _, _ = checkpoints.restore(wanted, tiny.loader())
    chex.assert_trees_all_equal(restored, state)
    assert jax.tree.leaves(restored)[0].sharding.device_set == set(jax.devices()[:then])


def test_steps_without_finite_loss_are_named_and_end_the_run(
    run, tiny, workdir, caplog
):
    class Poisoned(Stopping):
        def __next__(self):
            batch = super().__next__()
            if self._count > self._at:
                return batch
            return batch.replace(projection=batch.projection * np.float16(np.nan))

    frames = ", ".join(f"1/{i:05d}" for i in next(tiny.loader()).frame)
    first = rf"step 1 has focal nan, .*gwd nan, .*; its frames are {frames}"
    message = rf"not finite in 3 steps in a row \(limit .*=2\): {first}\. Look at"
    with pytest.raises(DataError, match=message):
        run(workdir, Poisoned(tiny.loader(), 99, lambda: None))
    # The third one was not waited for when the next two were started.
    assert re.search(rf"skipped \(the first one\): {first}\n", caplog.text)
    assert "skipped (2 so far): step 2 has" in caplog.text
    # Two of them, after the batch that is looked at for its shapes.
    assert run(workdir / "few", Poisoned(tiny.loader(), 3, lambda: None))[1]
    rows = (workdir / "few" / "metrics.jsonl").read_text().splitlines()
    assert json.loads(rows[-1])["skipped"] == 2
    config = tiny.config.replace(train={"max_skipped_steps": 5})
    for _ in range(2):  # also if it continues from the checkpoint at its end
        loader = Poisoned(tiny.loader(), 6, lambda: None)
        with pytest.raises(DataError, match="5 of 8 steps were skipped because"):
            run(workdir / "most", loader, config=config)


def test_evaluation_on_the_way_is_logged_and_the_best_kept(run, tiny, workdir):
    """A run of a given number of steps, which is not a multiple of those of an epoch."""
    fields = {"evaluate_every_epochs": 1, "max_steps": 8, "checkpoints_to_keep": 1}
    config = tiny.config.replace(train=fields)
    values = iter((1.5, 3.5, 2.5))
    name = "validation/ap_bev_iou30/exact"

    def evaluate(_, should_stop):
        best = next(values)
        return Scores({name: best}, best, {"a": Figure()})

    options = {"config": config, "validate": evaluate, "steps_per_epoch": 3}
    state, is_finished = run(workdir, **options)
    assert (int(state.step), is_finished) == (8, True)
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    logged = [(row["step"], row[name]) for row in rows if name in row]
    assert logged == [(3, 1.5), (6, 3.5), (8, 2.5)]
    schedule = make_schedule(config.train, 3)
    rates = {row["step"]: row["learning_rate"] for row in rows if "focal" in row}
    assert rates == {step: pytest.approx(float(schedule(step - 1))) for step in rates}
    assert len(set(rates.values())) > 1
    with Checkpoints(workdir / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps() == [6, 8]
        assert checkpoints.best_step() == 6
    check_equal(run(workdir, **options), ((state, True), workdir))  # nothing is left


@pytest.mark.slow
def test_a_trace_is_written(run, workdir, caplog):
    run(workdir, profile=str(workdir / "trace"))
    assert list((workdir / "trace").rglob("*.xplane.pb"))
    run(workdir, profile=str(workdir / "none"))
    assert caplog.text.count("no trace: 0 steps are left") == 1


@pytest.mark.parametrize("setting", ["jax_debug_nans", "jax_disable_jit"])
def test_debugging_works(tiny, tmp_path, one_device, setting):
    """Operations that run one at a time transfer their arguments to the device.

    NaN is found in the second call too, after JAX turned the check off while it traced
    `logsumexp` in the first one.
    """

    def step(state, batch, _):
        mean = batch.projection.mean(dtype=jnp.float32)
        loss = jnp.log(mean) + jax.nn.logsumexp(state.params["w"])
        return state.replace(step=state.step + 1), {"loss": loss}

    jax.config.update(setting, True)
    try:
        with Checkpoints(tmp_path) as checkpoints:
            state = loop.restore_or_initialize(
                checkpoints,
                tiny.loader(),
                lambda: {"params": {"w": jnp.ones(2)}},
                lambda x: create_state(x, optax.sgd(0.1), use_ema=False),
                one_device,
                "replicated",
                {},
            )
        placed = loop.place_step(step, state, one_device, seed=0)
        state, _ = placed(state, tiny.frames)
        assert state.step == 1
        below_zero = tiny.frames.replace(projection=-tiny.frames.projection)
        if setting == "jax_debug_nans":
            with pytest.raises(FloatingPointError, match=r"\(nan\) encountered in log"):
                placed(state, below_zero)
        else:
            assert placed(state, below_zero)[0].step == 2
    finally:
        jax.config.update(setting, False)
