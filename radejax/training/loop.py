"""The training loop: from a data iterator to checkpoints, for any number of devices."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax.core.errors import DataError
from radejax.geometry.radar_grid import RadarGrid
from radejax.training import processes, sharding
from radejax.training.checkpoints import Checkpoints
from radejax.training.clock import Trace
from radejax.training.start import compile_step, initial, optimizer_of, restore
from radejax.training.state import TrainState
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


def train(
    model: nn.Module,
    variables: Mapping[str, Any] | None,
    loader: Any,
    grid: RadarGrid,
    workdir: str | pathlib.Path,
    *,
    options: Any,
    loss: Mapping[str, Any],
    watch: Any,
    seed: int,
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
            them from `seed`.
        loader: Checkpointable grain iterator of `Batch`; endless.
        grid: Grid of the model's maps.
        workdir: Checkpoints and logs go here.
        options: The fields of `train` in `core.config`, as attributes.
        loss: Keyword arguments of `detection_loss`.
        watch: The fields of `watch` in `core.config`, as attributes.
        seed: Of drawn variables and of everything random in a step.
        info: Plain values that each checkpoint carries. Those under "same" are the
            same on every start of a run; "config" is shown by Weights & Biases.
        steps_per_epoch: Batches of one pass over the data.
        mesh: Devices to use; all by default.
        evaluate: Called every `evaluate_every_epochs` epochs and at the end; what it
            returns is logged and kept with the checkpoint, and the best checkpoint is
            kept as well as the newest ones.
        pretrained: Part of the variables that takes the place of drawn ones, an image
            backbone's weights for example.
        trace_folder: Writes a trace of the steps `watch.profile_steps` there.
        frame_names: What `Batch.frame` counts, for messages; its numbers if None.

    Raises:
        DataError: More than `max_skipped_steps` steps in a row without a finite loss
            and gradient; names the frames of the last such batch.
        UserError: A configuration that does not fit the devices; a run that continues
            with another `info["same"]`; a full disk.
    """
    # State ---------------------------------------------------------------------------
    mesh = sharding.make_mesh() if mesh is None else mesh
    sharding.check_batch_size(
        options.batch_size, mesh, "train.batch_size", options.num_accumulate
    )
    num_steps = steps_per_epoch * options.num_epochs
    optimizer = optimizer_of(options, num_steps)
    init = initial(model, optimizer, options, seed, loader, variables, pretrained)

    # Restore -------------------------------------------------------------------------
    folder, keep = pathlib.Path(workdir), options.checkpoints_to_keep
    with Checkpoints(folder / "checkpoints", max_to_keep=keep) as checkpoints:
        how = options.parameter_sharding
        state, start = restore(checkpoints, loader, init, mesh, how, info)
        if start:
            _log.info("continuing from step %d of %d", start, num_steps)
        del init
        step_fn = compile_step(model, optimizer, grid, state, mesh, options, loss, seed)

        # Loop ------------------------------------------------------------------------
        with (
            Watch(
                folder,
                start_step=start,
                num_steps=num_steps,
                frames_per_step=options.batch_size,
                wandb_project=watch.wandb_project if watch.wandb else None,
                config=info.get("config"),
            ) as logs,
            contextlib.closing(Trace(trace_folder, *watch.profile_steps)) as trace,
            processes.stop_on_signal(mesh) as stop,
        ):
            step, metrics, is_stopped, is_cut = start, None, stop(), False
            while step < num_steps and not is_stopped:
                with logs.timing("data", behind=metrics):
                    batch = next(loader)
                trace.before_step()
                batch = sharding.put_batch(batch, mesh)
                with logs.timing("compute"):
                    state, metrics = step_fn(state, batch)
                with logs.timing("other"):  # writing a trace takes seconds
                    trace.after_step(metrics)
                step += 1
                logs.tick(step, metrics)
                if _is_due(step, options.log_every_steps, num_steps):
                    logs.log(step, metrics, epoch=step / steps_per_epoch)
                    _check_skipped(state, options.max_skipped_steps, frame_names)
                scores, every = None, options.evaluate_every_epochs * steps_per_epoch
                if evaluate is not None and _is_due(step, every, num_steps):
                    scores = _evaluate(evaluate, state, step, stop, logs)
                    is_cut = scores is None
                is_stopped = stop()

                # Save ----------------------------------------------------------------
                due = _is_due(step, options.checkpoint_every_steps, num_steps)
                if due or is_stopped or scores is not None:
                    _check_skipped(state, options.max_skipped_steps, frame_names)
                    saved, found = (
                        state.replace(frozen={}),
                        scores and scores.with_best(),
                    )
                    checkpoints.save(step, saved, loader, info=info, metrics=found)
            checkpoints.wait()
    return TrainResult(state, step, finished=step >= num_steps and not is_cut)


def _is_due(step: int, every: int, last: int) -> bool:
    """True every so many steps (never for 0) and, where it is done at all, at the end."""
    return every > 0 and (step % every == 0 or step == last)


def _evaluate(
    evaluate: Evaluate,
    state: TrainState,
    step: int,
    stop: Callable[[], bool],
    logs: Watch,
) -> Scores | None:
    """Scores, logged; None where a signal cut the evaluation short."""
    try:
        with logs.timing("other"):
            scores = evaluate(state, step, stop)
            logs.log_scores(step, scores)
    except processes.Stopped:
        _log.warning("the evaluation after step %d is left out", step)
        return None
    return scores


def _check_skipped(
    state: TrainState, limit: int, frame_names: Sequence[str] | None
) -> None:
    """`DataError` where too many steps in a row had no finite loss and gradient."""
    in_row = int(state.most_skipped_in_row)
    if in_row > limit:
        frames = np.asarray(state.skipped_frames).tolist()
        if frame_names is not None:
            frames = [frame_names[i] for i in frames]
        raise DataError(
            f"loss or gradient was not finite in {in_row} steps in a row (limit "
            f"train.max_skipped_steps={limit}); frames of the last batch: "
            + ", ".join(map(str, frames))
        )
