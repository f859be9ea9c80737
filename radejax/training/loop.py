"""The training loop: from a data iterator to checkpoints, for any number of devices."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax.core.errors import DataError
from radejax.geometry.radar_grid import RadarGrid
from radejax.training import processes, sharding
from radejax.training.checkpoints import Checkpoints
from radejax.training.clock import Trace
from radejax.training.start import Plan, compile_step, initial, restore
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
    plan: Plan,
    *,
    mesh: jax.sharding.Mesh | None = None,
    evaluate: Evaluate | None = None,
) -> TrainResult:
    """Trains until the epochs of the plan are done, from where an earlier start ended.

    Args:
        model: Called as `model.apply(variables, *inputs, train=True)`.
        variables: To start from, an imported checkpoint's for example; None draws them.
        loader: Checkpointable grain iterator of `Batch`; endless.
        grid: Grid of the model's maps.
        workdir: Checkpoints and logs go here.
        plan: What is trained, and how.
        mesh: Devices to use; all by default.
        evaluate: Called every `evaluate_every_epochs` epochs and at the end. What it
            returns is logged and kept with the checkpoint, of which the best stays.

    Raises:
        DataError: More than `max_skipped_steps` steps in a row without a finite loss
            and gradient; names the frames of the last such batch.
        UserError: Batches that do not fit the devices, another `plan.info["same"]` than
            the run began with, a full disk.
    """
    # State, restored or drawn --------------------------------------------------------
    mesh = sharding.make_mesh() if mesh is None else mesh
    optimizer, options, num_steps = plan.optimizer(), plan.options, plan.num_steps
    init = initial(model, variables, loader, optimizer, plan)
    folder, keep = pathlib.Path(workdir), options.checkpoints_to_keep
    with Checkpoints(folder / "checkpoints", max_to_keep=keep) as checkpoints:
        state, start = restore(checkpoints, loader, init, mesh, plan)
        step_fn = compile_step(model, grid, optimizer, state, mesh, plan)

        # Loop ------------------------------------------------------------------------
        trace = Trace(plan.trace_folder, *plan.watch.profile_steps)
        with (
            Watch(folder, start, num_steps, options.batch_size, plan.wandb) as logs,
            contextlib.closing(trace),
            processes.stop_on_signal(mesh) as stop,
        ):
            step, metrics, is_stopped, is_cut = start, None, stop(), False
            told = int(state.num_skipped)
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
                    logs.log(step, metrics, epoch=step / plan.steps_per_epoch)
                    told = _check_skipped(state, plan, told)
                scores, every = None, options.evaluate_every_epochs
                if evaluate and _is_due(step, every * plan.steps_per_epoch, num_steps):
                    scores = _evaluate(evaluate, state, step, stop, logs)
                    is_cut = scores is None
                is_stopped = stop()

                # Save ----------------------------------------------------------------
                is_due = _is_due(step, options.checkpoint_every_steps, num_steps)
                if is_due or is_stopped or scores is not None:
                    told = _check_skipped(state, plan, told)
                    found = None if scores is None else scores.with_best()
                    kept = state.replace(frozen={})
                    checkpoints.save(step, kept, loader, info=plan.info, metrics=found)
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


def _check_skipped(state: TrainState, plan: Plan, told: int) -> int:
    """Tells of steps without a finite loss and gradient beyond those `told` of.

    Returns:
        How many there were so far.

    Raises:
        DataError: Too many were in a row.
    """
    in_row, limit = int(state.most_skipped_in_row), plan.options.max_skipped_steps
    if (skipped := int(state.num_skipped)) > told or in_row > limit:
        frames = np.asarray(state.skipped_frames).tolist()
        if plan.frame_names is not None:
            frames = [plan.frame_names[i] for i in frames]
        last = f"frames of the last batch: {', '.join(map(str, frames))}"
        if in_row > limit:
            raise DataError(
                f"loss or gradient was not finite in {in_row} steps in a row (limit "
                f"train.max_skipped_steps={limit}); {last}"
            )
        _log.warning(
            "%d steps so far were skipped, as their loss or gradient was not finite; %s",
            skipped,
            last,
        )
    return skipped
