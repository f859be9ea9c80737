"""Train state and optimizer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from radejax.core.errors import (
    BELOW_ONE,
    POSITIVE,
    UserError,
    check_options,
    integer,
    number,
    one_of,
    or_none,
    require,
)

Schedule = Literal["cosine", "cyclic_cosine"]

_RANGES = {
    "batch_size": integer(1),
    "num_epochs": integer(1),
    "learning_rate": POSITIVE,
    "final_learning_rate": number(0),
    "schedule": one_of("cosine", "cyclic_cosine"),
    "weight_decay": number(0),
    "warmup_steps": integer(0),
    "gradient_clip_norm": or_none(POSITIVE),
    "ema_decay": or_none(BELOW_ONE),
    "gradient_accumulation_steps": integer(1),
    "parameter_sharding": one_of("replicated", "fsdp"),
    "log_every_steps": integer(1),
    "checkpoint_every_steps": integer(1),
    "checkpoints_to_keep": or_none(integer(1)),
    "evaluate_every_epochs": integer(0),
    "max_skipped_steps": integer(0),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Optimizer and training loop: the fields of `config.train`, described there.

    Raises:
        UserError: A field is out of its range.
    """

    batch_size: int
    num_epochs: int
    learning_rate: float
    final_learning_rate: float
    schedule: Schedule
    weight_decay: float
    warmup_steps: int
    gradient_clip_norm: float | None
    ema_decay: float | None
    gradient_accumulation_steps: int
    parameter_sharding: Literal["replicated", "fsdp"]
    log_every_steps: int
    checkpoint_every_steps: int
    checkpoints_to_keep: int | None
    evaluate_every_epochs: int
    best_metric: str
    max_skipped_steps: int

    def __post_init__(self) -> None:
        check_options(vars(self), "config.train", _RANGES)
        require(
            self.final_learning_rate <= self.learning_rate,
            "config.train.final_learning_rate",
            self.final_learning_rate,
            f"at most config.train.learning_rate, {self.learning_rate}",
        )

    def make_schedule(self, steps_per_epoch: int) -> optax.Schedule:
        """Learning rate by step."""
        return make_schedule(
            learning_rate=self.learning_rate,
            final_learning_rate=self.final_learning_rate,
            num_steps=steps_per_epoch * self.num_epochs,
            warmup_steps=self.warmup_steps,
            kind=self.schedule,
            steps_per_epoch=steps_per_epoch,
        )

    def make_optimizer(self, steps_per_epoch: int) -> optax.GradientTransformation:
        """AdamW with its learning rate by step."""
        return make_optimizer(
            self.make_schedule(steps_per_epoch),
            weight_decay=self.weight_decay,
            gradient_clip_norm=self.gradient_clip_norm,
            gradient_accumulation_steps=self.gradient_accumulation_steps,
        )


class TrainState(struct.PyTreeNode):
    """Everything a training step reads and writes.

    Attributes:
        step: Number of steps taken, including skipped ones; int32.
        params: Parameters that are trained, float32.
        model_state: Other variable collections, such as running batch statistics.
        opt_state: State of the optimizer. It counts skipped steps, see
            `optax.ApplyIfFiniteState`.
        ema_params: Moving average of `params`, or None.
        frozen: Parameters that are not trained. They have no gradient, optimizer state
            or average, and are not saved in checkpoints.
    """

    step: Int[jax.Array, ""]
    params: Any
    model_state: Any
    opt_state: Any
    ema_params: Any
    frozen: Any = dataclasses.field(default_factory=dict)

    @property
    def eval_variables(self) -> dict[str, Any]:
        """Variables to run the model with: averaged parameters where there are any."""
        params = self.params if self.ema_params is None else self.ema_params
        return {"params": merge_parameters(params, self.frozen), **self.model_state}


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
        UserError: The warm-up is not shorter than the training.
    """
    require(
        0 <= warmup_steps < num_steps,
        "config.train.warmup_steps",
        warmup_steps,
        f"less than the {num_steps} steps of the training",
    )
    if kind == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0, learning_rate, warmup_steps, num_steps, final_learning_rate
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
    gradient_accumulation_steps: int = 1,
) -> optax.GradientTransformation:
    """AdamW with torch's defaults, decaying every parameter as the papers' runs do.

    A step whose gradient is not finite changes nothing and is counted in the state, see
    `optax.apply_if_finite`.

    Args:
        schedule: Learning rate by step.
        weight_decay: Decoupled weight decay.
        gradient_clip_norm: Global norm to clip to, or None.
        gradient_accumulation_steps: The mean gradient of this many steps updates the
            parameters, see `optax.MultiSteps`.
    """
    count = gradient_accumulation_steps
    if count == 1:
        adamw = optax.adamw(schedule, weight_decay=weight_decay)
    else:  # which counts updates
        adamw = optax.adamw(lambda n: schedule(n * count), weight_decay=weight_decay)
    optimizer: optax.GradientTransformation = optax.chain(adamw)
    if gradient_clip_norm is not None:
        optimizer = optax.chain(optax.clip_by_global_norm(gradient_clip_norm), adamw)
    if count > 1:
        optimizer = optax.MultiSteps(optimizer, count).gradient_transformation()
    return skip_not_finite(optimizer)


def skip_not_finite(
    optimizer: optax.GradientTransformation,
) -> optax.GradientTransformation:
    """An optimizer that ignores gradients that are not finite, any number in a row."""
    return optax.apply_if_finite(optimizer, np.iinfo(np.int32).max)


def create_state(
    variables: Mapping[str, Any],
    optimizer: optax.GradientTransformation,
    *,
    use_ema: bool,
    is_frozen: Callable[[str], bool] | None = None,
) -> TrainState:
    """State before the first step.

    Args:
        variables: Of the model: "params" and any other collections.
        optimizer: From `make_optimizer`.
        use_ema: Keep a moving average of the parameters.
        is_frozen: Called with the path of a parameter; True if it is not trained.
    """
    params, frozen = split_parameters(variables["params"], is_frozen)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        model_state={k: v for k, v in variables.items() if k != "params"},
        opt_state=optimizer.init(params),
        ema_params=jax.tree.map(jnp.copy, params) if use_ema else None,
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
