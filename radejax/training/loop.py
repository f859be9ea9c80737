"""Training loop with logging, evaluation and checkpoints for any number of devices."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import logging
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import optax
from jax.extend.core import ClosedJaxpr
from jax.interpreters import partial_eval

from radejax.config import Config
from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.structures import Batch
from radejax.geometry.radar_grid import RadarGrid
from radejax.training import distributed
from radejax.training.checkpoints import Checkpoints
from radejax.training.metric_logger import MetricLogger, Scores
from radejax.training.step import (
    Metrics,
    Step,
    TrainState,
    count_steps,
    create_state,
    make_optimizer,
    make_schedule,
    make_train_step,
    with_pretrained,
)

_log = logging.getLogger(__name__)

_STEPS_IN_FLIGHT = 2  # more steps would only keep more batches in memory

Evaluate = Callable[[Mapping[str, Any], Callable[[], bool]], Scores]
"""Function that evaluates variables during training. Its arguments are the variables, with
averaged parameters if there are any, and a function that returns whether to stop, which every
process must call equally often. If that returns True, it raises `distributed.Stopped`."""

TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def train(
    config: Config,
    model: nn.Module,
    loader: Any,
    grid: RadarGrid,
    workdir: str | pathlib.Path,
    *,
    info: Mapping[str, Any],
    steps_per_epoch: int,
    variables: Mapping[str, Any] | None = None,
    pretrained: Mapping[str, Any] | None = None,
    evaluate: Evaluate | None = None,
    profile: str = "",
) -> tuple[TrainState, bool]:
    """Trains a model for the configured epochs or steps, or continues from the newest checkpoint.

    Args:
        config: Config of the run, of which the
            fields `seed`, `train`, `loss`, `decode` and `logging` are used.
        model: Model, which is called as `model.apply(variables, *inputs, train=True)`.
        loader: Endless, checkpointable grain iterator of `Batch`.
        grid: Grid of the model's maps.
        workdir: Folder of checkpoints and logs.
        info: Plain values that are saved in each checkpoint. The value of "same" must be
            the same whenever the run continues.
        steps_per_epoch: Number of batches of one pass over the data.
        variables: Variables to start from; initialized from the seed if None.
        pretrained: Part of the variables that replaces initialized ones.
        evaluate: Function that is called every `evaluate_every_epochs` epochs and, unless
            this field is 0, after the last step.
        profile: Folder for a profiler trace of the steps `config.logging.profile_steps`,
            counted from the first step of this call.

    Returns:
        The state, placed on all devices, and whether the training is finished. It is not
        finished if a signal ended the training or its last evaluation early; the state is
        saved in that case.

    Raises:
        DataError: No checkpoint can be restored, or the loss or gradient was not finite in
            too many consecutive steps.
        UserError: The run would continue with other data, the warm-up is too long, or no
            space is left on the disk.
    """
    options, folder = config.train, files.as_path(workdir)
    schedule = make_schedule(options, steps_per_epoch)
    optimizer = make_optimizer(options, schedule)
    step_fn = make_train_step(
        model,
        optimizer,
        grid,
        loss=config.loss,
        decoding=config.decode,
        ema_decay=options.ema_decay,
    )
    create = functools.partial(
        create_state,
        optimizer=optimizer,
        use_ema=options.ema_decay is not None,
        is_frozen=getattr(model, "is_frozen", None),
    )
    given = jax.tree.map(np.asarray, (_empty_batch(loader), variables, pretrained))
    initial = functools.partial(_initial_variables, model, config.seed, *given)
    mesh = distributed.make_mesh()
    kept = options.checkpoints_to_keep
    with Checkpoints(folder / "checkpoints", max_to_keep=kept) as checkpoints:
        state = _restore_or_initialize(
            checkpoints, loader, info, initial, create, mesh, options.parameter_sharding
        )
        train_step = _compile(step_fn, state, mesh, config.seed)
        num_steps = count_steps(options, steps_per_epoch)
        logger = MetricLogger(folder, config, int(state.step), num_steps)
        with logger, distributed.stop_on_signal(mesh) as stop:
            run = _Run(
                *(config, steps_per_epoch, num_steps, loader, info, evaluate),
                *(checkpoints, logger, stop, schedule),
            )
            return run.take_steps(train_step, state, profile)


def _trace(folder: str) -> contextlib.AbstractContextManager[None]:
    """Writes a profiler trace of a block, without the calls of Python functions.

    Stopping the tracer of Python functions can crash the process while threads are running.
    """
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0
    return jax.profiler.trace(folder, profiler_options=options)


@dataclasses.dataclass
class _Run:
    """Takes the steps of a run; the attributes are arguments and objects of `train`."""

    config: Config
    steps_per_epoch: int
    num_steps: int
    loader: Any
    info: Mapping[str, Any]
    evaluate: Evaluate | None
    checkpoints: Checkpoints
    logger: MetricLogger
    stop: Callable[[], bool]
    schedule: optax.Schedule
    num_skipped: int = 0  # steps that were skipped and reported so far

    def take_steps(
        self, train_step: TrainStep, state: TrainState, profile: str
    ) -> tuple[TrainState, bool]:
        """Takes the remaining steps until a signal arrives; returns the result of `train`."""
        step, num_steps = int(state.step), self.num_steps
        first, last = (step + n for n in self.config.logging.profile_steps)
        if profile and num_steps <= first:
            _log.warning("no trace: %d steps are left to train", num_steps - step)
        metrics, is_stopped = None, self.stop()
        with contextlib.ExitStack() as trace:
            while step < num_steps and not is_stopped:
                batch = self.logger.next_batch(self.loader, metrics)
                if profile and step == first:
                    trace.enter_context(_trace(profile))
                state, metrics = train_step(state, batch)
                if profile and step == last:
                    jax.block_until_ready(metrics)
                    trace.close()
                step += 1
                is_stopped = self._finish_step(step, state, metrics)
            self.checkpoints.wait()
        return state, step >= num_steps and not is_stopped

    def _finish_step(self, step: int, state: TrainState, metrics: Metrics) -> bool:
        """Logs, evaluates and saves if it is due; returns whether a signal arrived."""
        train = self.config.train
        self.logger.advance(step, metrics)
        is_logged = self._is_due(step, train.log_every_steps)
        if is_logged:
            rate = {"learning_rate": self.schedule(step - 1)}
            self.logger.log(step, metrics | rate, epoch=step / self.steps_per_epoch)
        scores = None
        every = self.steps_per_epoch * train.evaluate_every_epochs
        if self.evaluate is not None and self._is_due(step, every):
            try:
                scores = self.evaluate(state.eval_variables, self.stop)
                self.logger.log_scores(step, scores)
            except distributed.Stopped:
                _log.warning("the evaluation after step %d is skipped", step)
        is_stopped = self.stop()
        is_saved = self._is_due(step, train.checkpoint_every_steps)
        is_saved |= is_stopped or scores is not None
        if is_logged or is_saved:
            self._check_skipped(state)
        if is_saved:
            best = None if scores is None else scores.best
            kept = state.replace(frozen={})
            self.checkpoints.save(step, kept, self.loader, info=self.info, best=best)
        return is_stopped

    def _is_due(self, step: int, every: int) -> bool:
        """Returns whether an action is due that is done every `every` steps and at the end.

        An action with `every` 0 is never due.
        """
        return every > 0 and (step % every == 0 or step == self.num_steps)

    def _check_skipped(self, state: TrainState) -> None:
        """Warns of new steps that were skipped because loss or gradient was not finite.

        Raises:
            DataError: More than `max_skipped_steps` consecutive steps were skipped.
        """
        limit = self.config.train.max_skipped_steps
        if (in_row := int(state.num_skipped_in_row)) > limit:
            raise DataError(
                f"loss or gradient was not finite in {in_row} steps in a row (limit "
                f"config.train.max_skipped_steps={limit})"
            )
        if (skipped := int(state.num_skipped)) > self.num_skipped:
            _log.warning(
                "%d steps so far were skipped because loss or gradient was not finite",
                skipped,
            )
        self.num_skipped = skipped


def _initial_variables(
    model: nn.Module, seed: int, batch: Batch, variables: Any, pretrained: Any
) -> Any:
    """Creates the variables of step 0; the batch has the shapes of the model's inputs."""
    if variables is None:
        init_key, _ = _keys(seed)
        variables = model.init(init_key, *batch.model_inputs(), train=False)
    return variables if pretrained is None else with_pretrained(variables, pretrained)


def _keys(seed: int | jax.Array) -> jax.Array:
    """Returns the keys of the initial parameters and of the steps."""
    return jax.random.split(jax.random.key(seed))


def _restore_or_initialize(
    checkpoints: Checkpoints,
    loader: Any,
    info: Mapping[str, Any],
    initial: Callable[[], Any],
    create: Callable[[Any], TrainState],
    mesh: jax.sharding.Mesh,
    parameters: distributed.ParameterSharding,
) -> TrainState:
    """Restores the state of the newest checkpoint, or creates the initial state.

    Args:
        checkpoints: Checkpoints of the run.
        loader: Iterator that is set to the saved position.
        info: Plain values of the run, whose "same" must equal the saved one.
        initial: Function that returns the variables before the first step.
        create: Function that creates the state before the first step from them.
        mesh: Devices on which the state is placed.
        parameters: Placement of the parameters, see `distributed.state_sharding`.

    Raises:
        DataError: There are checkpoints, but none can be restored.
        UserError: The run would continue with other data or frozen weights.
    """
    traced, shapes = jax.make_jaxpr(initial, return_shape=True)()
    abstract = jax.eval_shape(create, shapes)
    placement = distributed.state_sharding(abstract, mesh, parameters)
    saved = jax.tree.map(lambda x, s: x.update(sharding=s), abstract, placement)
    restored = checkpoints.restore(saved.replace(frozen={}), loader)
    if restored is None:
        state = jax.jit(create, out_shardings=placement)(_evaluate(traced, shapes))
        return jax.device_put(state, placement)  # `jax_disable_jit` ignores `placement`
    state, saved_info, step = restored
    found, same = saved_info.get("same", {}), info.get("same", {})
    if lines := files.differences(found, {k: same.get(k) for k in found}, ""):
        raise UserError(
            f"the run in {checkpoints.folder.parent} was trained with something else: "
            f"{'; '.join(lines)}; give the same, or another --workdir"
        )
    _log.info("continuing from step %d", step)
    if abstract.frozen:  # checkpoints do not contain frozen parameters
        frozen = jax.jit(lambda x: create(x).frozen, out_shardings=placement.frozen)
        state = state.replace(frozen=frozen(_evaluate(traced, shapes)))
    return state


def _evaluate(traced: ClosedJaxpr, shapes: Any) -> Any:
    """Returns the results of a traced function as a tree of NumPy arrays.

    Only the operations that the results need are executed, one at a time. In one program,
    each of a hundred random generators would be compiled on its own, which takes half as
    long as the compilation of a training step.
    """
    is_result = [True] * len(traced.jaxpr.outvars)
    needed, _ = partial_eval.dce_jaxpr(traced.jaxpr, is_result, instantiate=True)
    leaves = jax.core.eval_jaxpr(needed, traced.consts)
    return jax.tree.unflatten(jax.tree.structure(shapes), map(np.asarray, leaves))


def _empty_batch(loader: Any) -> Batch:
    """Returns a batch of one empty frame in the loader's shapes, and keeps its position."""
    position = loader.get_state()
    batch = next(loader)
    loader.set_state(position)
    return jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)


def _compile(
    step: Step, state: TrainState, mesh: jax.sharding.Mesh, seed: int
) -> TrainStep:
    """Compiles the step of a run for states with the shardings of `state`.

    The compiled step donates the buffers of its input state and takes the batch of this
    process. It returns before the computation ends, and waits only if more than
    `_STEPS_IN_FLIGHT` steps are in flight.
    """
    whole = distributed.replicated(mesh)
    placement = jax.tree.map(lambda x: x.sharding, state)
    compiled = jax.jit(step, donate_argnums=0, out_shardings=(placement, whole))
    loop_key = jax.jit(lambda seed: _keys(seed)[1], out_shardings=whole)
    rng = loop_key(np.uint32(seed))
    in_flight: collections.deque[Metrics] = collections.deque()

    def limited(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        placed = distributed.put_batch(batch, mesh)
        with jax.transfer_guard("allow" if _is_debugging() else "disallow"):
            state, metrics = compiled(state, placed, rng)
        in_flight.append(metrics)
        if len(in_flight) > _STEPS_IN_FLIGHT:
            jax.block_until_ready(in_flight.popleft())
        return state, metrics

    return limited


def _is_debugging() -> bool:
    """Returns whether JAX runs operations one at a time, which transfers their arguments."""
    names = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit")
    return any(jax.config.values[name] for name in names)
