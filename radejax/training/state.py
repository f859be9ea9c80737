"""Train state and optimizer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import flax.traverse_util
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from radejax.core.errors import UserError


class TrainState(struct.PyTreeNode):
    """Everything a training step reads and writes.

    Attributes:
        step: Number of steps taken, skipped ones included; int32.
        params: Parameters that are trained, float32.
        model_state: Other variable collections, such as running batch statistics.
        opt_state: The optimizer's.
        ema_params: Moving average of `params`, or None.
        num_skipped: Steps skipped in all because loss or gradient was not finite.
        num_skipped_in_row: The same, since the last step that was taken.
        most_skipped_in_row: The most that this has been.
        skipped_frames: int32 frames of the last skipped batch; -1 at first.
        frozen: Parameters that are not trained: in no gradient, optimizer or average,
            and in no checkpoint, as they are known from where they came.
    """

    step: Int[jax.Array, ""]
    params: Any
    model_state: Any
    opt_state: Any
    ema_params: Any
    num_skipped: Int[jax.Array, ""]
    num_skipped_in_row: Int[jax.Array, ""]
    most_skipped_in_row: Int[jax.Array, ""]
    skipped_frames: Int[jax.Array, " B"]
    frozen: Any = dataclasses.field(default_factory=dict)

    @property
    def eval_variables(self) -> dict[str, Any]:
        """Variables to run the model with: averaged parameters where there are any."""
        params = self.params if self.ema_params is None else self.ema_params
        return {"params": merge_parameters(params, self.frozen), **self.model_state}


Schedule = Literal["cosine", "cyclic_cosine"]


def make_schedule(
    *,
    learning_rate: float,
    final_learning_rate: float,
    num_steps: int,
    warmup_steps: int,
    kind: Schedule = "cosine",
    steps_per_epoch: int = 0,
) -> optax.Schedule:
    """Linear warm-up from zero, then a cosine between the peak and the floor.

    RADE-Net section IV-B: cosine per step from 1e-3 to 1e-4, no warm-up.

    Args:
        learning_rate: The peak.
        final_learning_rate: The floor.
        num_steps: Of the training, warm-up included.
        warmup_steps: Of those, before the cosine begins.
        kind: "cosine": falls once, over the training. "cyclic_cosine", as released:
            falls in one epoch and climbs back in the next, and so on, which is torch's
            `CosineAnnealingLR` with `T_max = steps_per_epoch`, stepped per batch.
        steps_per_epoch: Batches of one pass over the data, for "cyclic_cosine".

    Returns:
        Learning rate by step, float32.

    Raises:
        UserError: The warm-up is longer than the training, the learning rate is not
            positive, the floor is above it, or the kind is unknown.
    """
    if learning_rate <= 0:
        raise UserError(f"train.learning_rate={learning_rate} must be positive")
    if not 0 <= final_learning_rate <= learning_rate:
        raise UserError(
            f"train.final_learning_rate={final_learning_rate} must be from 0 to "
            f"train.learning_rate={learning_rate}: the rate falls from that one"
        )
    if not 0 <= warmup_steps < num_steps:
        raise UserError(
            f"train.warmup_steps={warmup_steps} must be less than the {num_steps} steps "
            "of the training"
        )
    if kind == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0, learning_rate, warmup_steps, num_steps, final_learning_rate
        )
    if kind != "cyclic_cosine":
        raise UserError(
            f"train.schedule must be 'cosine' or 'cyclic_cosine', got {kind!r}"
        )
    warmup = optax.linear_schedule(0.0, learning_rate, warmup_steps)
    cyclic = _cyclic_cosine(learning_rate, final_learning_rate, steps_per_epoch)
    return optax.join_schedules([warmup, cyclic], [warmup_steps])


def _cyclic_cosine(peak: float, floor: float, half_period: int) -> optax.Schedule:
    """What torch's recursion comes to: floor + (peak - floor) cos^2(pi t / 2T).

    In whole steps from the nearest floor, so that float32 keeps all digits of the rate
    where it is small and after any number of epochs.
    """

    def rate(step: ArrayLike) -> Float[jax.Array, "..."]:
        from_floor = jnp.abs(jnp.mod(step, 2 * half_period) - half_period)
        angle = jnp.asarray(from_floor, jnp.float32) * (jnp.pi / (2 * half_period))
        return floor + (peak - floor) * jnp.square(jnp.sin(angle))

    return rate


def make_optimizer(
    schedule: optax.Schedule,
    *,
    weight_decay: float,
    gradient_clip_norm: float | None = None,
) -> optax.GradientTransformation:
    """AdamW with torch's defaults, decaying every parameter as the papers' runs do.

    Args:
        schedule: Learning rate by step.
        weight_decay: Decoupled weight decay.
        gradient_clip_norm: Global norm to clip to, or None.
    """
    adamw = optax.adamw(schedule, weight_decay=weight_decay)
    if gradient_clip_norm is None:
        return optax.chain(adamw)
    return optax.chain(optax.clip_by_global_norm(gradient_clip_norm), adamw)


def create_state(
    variables: Mapping[str, Any],
    optimizer: optax.GradientTransformation,
    *,
    batch_size: int,
    use_ema: bool,
    is_frozen: Callable[[str], bool] | None = None,
) -> TrainState:
    """State before the first step.

    Args:
        variables: Of the model: "params" and any other collections.
        optimizer: From `make_optimizer`.
        batch_size: Global; the shape of `skipped_frames`.
        use_ema: Keep a moving average of the parameters.
        is_frozen: Told a parameter's path, True where it is not to be trained.
    """
    params, frozen = split_parameters(variables["params"], is_frozen)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        model_state={k: v for k, v in variables.items() if k != "params"},
        opt_state=optimizer.init(params),
        ema_params=jax.tree.map(jnp.copy, params) if use_ema else None,
        num_skipped=jnp.zeros((), jnp.int32),
        num_skipped_in_row=jnp.zeros((), jnp.int32),
        most_skipped_in_row=jnp.zeros((), jnp.int32),
        skipped_frames=jnp.full((batch_size,), -1, jnp.int32),
        frozen=frozen,
    )


def split_parameters(
    params: Mapping[str, Any], is_frozen: Callable[[str], bool] | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters that are trained, and those that are not, as two trees."""
    if is_frozen is None:
        return dict(params), {}
    flat = flax.traverse_util.flatten_dict(params, sep="/")
    parts: tuple[dict, dict] = ({}, {})
    for name, leaf in flat.items():
        parts[is_frozen(name)][name] = leaf
    return tuple(flax.traverse_util.unflatten_dict(part, sep="/") for part in parts)


def merge_parameters(
    params: Mapping[str, Any], frozen: Mapping[str, Any]
) -> dict[str, Any]:
    """Inverse of `split_parameters`."""
    if not frozen:
        return dict(params)
    trees = [flax.traverse_util.flatten_dict(t, sep="/") for t in (params, frozen)]
    return flax.traverse_util.unflatten_dict({**trees[0], **trees[1]}, sep="/")


def with_pretrained(
    variables: Mapping[str, Any], part: Mapping[str, Any]
) -> dict[str, Any]:
    """Variables with some of them replaced, such as a pretrained image backbone.

    Args:
        variables: Of a model: "params" and other collections.
        part: The same tree or a part of it, e.g.
            `{"params": {"image_backbone": params}}`. What `variables` lack is added.

    Raises:
        UserError: Shapes or structure differ.
    """

    def merge(old: Any, new: Any, path: str) -> Any:
        if isinstance(new, Mapping) and isinstance(old, Mapping):
            added = {
                k: merge(old[k], v, f"{path}/{k}") if k in old else v
                for k, v in new.items()
            }
            return {**old, **added}
        shapes = [getattr(x, "shape", type(x).__name__) for x in (old, new)]
        if shapes[0] != shapes[1]:
            raise UserError(
                f"pretrained {path.strip('/')} is {shapes[1]}, the model has {shapes[0]}"
            )
        return new

    return merge(dict(variables), part, "")
