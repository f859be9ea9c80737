"""The training loop: from a data iterator to checkpoints, for any number of devices."""

from __future__ import annotations

import collections
import dataclasses
import logging
import pathlib
from collections.abc import Callable, Generator, Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import optax
from ml_collections import ConfigDict

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.structures import Batch
from radejax.data.projection import model_inputs
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import NmsAssignment
from radejax.training import distributed
from radejax.training.checkpoints import Checkpoints, abstract_state
from radejax.training.metric_logger import LoggingOptions, MetricLogger, Scores
from radejax.training.state import (
    TrainOptions,
    TrainState,
    create_state,
    with_pretrained,
)
from radejax.training.step import Metrics, Step, make_train_step

_log = logging.getLogger(__name__)

_STEPS_IN_FLIGHT = 2  # more would only pile up batches in memory


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """How a training ended.

    Attributes:
        state: Placed on the mesh.
        step: Steps taken in all, over every start of the run.
        finished: False where a signal ended it, or its last evaluation, early; the
            state is saved.
    """

    state: TrainState
    step: int
    finished: bool


Evaluate = Callable[[TrainState, int, Callable[[], bool]], Scores]
"""Called with the state, its step, and a function that returns whether to stop; it then
raises `distributed.Stopped`. Every process must call that function equally often."""


def train(
    config: ConfigDict,
    model: nn.Module,
    loader: Any,
    grid: RadarGrid,
    workdir: str | pathlib.Path,
    *,
    info: Mapping[str, Any],
    steps_per_epoch: int,
    variables: Mapping[str, Any] | None = None,
    pretrained: Mapping[str, Any] | None = None,
    mesh: jax.sharding.Mesh | None = None,
    evaluate: Evaluate | None = None,
    profile: str = "",
) -> TrainResult:
    """Trains until the configured epochs are done, from where an earlier start ended.

    Args:
        config: `seed`, `train`, `loss`, `decode` and `logging` are read.
        model: Called as `model.apply(variables, *inputs, train=True)`.
        loader: Checkpointable grain iterator of `Batch`; endless.
        grid: Grid of the model's maps.
        workdir: Folder of checkpoints and logs.
        info: Plain values that each checkpoint carries. Those under "same" must be the
            same on every start of a run; "config" is shown by Weights & Biases.
        steps_per_epoch: Batches of one pass over the data.
        variables: To start from; initialized from the seed if None.
        pretrained: Part of the variables that replaces initialized ones.
        mesh: Devices to use; all by default.
        evaluate: Called every `evaluate_every_epochs` epochs and at the end.
        profile: Folder for a trace of the steps `config.logging.profile_steps`.

    Raises:
        DataError: No checkpoint restores, or too many steps in a row are not finite.
        UserError: The batch does not divide over the devices, other data, a full disk.
    """
    options, folder = TrainOptions(**config.train), pathlib.Path(workdir)
    mesh = distributed.make_mesh() if mesh is None else mesh
    distributed.check_batch_size(options.batch_size, mesh)
    num_steps = steps_per_epoch * options.num_epochs
    optimizer = options.make_optimizer(steps_per_epoch)
    create = _initializer(config.seed, options, model, optimizer)
    given = (_first_batch(loader), variables, pretrained)
    loss, ema_decay = loss_options(config), options.ema_decay
    step_fn = make_train_step(model, optimizer, grid, loss=loss, ema_decay=ema_decay)
    keep, size = options.checkpoints_to_keep, options.batch_size
    with Checkpoints(folder / "checkpoints", max_to_keep=keep) as checkpoints:
        placed = create, given, mesh, options.parameter_sharding
        state, step = _restore_or_initialize(checkpoints, loader, info, *placed)
        train_step = _compile(step_fn, state, mesh, config.seed)
        trace = _trace(profile, *LoggingOptions(**config.logging).profile_steps)
        next(trace)
        wandb = _wandb_arguments(config, info)
        with (
            MetricLogger(folder, step, num_steps, size, wandb) as logger,
            distributed.stop_on_signal(mesh) as stop,
        ):
            metrics, is_stopped, is_cut, num_skipped = None, stop(), False, 0
            while step < num_steps and not is_stopped:
                batch = logger.next_batch(loader, metrics)
                trace.send(metrics)
                state, metrics = train_step(state, distributed.put_batch(batch, mesh))
                step += 1
                logger.advance(step, metrics)
                if _is_due(step, options.log_every_steps, num_steps):
                    logger.log(step, metrics, epoch=step / steps_per_epoch)
                    num_skipped = _check_skipped(state, options, num_skipped)
                scores, every = None, options.evaluate_every_epochs * steps_per_epoch
                if evaluate and _is_due(step, every, num_steps):
                    scores = _evaluate(evaluate, state, step, stop, logger)
                    is_cut = scores is None
                is_stopped = stop()
                is_due = _is_due(step, options.checkpoint_every_steps, num_steps)
                if is_due or is_stopped or scores is not None:
                    num_skipped = _check_skipped(state, options, num_skipped)
                    found = None if scores is None else scores.with_best()
                    kept = state.replace(frozen={})
                    checkpoints.save(step, kept, loader, info=info, metrics=found)
            trace.close()
            checkpoints.wait()
    return TrainResult(state, step, finished=step >= num_steps and not is_cut)


def _initializer(
    seed: int,
    options: TrainOptions,
    model: nn.Module,
    optimizer: optax.GradientTransformation,
) -> Callable[[Batch, Any, Any], TrainState]:
    """A function of (batch, variables, pretrained) that makes the state of step 0."""

    def create(batch: Batch, variables: Any, pretrained: Any) -> TrainState:
        if variables is None:
            keys = jax.random.split(jax.random.key(seed))
            rngs = {"params": keys[0], "dropout": keys[1]}
            variables = model.init(rngs, *model_inputs(batch), train=False)
        if pretrained is not None:
            variables = with_pretrained(variables, pretrained)
        is_frozen = getattr(model, "is_frozen", None)
        use_ema = options.ema_decay is not None
        return create_state(variables, optimizer, use_ema=use_ema, is_frozen=is_frozen)

    return create


def _restore_or_initialize(
    checkpoints: Checkpoints,
    loader: Any,
    info: Mapping[str, Any],
    create: Callable[..., TrainState],
    given: tuple[Any, ...],
    mesh: jax.sharding.Mesh,
    parameters: distributed.ParameterSharding,
) -> tuple[TrainState, int]:
    """State and step of the newest checkpoint, or those before the first step.

    Args:
        checkpoints: Of the run.
        loader: Set to the position that was saved.
        info: Its "same" must be what was saved.
        create: From `_initializer`.
        given: Its arguments, with NumPy arrays: the same on every process.
        mesh: Devices that the state is placed on.
        parameters: How they are placed.
    """
    given = jax.tree.map(np.asarray, given)
    abstract = jax.eval_shape(create, *given)
    placement = distributed.state_sharding(abstract, mesh, parameters)
    saved = abstract_state(abstract, placement).replace(frozen={})
    restored = checkpoints.restore(saved, loader)
    if restored is None:
        return jax.jit(create, out_shardings=placement)(*given), 0
    state, saved_info, step = restored
    folder = checkpoints.folder.parent
    _check_same(saved_info.get("same", {}), info.get("same", {}), folder)
    _log.info("continuing from step %d", step)
    if abstract.frozen:  # not saved: these parameters come from where they came from
        frozen = jax.jit(lambda *x: create(*x).frozen, out_shardings=placement.frozen)
        state = state.replace(frozen=frozen(*given))
    return state, step


def loss_options(config: ConfigDict) -> dict[str, Any]:
    """Keyword arguments of `detection_loss`.

    Boxes that "nms" compares with objects are those that decoding would find.
    """
    decode = config.decode
    nms = NmsAssignment(
        score_threshold=decode.score_threshold,
        threshold_inclusive=decode.threshold_inclusive,
        nms_iou=decode.nms_iou,
        per_class=decode.per_class_nms,
    )
    return {**config.loss.to_dict(), "nms": nms}


def _first_batch(loader: Any) -> Batch:
    """One empty frame of the right shapes; the iterator stays where it is."""
    position = loader.get_state()
    batch = next(loader)
    loader.set_state(position)
    return jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)


def _check_same(
    found: Mapping[str, Any], given: Mapping[str, Any], folder: pathlib.Path
) -> None:
    """Raises `UserError` if a run would continue with other data or frozen weights."""
    if lines := files.differences(found, {k: given.get(k) for k in found}, ""):
        raise UserError(
            f"the run in {folder} was trained with something else: {'; '.join(lines)}; "
            "give the same, or another --workdir"
        )


def _compile(
    step: Step, state: TrainState, mesh: jax.sharding.Mesh, seed: int
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """The step of a run, for states placed as this one; it consumes its state.

    It returns before it is computed, unless too many steps are under way.
    """
    whole = distributed.replicated(mesh)
    placement = jax.tree.map(lambda x: x.sharding, state)
    compiled = jax.jit(step, donate_argnums=0, out_shardings=(placement, whole))
    rng = jax.jit(jax.random.key, out_shardings=whole)(np.uint32(seed + 1))
    in_flight: collections.deque[Metrics] = collections.deque()

    def limited(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        with jax.transfer_guard("disallow"):
            state, metrics = compiled(state, batch, rng)
        in_flight.append(metrics)
        if len(in_flight) > _STEPS_IN_FLIGHT:
            jax.block_until_ready(in_flight.popleft())
        return state, metrics

    return limited


def _trace(folder: str, first: int, last: int) -> Generator[None, Any, None]:
    """Traces steps `first` to `last`; each step begins with `send(metrics before it)`."""
    step = -1
    try:
        while True:
            metrics = yield
            step += 1
            if folder and step == first:
                jax.profiler.start_trace(folder)
            if folder and step == last + 1:
                jax.block_until_ready(metrics)
                jax.profiler.stop_trace()
    finally:
        if folder and first <= step <= last:
            jax.profiler.stop_trace()
        if folder and step < first:
            _log.warning("no trace: this start ended before step %d", first)


def _wandb_arguments(
    config: ConfigDict, info: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Project and config of a run at Weights & Biases; None without one."""
    if not config.logging.wandb:
        return None
    return {"project": config.logging.wandb_project, "config": info.get("config", {})}


def _is_due(step: int, every: int, last: int) -> bool:
    """True every so many steps (never for 0) and, where it is done at all, at the end."""
    return every > 0 and (step % every == 0 or step == last)


def _evaluate(
    evaluate: Evaluate,
    state: TrainState,
    step: int,
    stop: Callable[[], bool],
    logger: MetricLogger,
) -> Scores | None:
    """Scores, logged; None where a signal ended the evaluation early."""
    try:
        scores = evaluate(state, step, stop)
    except distributed.Stopped:
        _log.warning("the evaluation after step %d is skipped", step)
        return None
    logger.log_scores(step, scores)
    logger.restart_timer(step)
    return scores


def _check_skipped(state: TrainState, options: TrainOptions, reported: int) -> int:
    """Warns of steps without a finite loss and gradient beyond those `reported`.

    Returns:
        How many there were so far.

    Raises:
        DataError: Too many were in a row.
    """
    limit, counts = options.max_skipped_steps, state.opt_state
    if (in_row := int(counts.notfinite_count)) > limit:
        raise DataError(
            f"loss or gradient was not finite in {in_row} steps in a row (limit "
            f"config.train.max_skipped_steps={limit})"
        )
    if (skipped := int(counts.total_notfinite)) > reported:
        _log.warning(
            "%d steps so far were skipped because loss or gradient was not finite",
            skipped,
        )
    return skipped
