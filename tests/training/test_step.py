"""One step: what it changes, what it leaves, and that devices do not matter."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.structures import to_float
from radejax.detection.decode import DecodeOptions, decode
from radejax.geometry.boxes import boxes7_from_8
from radejax.geometry.rotated_iou import bev_iou
from radejax.training.step import (
    create_state,
    make_optimizer,
    make_train_step,
)

RNG = jax.random.key(7)
Tiny = Any  # the fixture `tiny` of conftest.py


@pytest.fixture(scope="module")
def start(tiny: Tiny) -> tuple[Any, Any]:
    """Optimizer and initial state."""
    optimizer = make_optimizer(tiny.config.train, lambda _: 3e-3)
    state = create_state(tiny.variables, optimizer, use_ema=True)
    return optimizer, jax.tree.map(jnp.asarray, state)


@pytest.fixture(scope="module")
def step(tiny: Tiny, start: tuple[Any, Any]) -> Any:
    """Compiled step on one device."""
    return jax.jit(_make(tiny, start[0]))


def _make(tiny: Tiny, optimizer: Any, **options: Any) -> Any:
    options = {"loss": tiny.config.loss, "ema_decay": 0.9} | options
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
    assert int(metrics["skipped"]) == 0


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
    found = decode(maps, tiny.map_grid, DecodeOptions(max_detections=8))
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
    chex.assert_trees_all_equal(after.ema_params, start[1].ema_params)
    chex.assert_trees_all_equal(after.opt_state, start[1].opt_state)
    assert (int(after.step), int(after.num_skipped_in_row)) == (1, 1)
    assert int(metrics["skipped"]) == 1
    again, metrics = step(after, batch, RNG)
    assert int(metrics["skipped"]) == 1
    assert int(again.num_skipped_in_row) == 0


def test_bfloat16_keeps_parameters_moments_and_losses_in_float32(
    tiny: Tiny, start: Any
) -> None:
    optimizer, state = start
    narrow = make_train_step(
        tiny.model.clone(options=tiny.model.options.replace(dtype="bfloat16")),
        optimizer,
        tiny.map_grid,
        loss=tiny.config.loss,
        ema_decay=0.9,
    )
    after, metrics = jax.eval_shape(narrow, state, _batch(tiny), RNG)
    floats = [
        x.dtype for x in jax.tree.leaves(after) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    assert set(floats) == {jnp.dtype("float32")}
    losses = ("loss", "focal", "gwd", "smooth_l1", "grad_norm")
    assert {metrics[name].dtype for name in losses} == {jnp.dtype("float32")}
