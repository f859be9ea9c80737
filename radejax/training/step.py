"""Train state, optimizer, and one training step as a pure function to be jitted."""

from __future__ import annotations

import dataclasses
import fnmatch
import logging
from collections.abc import Callable, Iterable, Sequence

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from flax.traverse_util import flatten_dict, unflatten_dict
from flax.typing import Collection, VariableDict
from jax.typing import ArrayLike
from jaxtyping import Float, Int, Num, PyTree

from radejax.core.errors import UserError, require
from radejax.core.options import find_function
from radejax.core.structures import Batch
from radejax.detection.decode import DecodeOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import LossOptions, detection_loss
from radejax.training.options import TrainOptions

_log = logging.getLogger(__name__)

Metrics = dict[str, Num[jax.Array, ""]]
Step = Callable[["TrainState", Batch, jax.Array], tuple["TrainState", Metrics]]


# Optimizer ---------------------------------------------------------------------------


def count_steps(train: TrainOptions, steps_per_epoch: int) -> int:
    """Returns the number of steps of a training with the section `config.train`.

    Raises:
        UserError: The training ends before the first update of the parameters.
    """
    steps = train.max_steps or steps_per_epoch * train.num_epochs
    count = train.gradient_accumulation_steps
    expected = f"at most the {steps} steps of the training"
    name = "config.train.gradient_accumulation_steps"
    require(count <= steps, name, count, expected)
    return steps


def make_schedule(train: TrainOptions, steps_per_epoch: int) -> optax.Schedule:
    """Returns the schedule that `config.train.schedule` names.

    RADE-Net section IV-B uses a cosine per step from 1e-3 to 1e-4 without warm-up.

    Args:
        train: The section `config.train`. An own schedule is a function that is called
            as those in `SCHEDULES`.
        steps_per_epoch: Number of batches of one pass over the data.

    Returns:
        Function from the step to the float32 learning rate.

    Raises:
        UserError: The warm-up is not shorter than the training, or there is no such
            schedule.
    """
    warmup_steps = train.warmup_steps
    num_steps = count_steps(train, steps_per_epoch)
    expected = f"less than the {num_steps} steps of the training"
    is_shorter = warmup_steps < num_steps
    require(is_shorter, "config.train.warmup_steps", warmup_steps, expected)
    make = find_function(train.schedule, "config.train.schedule", SCHEDULES)
    if warmup_steps and train.schedule not in SCHEDULES:
        text = "config.train.warmup_steps=%d has no effect: %s is an own schedule"
        _log.warning(text, warmup_steps, train.schedule)
    return make(train, num_steps, steps_per_epoch)


def _cosine(train: TrainOptions, num_steps: int, _: int) -> optax.Schedule:
    """Creates a schedule: linear from zero to the peak, then half a cosine to the minimum."""
    return optax.warmup_cosine_decay_schedule(
        0.0,
        train.learning_rate,
        train.warmup_steps,
        num_steps,
        train.final_learning_rate,
    )


def _cyclic_cosine(train: TrainOptions, _: int, steps_per_epoch: int) -> optax.Schedule:
    """Creates a schedule: linear from zero, then that of the authors' code.

    The rate decreases in one epoch, increases in the next, and so on: this is torch's
    `CosineAnnealingLR` with `T_max = steps_per_epoch`, stepped per batch. Its closed form
    is minimum + (peak - minimum) cos^2(pi t / 2T). It is computed from the whole number of
    steps to the nearest minimum, which keeps the float32 precision where the rate is small
    and after any number of epochs.
    """
    peak = train.learning_rate
    minimum = train.final_learning_rate
    half_period = steps_per_epoch

    def rate(step: ArrayLike) -> Float[jax.Array, "..."]:
        from_floor = jnp.abs(jnp.mod(step, 2 * half_period) - half_period)
        angle = jnp.asarray(from_floor, jnp.float32) * (jnp.pi / (2 * half_period))
        return minimum + (peak - minimum) * jnp.square(jnp.sin(angle))

    warmup = optax.linear_schedule(0.0, peak, train.warmup_steps)
    return optax.join_schedules([warmup, rate], [train.warmup_steps])


SCHEDULES: dict[str, Callable[[TrainOptions, int, int], optax.Schedule]] = {
    "cosine": _cosine,
    "cyclic_cosine": _cyclic_cosine,
}
"""Schedules by their name in `config.train.schedule`: functions of the section
`config.train`, the steps of the training, and the steps of an epoch."""


def make_optimizer(
    train: TrainOptions, schedule: optax.Schedule
) -> optax.GradientTransformation:
    """Creates the optimizer that `config.train.optimizer` names.

    The mean gradient of `gradient_accumulation_steps` steps updates the parameters, see
    `optax.MultiSteps`. It is clipped to the global norm `gradient_clip_norm` unless this
    is None.

    Args:
        train: The section `config.train`. An own optimizer is a function that is called
            as those in `OPTIMIZERS`.
        schedule: Function from the step to the learning rate.

    Raises:
        UserError: There is no such optimizer.
    """
    count = train.gradient_accumulation_steps
    name = "config.train.optimizer"
    make = find_function(train.optimizer, name, OPTIMIZERS)
    # The optimizer counts updates, while the schedule takes steps.
    base = make(train, lambda n: schedule(n * count))
    is_optimizer = isinstance(base, optax.GradientTransformation)
    expected = "a function that returns an optax.GradientTransformation"
    require(is_optimizer, name, train.optimizer, expected)
    parts: list[optax.GradientTransformation] = [base]
    if train.gradient_clip_norm is not None:
        parts.insert(0, optax.clip_by_global_norm(train.gradient_clip_norm))
    optimizer: optax.GradientTransformation = optax.chain(*parts)
    if count > 1:
        return optax.MultiSteps(optimizer, count).gradient_transformation()
    return optimizer


def _adamw(
    train: TrainOptions, schedule: optax.Schedule
) -> optax.GradientTransformation:
    """Creates AdamW with torch's defaults and weight decay on every parameter."""
    return optax.adamw(schedule, weight_decay=train.weight_decay)


OPTIMIZERS: dict[
    str, Callable[[TrainOptions, optax.Schedule], optax.GradientTransformation]
] = {"adamw": _adamw}
"""Optimizers by their name in `config.train.optimizer`: functions of the section
`config.train`, and of the schedule of the learning rate."""


# State -------------------------------------------------------------------------------


class TrainState(struct.PyTreeNode):
    """State that a training step reads and updates.

    Attributes:
        step: Number of steps taken, including skipped ones; int32.
        num_skipped: Number of steps skipped because loss or gradient was not finite.
        num_skipped_in_row: Number of consecutive steps skipped up to now.
        params: Trained parameters, float32.
        model_state: Other variable collections, such as running batch statistics.
        opt_state: State of the optimizer.
        ema_params: Moving average of `params`, or None.
        frozen: Parameters that are not trained. They have no gradient, optimizer state
            or average.
    """

    step: Int[jax.Array, ""]
    num_skipped: Int[jax.Array, ""]
    num_skipped_in_row: Int[jax.Array, ""]
    params: Collection
    model_state: VariableDict
    opt_state: optax.OptState
    ema_params: PyTree
    frozen: Collection = dataclasses.field(default_factory=dict)

    @property
    def eval_variables(self) -> VariableDict:
        """Variables for evaluation, with the averaged parameters if there are any."""
        params = self.params if self.ema_params is None else self.ema_params
        return {"params": merge_variables(params, self.frozen), **self.model_state}

    def without(self, parts: Iterable[str]) -> TrainState:
        """Returns the state without the frozen parameters of parts of the model."""
        kept = {name: x for name, x in self.frozen.items() if name not in set(parts)}
        return self.replace(frozen=kept)


def create_state(
    variables: VariableDict,
    optimizer: optax.GradientTransformation,
    *,
    use_ema: bool,
    model: nn.Module | None = None,
    freeze: Sequence[str] = (),
) -> TrainState:
    """Creates the state before the first step.

    Args:
        variables: Variables of the model: "params" and any other collections.
        optimizer: Optimizer that `make_optimizer` returned.
        use_ema: Keep a moving average of the parameters.
        model: Model whose method `is_frozen`, if there is one, returns whether the
            parameter of a path is not trained.
        freeze: Patterns of further parameters or parts that are not trained, such as
            "backbone/encoder*".

    Raises:
        UserError: A pattern matches no parameter, or they match all.
    """
    check_patterns(variables["params"], freeze)
    params, frozen = split_parameters(variables["params"], model, freeze)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
        num_skipped_in_row=jnp.zeros((), jnp.int32),
        params=params,
        model_state={k: v for k, v in variables.items() if k != "params"},
        opt_state=optimizer.init(params),
        ema_params=jax.tree.map(jnp.copy, params) if use_ema else None,
        frozen=frozen,
    )


def _matches(path: str, pattern: str) -> bool:
    """Returns whether a pattern matches the path of a parameter, or of a part with it."""
    return any(fnmatch.fnmatchcase(path, x) for x in (pattern, f"{pattern}/*"))


def check_patterns(params: Collection, patterns: Sequence[str]) -> None:
    """Raises `UserError` if one of `config.train.freeze` matches no parameter, or all match."""
    paths = list(flatten_dict(params, sep="/"))
    parts = sorted({"/".join(path.split("/")[:2]) for path in paths})
    left = set(paths)
    for pattern in patterns:
        found = [path for path in paths if _matches(path, pattern)]
        expected = f"a pattern of parts of the model: {', '.join(parts)}"
        require(len(found) > 0, "config.train.freeze", pattern, expected)
        left.difference_update(found)
    expected = "patterns that leave parameters to train"
    require(len(left) > 0, "config.train.freeze", patterns, expected)


def split_parameters(
    params: Collection, model: nn.Module | None, freeze: Sequence[str]
) -> tuple[Collection, Collection]:
    """Splits parameters into a tree of trained and a tree of frozen ones.

    Args:
        params: Parameters of the model.
        model: See `create_state`.
        freeze: See `create_state`.
    """
    is_frozen = getattr(model, "is_frozen", lambda path: False)
    flat = flatten_dict(params, sep="/")
    frozen = {
        path: x
        for path, x in flat.items()
        if is_frozen(path) or any(_matches(path, pattern) for pattern in freeze)
    }
    trained = {n: x for n, x in flat.items() if n not in frozen}
    return unflatten_dict(trained, sep="/"), unflatten_dict(frozen, sep="/")


def merge_variables(variables: VariableDict, part: VariableDict) -> VariableDict:
    """Returns variables with a part added or replaced; the inverse of `split_parameters`.

    Args:
        variables: Tree of the variables or parameters of a model.
        part: Tree of those to replace, such as a pretrained image backbone,
            `{"params": {"image_backbone": params}}`. Entries that `variables` lack are
            added, such as frozen parameters.

    Raises:
        UserError: The shapes of a variable differ.
    """
    flat = flatten_dict(variables, sep="/")
    for path, new in flatten_dict(part, sep="/").items():
        if path in flat and flat[path].shape != new.shape:
            raise UserError(
                f"pretrained {path} is {new.shape}, the model has {flat[path].shape}"
            )
        flat[path] = new
    merged: VariableDict = unflatten_dict(flat, sep="/")
    return merged


def run_keys(seed: int | jax.Array) -> jax.Array:
    """Returns the random keys of a run: of the initial parameters, and of the steps."""
    return jax.random.split(jax.random.key(seed))


def initial_variables(
    model: nn.Module,
    seed: int,
    batch: Batch,
    weights: VariableDict,
) -> VariableDict:
    """Creates the variables of step 0.

    Args:
        model: Detector of `models.build`, a `RadeNet` or `DinoRade`.
        seed: Seed of the run.
        batch: A batch with the shapes of the model's inputs.
        weights: Variables that replace initialized ones.
    """
    init_key, _ = run_keys(seed)
    variables = model.init(init_key, *batch.model_inputs(), train=False)
    return merge_variables(variables, weights)


# Step --------------------------------------------------------------------------------


def make_train_step(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    grid: RadarGrid,
    *,
    loss: LossOptions,
    decoding: DecodeOptions | None = None,
    ema_decay: float | None = None,
) -> Step:
    """Builds the function that computes one training step.

    A step whose loss or gradient is not finite leaves the parameters, batch statistics and
    the optimizer's state unchanged; the train state counts it.

    Args:
        model: Detector of `models.build`, a `RadeNet` or `DinoRade`.
        optimizer: Optimizer that `make_optimizer` returned.
        grid: Grid of the model's maps.
        loss: Options of the loss.
        decoding: Thresholds for the assignment "nms", see `detection_loss`.
        ema_decay: Decay of the parameters' moving average, or None.

    Returns:
        Function `step(state, batch, rng) -> (state, metrics)`. `rng` is the key of the
        run; each step derives its own key from it and from `state.step`.
    """

    def loss_fn(
        params: Collection, state: TrainState, batch: Batch, rng: jax.Array
    ) -> tuple[Float[jax.Array, ""], tuple[VariableDict, Metrics]]:
        maps, model_state = model.apply(
            {"params": merge_variables(params, state.frozen), **state.model_state},
            *batch.model_inputs(),
            train=True,
            rngs={"dropout": rng},
            mutable=list(state.model_state),
        )
        with jax.named_scope("losses"):
            total, parts = detection_loss(maps, batch, grid, loss, decoding)
        return total, (model_state, parts)

    def step(
        state: TrainState, batch: Batch, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        chex.assert_tree_shape_prefix(batch, batch.frame.shape)
        rng = jax.random.fold_in(rng, state.step)
        grad_fn = jax.value_and_grad(loss_fn, has_aux=True)
        (total, (model_state, parts)), grads = grad_fn(state.params, state, batch, rng)
        grad_norm = optax.global_norm(grads)
        is_finite = jnp.isfinite(grad_norm) & jnp.isfinite(total)

        @jax.named_scope("optimizer")
        def update() -> TrainState:
            updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
            params = optax.apply_updates(state.params, updates)
            ema_params = state.ema_params
            if ema_decay is not None:
                ema_params = optax.incremental_update(params, ema_params, 1 - ema_decay)
            return state.replace(
                params=params,
                model_state=model_state,
                opt_state=opt_state,
                ema_params=ema_params,
                frozen={},
            )

        # The frozen parameters do not change, so `cond` need not return them.
        after = jax.lax.cond(is_finite, update, lambda: state.replace(frozen={}))
        after = after.replace(
            step=state.step + 1,
            num_skipped=state.num_skipped + ~is_finite,
            num_skipped_in_row=jnp.where(is_finite, 0, state.num_skipped_in_row + 1),
            frozen=state.frozen,
        )
        # If shapes or dtypes differed, the next step would be compiled again.
        chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
        metrics = {"loss": total, **parts, "grad_norm": grad_norm}
        return after, {**metrics, "skipped": after.num_skipped}

    return step
