"""One step: what it changes, what it leaves, and that devices do not matter."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.training.step import create_state, make_optimizer, make_train_step

RNG = jax.random.key(7)


@pytest.fixture(scope="module")
def start(tiny):
    """Optimizer and initial state."""
    optimizer = make_optimizer(tiny.config.train, lambda _: 3e-3)
    state = create_state(tiny.variables, optimizer, use_ema=True)
    return optimizer, jax.tree.map(jnp.asarray, state)


@pytest.fixture(scope="module")
def step(tiny, start):
    """Compiled step on one device."""
    options = {"loss": tiny.config.loss, "ema_decay": 0.9}
    return jax.jit(make_train_step(tiny.model, start[0], tiny.map_grid, **options))


def _batch(tiny, count=4):
    return jax.tree.map(lambda x: x[:count], tiny.frames)


def test_steps_lower_the_loss(tiny, start, step):
    """And the moving average follows the parameters."""
    state, batch, focal = start[1], _batch(tiny), []
    average = jax.device_get(state.ema_params)
    for _ in range(30):
        state, metrics = step(state, batch, RNG)
        focal.append(float(metrics["focal"]))
        params = jax.device_get(state.params)
        average = jax.tree.map(lambda x, y: 0.9 * x + 0.1 * y, average, params)
    chex.assert_trees_all_close(state.ema_params, average, atol=1e-5)
    assert focal[-1] < 0.35 * focal[0]
    assert int(state.step) == 30
    assert int(metrics["skipped"]) == 0


def test_a_step_without_finite_loss_changes_nothing_and_is_counted(tiny, start, step):
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


def test_bfloat16_keeps_parameters_moments_and_losses_in_float32(tiny, start):
    optimizer, state = start
    model = tiny.model.clone(options=tiny.model.options.replace(dtype="bfloat16"))
    options = {"loss": tiny.config.loss, "ema_decay": 0.9}
    narrow = make_train_step(model, optimizer, tiny.map_grid, **options)
    after, metrics = jax.eval_shape(narrow, state, _batch(tiny), RNG)
    types = {x.dtype for x in jax.tree.leaves(after)}
    floats = {dtype for dtype in types if jnp.issubdtype(dtype, jnp.floating)}
    assert floats == {jnp.dtype("float32")}
    losses = ("loss", "focal", "gwd", "smooth_l1", "grad_norm")
    assert {metrics[name].dtype for name in losses} == {jnp.dtype("float32")}
