"""One training step and one prediction step, as pure functions to be jitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Bool, Float, Int, Num

from radejax.core.structures import Array, Batch
from radejax.data.encoding import model_inputs
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import detection_loss, whole_batch_loss
from radejax.training.state import TrainState, merge_parameters

Metrics = dict[str, Num[jax.Array, ""]]


def make_train_step(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    grid: RadarGrid,
    *,
    loss: Mapping[str, Any],
    num_accumulate: int = 1,
    ema_decay: float | None = None,
) -> Callable[[TrainState, Batch, jax.Array], tuple[TrainState, Metrics]]:
    """Builds the function of one optimizer step.

    A step whose loss or gradient is not finite leaves parameters and optimizer as they
    were and is counted in the state.

    Args:
        model: Radar or radar-camera detector.
        optimizer: From `make_optimizer`.
        grid: Grid of the model's maps.
        loss: Keyword arguments of `detection_loss`.
        num_accumulate: The batch is cut into this many parts, one after the other, for
            batches that do not fit at once. Their gradients sum to the batch's: what
            it divides by comes from a forward pass over all parts first.
        ema_decay: Decay of the parameters' moving average, or None.

    Returns:
        `step(state, batch, rng) -> (state, metrics)`; `rng` is the run's own key, made
        different for every step from the state's counter.
    """

    def loss_of_part(
        params: Any,
        state: TrainState,
        model_state: Any,
        part: Batch,
        rng: jax.Array,
        **changed: Any,
    ) -> tuple[Float[jax.Array, ""], tuple[Any, Metrics, int]]:
        maps, updates = model.apply(
            {"params": merge_parameters(params, state.frozen), **model_state},
            *model_inputs(part),
            train=True,
            rngs={"dropout": rng},
            mutable=list(model_state),
        )
        total, parts = detection_loss(maps, part, grid, **{**loss, **changed})
        return total, (updates, parts, maps.heatmap_logits.size)

    def step(
        state: TrainState, batch: Batch, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        chex.assert_tree_shape_prefix(batch, batch.frame.shape)
        rng = jax.random.fold_in(rng, state.step)
        grads, model_state, metrics = _accumulate(
            loss_of_part, loss, num_accumulate, state, batch, rng
        )
        grad_norm = optax.global_norm(grads)
        is_finite = jnp.isfinite(grad_norm) & jnp.isfinite(metrics["loss"])

        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        ema_params = state.ema_params
        if ema_decay is not None:
            ema_params = optax.incremental_update(params, ema_params, 1.0 - ema_decay)
        after = _taken_if(
            is_finite,
            state,
            batch.frame,
            params=params,
            model_state=model_state,
            opt_state=opt_state,
            ema_params=ema_params,
        )
        # Otherwise the next step would be compiled anew.
        chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
        return after, {**metrics, "grad_norm": grad_norm, "skipped": after.num_skipped}

    return step


def _accumulate(
    loss_of_part: Callable,
    loss: Mapping[str, Any],
    num_parts: int,
    state: TrainState,
    batch: Batch,
    rng: jax.Array,
) -> tuple[Any, Any, Metrics]:
    """Gradients of a batch, cut into parts, and what its forward pass gives beside."""
    gradient = jax.value_and_grad(loss_of_part, has_aux=True)
    if num_parts == 1:
        (total, (model_state, metrics, _)), grads = gradient(
            state.params, state, state.model_state, batch, rng
        )
        return grads, model_state, {"loss": total, **metrics}

    def measure(_: None, part_and_rng: Any) -> Any:
        _, (_, parts, num_bins) = loss_of_part(
            state.params, state, state.model_state, *part_and_rng
        )
        return None, (parts, num_bins)

    def add(carry: Any, part_rng_and_weights: Any) -> Any:
        (model_state, total), (part, part_rng, weights) = carry, part_rng_and_weights
        (_, (model_state, _, _)), grads = gradient(
            state.params,
            state,
            model_state,
            part,
            part_rng,
            weights=weights,
            normalize=False,
        )
        return (model_state, jax.tree.map(jnp.add, total, grads)), None

    split = split_batch(batch, num_parts), jax.random.split(rng, num_parts)
    _, (parts, num_bins) = jax.lax.scan(measure, None, split)
    options = {name: loss[name] for name in ("weights", "normalize") if name in loss}
    weights, total, metrics = whole_batch_loss(parts, num_bins, **options)
    start = state.model_state, jax.tree.map(jnp.zeros_like, state.params)
    (model_state, grads), _ = jax.lax.scan(add, start, (*split, weights))
    grads = jax.tree.map(lambda g: g / num_parts, grads)
    return grads, model_state, {"loss": total, **metrics}


def _taken_if(
    is_finite: Bool[jax.Array, ""],
    state: TrainState,
    frames: Int[Array, " B"],
    **changed: Any,
) -> TrainState:
    """The state with what a step changed, or the step counted as skipped."""
    kept = {name: getattr(state, name) for name in changed}
    is_skipped = (~is_finite).astype(jnp.int32)
    in_row = (state.num_skipped_in_row + 1) * is_skipped
    return state.replace(
        **jax.tree.map(lambda new, old: jnp.where(is_finite, new, old), changed, kept),
        step=state.step + 1,
        num_skipped=state.num_skipped + is_skipped,
        num_skipped_in_row=in_row,
        most_skipped_in_row=jnp.maximum(state.most_skipped_in_row, in_row),
        skipped_frames=jnp.where(is_finite, state.skipped_frames, frames),
    )


def split_batch(batch: Batch, num_parts: int) -> Batch:
    """`[parts, B / parts, ...]`: every part has frames of every device.

    The axis that devices share stays in its place. Were it the first one, over which
    parts are taken in turn, all devices would gather the whole batch.
    """
    return jax.tree.map(
        lambda x: x.reshape(-1, num_parts, *x.shape[1:]).swapaxes(0, 1), batch
    )
