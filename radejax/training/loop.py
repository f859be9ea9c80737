"""The training loop: from a data iterator to checkpoints, for any number of devices."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import logging
import pathlib
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax.core.errors import DataError, UserError
from radejax.core.structures import Batch
from radejax.data.encoding import model_inputs
from radejax.geometry.radar_grid import RadarGrid
from radejax.training import processes, sharding
from radejax.training.checkpoints import BEST, Checkpoints, abstract_state
from radejax.training.clock import Trace, seconds_since_start
from radejax.training.state import (
    TrainState,
    create_state,
    make_optimizer,
    make_schedule,
)
from radejax.training.step import make_train_step
from radejax.training.watch import Scores, Watch

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """How a training ended.

    Attributes:
        state: Placed on the mesh.
        step: Steps taken in all, over every start of the run.
        finished: False where a SIGTERM ended it, or its last evaluation, early; the
            state is saved.
    """

    state: TrainState
    step: int
    finished: bool


Evaluate = Callable[[TrainState, int, Callable[[], bool]], Scores]
"""Called with the state, its step, and what tells whether to stop; it then raises
`processes.Stopped`. To be asked as often by every process."""

_STEPS_IN_FLIGHT = 2  # more would only pile up batches in memory


def train(
    model: nn.Module,
    variables: Mapping[str, Any] | None,
    loader: Any,
    grid: RadarGrid,
    workdir: str | pathlib.Path,
    *,
    config: Any,
    info: Mapping[str, Any],
    steps_per_epoch: int,
    mesh: jax.sharding.Mesh | None = None,
    evaluate: Evaluate | None = None,
    pretrained: Mapping[str, Any] | None = None,
    trace_folder: str = "",
    frame_names: Sequence[str] | None = None,
) -> TrainResult:
    """Trains until the configured epochs are done, from where an earlier start ended.

    Args:
        model: Called as `model.apply(variables, *inputs, train=True)`.
        variables: To start from, an imported checkpoint's for example; None draws
            them from `config.seed`.
        loader: Checkpointable grain iterator of `Batch`; endless.
        grid: Grid of the model's maps.
        workdir: Checkpoints and logs go here.
        config: The whole configuration; `seed`, `loss`, `train` and `watch` are read.
        info: Plain values that each checkpoint carries. Those under "same" are the
            same on every start of a run.
        steps_per_epoch: Batches of one pass over the data.
        mesh: Devices to use; all by default.
        evaluate: Called every `train.evaluate_every_epochs` epochs and at the end; what
            it returns is logged and kept with the checkpoint, and the best checkpoint
            is kept as well as the newest ones.
        pretrained: Part of the variables that takes the place of drawn ones, an image
            backbone's weights for example.
        trace_folder: Writes a trace of the steps `watch.profile_steps` there.
        frame_names: What `Batch.frame` counts, for messages; its numbers if None.

    Raises:
        DataError: More than `train.max_skipped_steps` steps in a row without a finite
            loss and gradient; names the frames of the last such batch.
        UserError: A configuration that does not fit the devices; a run that continues
            with another `info["same"]`; a full disk.
    """
    workdir = pathlib.Path(workdir)
    mesh = sharding.make_mesh() if mesh is None else mesh
    options = config.train
    num_steps = steps_per_epoch * options.num_epochs
    sharding.check_batch_size(
        options.batch_size, mesh, "train.batch_size", options.num_accumulate
    )
    optimizer = make_optimizer(
        make_schedule(
            learning_rate=options.learning_rate,
            final_learning_rate=options.final_learning_rate,
            num_steps=num_steps,
            warmup_steps=options.warmup_steps,
        ),
        weight_decay=options.weight_decay,
        gradient_clip_norm=options.gradient_clip_norm,
    )
    init = functools.partial(_init_state, model, optimizer, config)
    # NumPy arrays: the same on every process, and so on every device.
    given = _first_batch(loader), *jax.tree.map(np.asarray, (variables, pretrained))
    abstract = jax.eval_shape(init, *given)
    placement = sharding.state_sharding(abstract, mesh, options.parameter_sharding)
    step_fn = jax.jit(
        make_train_step(
            model,
            optimizer,
            grid,
            loss=dict(config.loss),
            num_accumulate=options.num_accumulate,
            ema_decay=options.ema_decay,
        ),
        donate_argnums=0,
        out_shardings=(placement, sharding.replicated(mesh)),
    )
    rng = jax.jit(jax.random.key, out_shardings=sharding.replicated(mesh))(
        np.uint32(config.seed + 1)
    )
    checkpoints = Checkpoints(
        workdir / "checkpoints",
        max_to_keep=options.checkpoints_to_keep,
        best_metric=BEST,
    )
    with checkpoints:
        # Frozen parameters are not in a checkpoint: they come from where they came from.
        saved = abstract_state(abstract, placement).replace(frozen={})
        restored, found, step = checkpoints.restore(saved, loader) or (None, {}, 0)
        _check_same(found.get("same", {}), info.get("same", {}), workdir)
        state = restored
        if restored is None or abstract.frozen:
            state = jax.jit(
                init, out_shardings=placement, compiler_options=_init_options(mesh)
            )(*given)
        if restored is not None:
            state = restored.replace(frozen=state.frozen)
            _log.info("continuing from step %d of %d", step, num_steps)
        del given, restored
        trace = Trace(trace_folder, *config.watch.profile_steps)
        run = _Run(
            step_fn,
            loader,
            mesh,
            rng,
            checkpoints,
            info,
            options,
            evaluate,
            trace,
            frame_names,
        )
        with Watch(
            workdir,
            start_step=step,
            num_steps=num_steps,
            frames_per_step=options.batch_size,
            is_main=processes.is_main(),
            wandb_project=config.watch.wandb_project if config.watch.wandb else None,
            config=info.get("config"),
        ) as watch:
            return run(state, step, num_steps, steps_per_epoch, watch)


@dataclasses.dataclass
class _Run:
    """The loop itself, with what stays the same from step to step."""

    step_fn: Callable
    loader: Any
    mesh: jax.sharding.Mesh
    rng: jax.Array
    checkpoints: Checkpoints
    info: Mapping[str, Any]
    options: Any
    evaluate: Evaluate | None
    trace: Trace
    frame_names: Sequence[str] | None
    in_flight: collections.deque = dataclasses.field(default_factory=collections.deque)

    def __call__(
        self,
        state: TrainState,
        start: int,
        num_steps: int,
        steps_per_epoch: int,
        watch: Watch,
    ) -> TrainResult:
        options, saved = self.options, start
        with _StopOnSignal() as event, contextlib.closing(self.trace):
            stop = processes.AgreedStop(event, self.mesh)
            step, is_cut = start, False
            while step < num_steps and not stop():
                state, metrics = self._step(state, watch, step, is_first=step == start)
                step += 1
                watch.tick(step)
                if step % options.log_every_steps == 0 or step == num_steps:
                    watch.log(step, metrics, epoch=step / steps_per_epoch)
                    self._check_skipped(state)
                scores = None
                if self._is_evaluated(step, num_steps, steps_per_epoch):
                    scores = self._evaluate(state, step, watch, stop)
                    is_cut = scores is None
                due = step % options.checkpoint_every_steps == 0 or step == num_steps
                if due or scores is not None:
                    self._save(step, state, scores)
                    saved = step
            if saved < step:
                self._save(step, state, None)
            self.checkpoints.wait()
        finished = step >= num_steps and not is_cut
        return TrainResult(state=state, step=step, finished=finished)

    def _step(
        self, state: TrainState, watch: Watch, step: int, *, is_first: bool
    ) -> tuple[TrainState, Mapping[str, jax.Array]]:
        """One step, begun; its time goes to data, host and compute."""
        clock, busy = watch.clock, state.step
        clock.lap("host")
        batch = next(self.loader)
        # While devices still work, nobody waits for data.
        clock.lap("data" if is_first or busy.is_ready() else "compute")
        self.trace.before_step()
        batch = sharding.put_batch(batch, self.mesh)
        clock.lap("host")
        with jax.transfer_guard("disallow"):
            state, metrics = self.step_fn(state, batch, self.rng)
        self.in_flight.append(metrics)
        if len(self.in_flight) > _STEPS_IN_FLIGHT:
            jax.block_until_ready(self.in_flight.popleft())
        if is_first:
            jax.block_until_ready(metrics)
            took = clock.lap("compute")
            watch.start_timing(step + 1)
            _log.info(
                "first step %.1f s after the start, %.1f s of it to compile and run it",
                seconds_since_start(),
                took,
            )
        clock.lap("compute")
        self.trace.after_step(metrics)
        clock.lap("other")  # writing a trace takes seconds
        return state, metrics

    def _is_evaluated(self, step: int, num_steps: int, steps_per_epoch: int) -> bool:
        every = self.options.evaluate_every_epochs * steps_per_epoch
        if self.evaluate is None or not every:
            return False
        return step % every == 0 or step == num_steps

    def _evaluate(
        self,
        state: TrainState,
        step: int,
        watch: Watch,
        stop: Callable[[], bool],
    ) -> Scores | None:
        """None where a signal cut it short: the state is then saved without scores."""
        watch.clock.lap("host")
        try:
            scores = self.evaluate(state, step, stop)
        except processes.Stopped:
            _log.warning("the evaluation after step %d is left out", step)
            return None
        watch.log_scores(step, scores)
        watch.clock.lap("other")
        return scores

    def _save(self, step: int, state: TrainState, scores: Scores | None) -> None:
        self._check_skipped(state)
        metrics = None
        if scores is not None and scores.best is not None:
            metrics = {**scores.values, BEST: scores.best}
        self.checkpoints.save(
            step,
            state.replace(frozen={}),
            self.loader,
            info=self.info,
            metrics=metrics,
        )

    def _check_skipped(self, state: TrainState) -> None:
        in_row, limit = int(state.most_skipped_in_row), self.options.max_skipped_steps
        if in_row > limit:
            frames = np.asarray(state.skipped_frames).tolist()
            if self.frame_names is not None:
                frames = [self.frame_names[i] for i in frames]
            raise DataError(
                f"loss or gradient was not finite in {in_row} steps in a row (limit "
                f"train.max_skipped_steps={limit}); frames of the last batch: "
                + ", ".join(map(str, frames))
            )


def _check_same(
    found: Mapping[str, Any], given: Mapping[str, Any], workdir: pathlib.Path
) -> None:
    """`UserError` where a run would continue with other data or frozen weights."""
    differing = [
        f"{name}: {found[name]} there, {given.get(name)} now"
        for name in found
        if found[name] != given.get(name)
    ]
    if differing:
        raise UserError(
            f"the run in {workdir} was trained with something else: "
            f"{'; '.join(differing)}. Give the same, or another --workdir"
        )


def _init_state(
    model: nn.Module,
    optimizer: Any,
    config: Any,
    batch: Batch,
    variables: Mapping[str, Any] | None,
    pretrained: Mapping[str, Any] | None,
) -> TrainState:
    """State before the first step; what is given need not be drawn."""
    if variables is None:
        keys = jax.random.split(jax.random.key(config.seed))
        rngs = {"params": keys[0], "dropout": keys[1]}
        variables = model.init(rngs, *model_inputs(batch), train=False)
    if pretrained is not None:
        from radejax.models.dinorade import with_pretrained

        variables = with_pretrained(variables, pretrained)
    return create_state(
        variables,
        optimizer,
        batch_size=config.train.batch_size,
        use_ema=config.train.ema_decay is not None,
        is_frozen=getattr(model, "is_frozen", None),
    )


def _init_options(mesh: jax.sharding.Mesh) -> dict[str, Any]:
    """Compiles the drawing of parameters in half the time where LLVM does it.

    It runs once, and hundreds of random generators take long to optimise; the numbers
    are the same.
    """
    is_cpu = mesh.devices.flat[0].platform == "cpu"
    return {"xla_backend_optimization_level": 1} if is_cpu else {}


def _first_batch(loader: Any) -> Batch:
    """One empty frame of the right shapes, without moving the iterator on."""
    position = loader.get_state()
    batch = next(loader)
    loader.set_state(position)
    return jax.tree.map(lambda x: np.zeros((1, *x.shape[1:]), x.dtype), batch)


class _StopOnSignal:
    """Set once SIGTERM or SIGINT arrives; the step under way is finished first."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> threading.Event:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._previous[number] = signal.signal(number, self._handle)
        return self._event

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            # None: set outside Python, by jax.distributed; it cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def _handle(self, number: int, _: Any) -> None:
        if self._event.is_set():
            raise KeyboardInterrupt(f"second {signal.Signals(number).name}")
        _log.warning(
            "%s: saving a checkpoint, then stopping", signal.Signals(number).name
        )
        self._event.set()
