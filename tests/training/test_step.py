"""One step: what it changes, what it leaves, and that devices do not matter."""

import dataclasses
import math
import re
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from radejax.core.structures import DetectionMaps
from radejax.data.encoding import to_float
from radejax.detection.decode import decode
from radejax.geometry.boxes import boxes7_from_8
from radejax.geometry.rotated_iou import bev_iou
from radejax.training import sharding
from radejax.training.state import create_state, make_optimizer
from radejax.training.step import make_train_step, split_batch

RNG = jax.random.key(7)
COLLECTIVES = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
Tiny = Any  # the fixture `tiny` of conftest.py


@pytest.fixture(scope="module")
def start(tiny: Tiny) -> tuple[Any, Any]:
    """Optimizer and initial state."""
    optimizer = make_optimizer(lambda _: 3e-3, weight_decay=0.01)
    state = create_state(tiny.variables, optimizer, batch_size=4, use_ema=True)
    return optimizer, jax.tree.map(jnp.asarray, state)


@pytest.fixture(scope="module")
def step(tiny: Tiny, start: tuple[Any, Any]) -> Any:
    """Compiled step on one device."""
    return jax.jit(_make(tiny, start[0]))


def _make(tiny: Tiny, optimizer: Any, **options: Any) -> Any:
    options = {"loss": dict(tiny.config.loss), "ema_decay": 0.9} | options
    return make_train_step(tiny.model, optimizer, tiny.map_grid, **options)


def _batch(tiny: Tiny, count: int = 4) -> Any:
    return jax.tree.map(lambda x: x[:count], tiny.frames)


def test_steps_lower_the_loss(tiny: Tiny, start: Any, step: Any) -> None:
    state, batch, focal = start[1], _batch(tiny), []
    for _ in range(30):
        state, metrics = step(state, batch, RNG)
        focal.append(float(metrics["focal"]))
    assert focal[-1] < 0.35 * focal[0]
    assert int(state.step) == 30
    assert int(state.num_skipped) == 0


@pytest.mark.slow
def test_one_scene_is_learnt_by_heart(tiny: Tiny, start: Any, step: Any) -> None:
    state = start[1]
    batch = jax.tree.map(lambda x: np.repeat(x[:1], 4, 0), tiny.frames)
    first = None
    for _ in range(400):
        state, metrics = step(state, batch, RNG)
        first = first or metrics
    assert float(metrics["focal"]) < 0.01 * float(first["focal"])
    assert float(metrics["smooth_l1"]) < 0.2 * float(first["smooth_l1"])
    maps = jax.jit(tiny.model.apply)(
        state.eval_variables, to_float(batch.projection[:1])
    )
    found = decode(maps, tiny.map_grid, max_detections=8, score_threshold=0.3)
    boxes = np.asarray(found.boxes[0])[np.asarray(found.is_valid[0])]
    wanted = np.asarray(boxes7_from_8(batch.boxes[0, :2]))
    overlap = np.asarray(bev_iou(wanted, boxes))
    assert len(boxes) == 2
    assert overlap.max(1).min() > 0.3


def test_moving_average_follows_the_parameters(
    tiny: Tiny, start: Any, step: Any
) -> None:
    before = start[1]
    after, _ = step(before, _batch(tiny), RNG)
    expected = jax.tree.map(
        lambda old, new: 0.9 * old + 0.1 * new, before.ema_params, after.params
    )
    chex.assert_trees_all_close(after.ema_params, expected, atol=1e-6)


def test_a_step_without_finite_loss_changes_nothing_and_is_counted(
    tiny: Tiny, start: Any, step: Any
) -> None:
    batch = _batch(tiny)
    bad = batch.replace(projection=np.full_like(batch.projection, np.nan))
    after, metrics = step(start[1], bad, RNG)
    chex.assert_trees_all_equal(after.params, start[1].params)
    chex.assert_trees_all_equal(after.opt_state, start[1].opt_state)
    assert (int(after.step), int(after.num_skipped_in_row)) == (1, 1)
    assert int(metrics["skipped"]) == 1
    np.testing.assert_array_equal(after.skipped_frames, batch.frame)
    again, _ = step(after, batch, RNG)
    assert (int(again.num_skipped), int(again.num_skipped_in_row)) == (1, 0)
    assert int(again.most_skipped_in_row) == 1


def test_a_batch_without_objects_is_a_normal_step(
    tiny: Tiny, start: Any, step: Any
) -> None:
    batch = _batch(tiny)
    empty = batch.replace(is_valid=np.zeros_like(batch.is_valid))
    after, metrics = step(start[1], empty, RNG)
    chex.assert_tree_all_finite(after.params)
    chex.assert_tree_all_finite(metrics)
    assert int(metrics["skipped"]) == 0


@pytest.fixture(scope="module")
def plain(tiny: Tiny, start: Any) -> tuple[Any, Any, Any]:
    """Gradient descent, whose step is as exact as the gradient; its step on one device.

    Adam divides by the gradient's size, so that rounding of a gradient that is zero
    (a bias before a normalisation) becomes a whole step.
    """
    optimizer = optax.sgd(0.1)
    variables = {"params": start[1].params}
    state = create_state(variables, optimizer, batch_size=8, use_ema=True)
    return optimizer, state, jax.jit(_make(tiny, optimizer))


@pytest.mark.parametrize("parameters", ["replicated", "fsdp"])
def test_eight_devices_equal_one(tiny: Tiny, plain: Any, parameters: str) -> None:
    optimizer, state, step = plain
    expected, expected_metrics = step(state, _batch(tiny, 8), RNG)
    mesh = sharding.make_mesh(8)
    placement = sharding.state_sharding(state, mesh, parameters, min_size=64)
    if parameters == "fsdp":
        assert any(not s.is_fully_replicated for s in jax.tree.leaves(placement.params))
    sharded = jax.jit(
        _make(tiny, optimizer), out_shardings=(placement, sharding.replicated(mesh))
    )
    on_mesh = jax.device_put((state, RNG), (placement, sharding.replicated(mesh)))
    batch = sharding.put_batch(_batch(tiny, 8), mesh)
    program = sharded.lower(on_mesh[0], batch, on_mesh[1]).compile()
    if parameters == "replicated":
        _check_traffic(program.as_text(), state)
    with jax.transfer_guard("disallow"):
        actual, metrics = program(on_mesh[0], batch, on_mesh[1])
    chex.assert_trees_all_close(metrics, expected_metrics, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(actual.params, expected.params, rtol=1e-4, atol=1e-5)


class _PerBin(nn.Module):
    """The least detector: a product per bin."""

    @nn.compact
    def __call__(self, x: jax.Array, train: bool = False) -> DetectionMaps:
        y = nn.Dense(5 + 8)(x)
        return DetectionMaps(y[..., :5], y[..., 5:])


@pytest.mark.parametrize("num_devices", [1, 2, 4])
def test_so_many_devices_send_gradients_alone(num_devices: int, tiny: Tiny) -> None:
    least = dataclasses.replace(tiny, model=_PerBin(), map_grid=tiny.grid)
    batch, optimizer = _batch(tiny, 8), optax.sgd(0.1)
    variables = least.model.init(RNG, to_float(batch.projection[:1]))
    state = create_state(variables, optimizer, batch_size=8, use_ema=True)
    mesh = sharding.make_mesh(num_devices)
    everywhere = sharding.replicated(mesh)
    step = jax.jit(_make(least, optimizer), out_shardings=everywhere)
    state, rng = jax.device_put((state, RNG), everywhere)
    program = step.lower(state, sharding.put_batch(batch, mesh), rng).compile()
    if num_devices == 1:
        assert not re.search(COLLECTIVES, program.as_text())
    else:
        _check_traffic(program.as_text(), state)


def _check_traffic(text: str, state: Any) -> None:
    """Every gradient is summed over the devices once, and no part of a batch is gathered.

    On a CPU each array is summed by itself; on GPU and TPU XLA joins them.
    """
    found = re.findall(rf"= (.*?) ({COLLECTIVES})(?:-start)?\(", text)
    moved = {kind: [] for kind in COLLECTIVES.split("|")}
    for result, kind in found:
        for shape in re.findall(r"\w+\[([\d,]*)\]", result):
            moved[kind].append(math.prod(map(int, filter(None, shape.split(",")))))
    num_parameters = sum(x.size for x in jax.tree.leaves(state.params))
    # Beside the gradients: sums of losses and counts, a number or a class's each.
    assert 0 <= sum(moved.pop("all-reduce")) - num_parameters <= 100, found
    # The state keeps the numbers of the frames of a step that was skipped.
    assert sum(moved.pop("all-gather")) <= state.skipped_frames.size, found
    assert not any(moved.values()), found


def test_parts_of_a_batch_stay_on_their_devices(tiny: Tiny) -> None:
    batch = sharding.put_batch(_batch(tiny, 8), sharding.make_mesh(4))
    split = jax.jit(lambda x: split_batch(x, 2)).lower(batch).compile()
    for collective in ("all-gather", "all-to-all", "collective-permute"):
        assert collective not in split.as_text()
    placed = split(batch).frame
    assert [s.data.shape for s in placed.addressable_shards] == [(2, 1)] * 4
    np.testing.assert_array_equal(placed, [[0, 2, 4, 6], [1, 3, 5, 7]])


@pytest.mark.parametrize(
    ("num_devices", "num_parts", "normalize"),
    [
        (1, 4, True),
        pytest.param(1, 2, False, marks=pytest.mark.slow),
        pytest.param(4, 2, True, marks=pytest.mark.slow),
    ],
)
def test_accumulated_gradients_are_those_of_the_undivided_batch(
    num_devices: int, num_parts: int, normalize: bool, tiny: Tiny, plain: Any
) -> None:
    optimizer, state, whole = plain
    batch = _batch(tiny, 8)
    # Parts of other numbers of objects, one without any.
    is_valid = np.array(batch.is_valid)
    is_valid[1::num_parts] = False
    is_valid[0, 1] = False
    batch = batch.replace(is_valid=is_valid)
    options = tiny.config.loss.to_dict() | {"normalize": normalize}
    parts = _make(tiny, optimizer, loss=options, num_accumulate=num_parts)
    if options != tiny.config.loss.to_dict():
        whole = jax.jit(_make(tiny, optimizer, loss=options))
    expected, expected_metrics = whole(state, batch, RNG)
    mesh = sharding.make_mesh(num_devices)
    everywhere = sharding.replicated(mesh)
    after, metrics = jax.jit(parts, out_shardings=(everywhere, everywhere))(
        jax.device_put(state, everywhere),
        sharding.put_batch(batch, mesh),
        jax.device_put(RNG, everywhere),
    )
    gradients = [
        jax.tree.map(lambda new, old: (old - new) / 0.1, new.params, state.params)
        for new in (after, expected)
    ]
    largest = max(float(abs(g).max()) for g in jax.tree.leaves(gradients[1]))
    # Sums in another order, read from parameters' differences: 2.4e-6 on an AMD EPYC.
    chex.assert_trees_all_close(*gradients, rtol=1e-5, atol=1e-5 * largest)
    chex.assert_trees_all_close(metrics, expected_metrics, rtol=1e-5)
    assert int(metrics["num_objects"]) == is_valid.sum()


def test_bfloat16_keeps_parameters_moments_and_losses_in_float32(
    tiny: Tiny, start: Any
) -> None:
    optimizer, state = start
    narrow = make_train_step(
        tiny.model.clone(dtype="bfloat16"),
        optimizer,
        tiny.map_grid,
        loss=dict(tiny.config.loss),
        ema_decay=0.9,
    )
    after, metrics = jax.eval_shape(narrow, state, _batch(tiny), RNG)
    floats = [x.dtype for x in jax.tree.leaves(after) if x.dtype != jnp.int32]
    assert set(floats) == {jnp.dtype("float32")}
    losses = ("loss", "focal", "gwd", "smooth_l1", "grad_norm")
    assert {metrics[name].dtype for name in losses} == {jnp.dtype("float32")}
