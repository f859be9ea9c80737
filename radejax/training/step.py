"""One training step, as a pure function to be jitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float, Num

from radejax.core.structures import Batch
from radejax.data.projection import model_inputs
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import detection_loss
from radejax.training.state import TrainState, merge_parameters

Metrics = dict[str, Num[jax.Array, ""]]
Step = Callable[[TrainState, Batch, jax.Array], tuple[TrainState, Metrics]]


def make_train_step(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    grid: RadarGrid,
    *,
    loss: Mapping[str, Any],
    ema_decay: float | None = None,
) -> Step:
    """Builds the function of one training step.

    A step whose loss or gradient is not finite leaves parameters, batch statistics and
    optimizer as they were; the state of the optimizer counts it.

    Args:
        model: Radar or radar-camera detector.
        optimizer: From `make_optimizer`.
        grid: Grid of the model's maps.
        loss: Keyword arguments of `detection_loss`.
        ema_decay: Decay of the parameters' moving average, or None.

    Returns:
        `step(state, batch, rng) -> (state, metrics)`; `rng` is the key of the run, from
        which each step derives its own by the state's counter.
    """

    def loss_fn(
        params: Any, state: TrainState, batch: Batch, rng: jax.Array
    ) -> tuple[Float[jax.Array, ""], tuple[Any, Metrics]]:
        maps, model_state = model.apply(
            {"params": merge_parameters(params, state.frozen), **state.model_state},
            *model_inputs(batch),
            train=True,
            rngs={"dropout": rng},
            mutable=list(state.model_state),
        )
        total, parts = detection_loss(maps, batch, grid, **loss)
        return total, (model_state, parts)

    def step(
        state: TrainState, batch: Batch, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        chex.assert_tree_shape_prefix(batch, batch.frame.shape)
        rng = jax.random.fold_in(rng, state.step)
        (total, (model_state, parts)), grads = jax.value_and_grad(
            loss_fn, has_aux=True
        )(state.params, state, batch, rng)
        grad_norm = optax.global_norm(grads)
        is_finite = jnp.isfinite(grad_norm) & jnp.isfinite(total)

        # The optimizer skips by the gradient, which can be finite without the loss.
        grads = jax.tree.map(lambda g: jnp.where(is_finite, g, jnp.nan), grads)
        opt_state: Any
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        ema_params = state.ema_params
        if ema_decay is not None:
            ema_params = optax.incremental_update(params, ema_params, 1.0 - ema_decay)
        ema_params, model_state = jax.tree.map(
            lambda new, old: jnp.where(is_finite, new, old),
            (ema_params, model_state),
            (state.ema_params, state.model_state),
        )
        after = state.replace(
            step=state.step + 1,
            params=params,
            model_state=model_state,
            opt_state=opt_state,
            ema_params=ema_params,
        )
        # Otherwise the next step would be compiled again.
        chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
        counts = {"skipped": opt_state.total_notfinite}
        return after, {"loss": total, **parts, "grad_norm": grad_norm, **counts}

    return step
