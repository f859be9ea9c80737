"""Logs of a run: progress bar, metrics.jsonl, TensorBoard, Weights & Biases."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import pathlib
import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import tensorboardX
import tqdm
from matplotlib.figure import Figure

from radejax.config import Config
from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.workers import usable_cpus
from radejax.training import distributed

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Scores:
    """Result of an evaluation during training.

    Attributes:
        values: Metrics by name.
        best: Metric that selects the best checkpoint; None if it is undefined.
        figures: Figures by name; empty except on the main process.
    """

    values: Mapping[str, float]
    best: float | None = None
    figures: Mapping[str, Figure] = dataclasses.field(default_factory=dict)


class MetricLogger:
    """Writes the metrics of a run on the main process.

    If a run is interrupted after its last checkpoint, it leaves records of steps after
    `start_step`. They are removed, because these steps are repeated.

    Args:
        folder: Workdir of the run; the logger writes `metrics.jsonl` and `tensorboard/`.
        config: Config of the run, which is also logged to Weights & Biases if
            `config.logging.wandb` is set.
        start_step: Step of the restored state.
        num_steps: Number of steps of the whole training.

    Raises:
        UserError: `config.logging.wandb` is set, but wandb is not installed.
        DataError: `metrics.jsonl` is corrupted.
        DiskFullError: No space is left on the disk. The methods that write can raise it
            too.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        config: Config,
        start_step: int,
        num_steps: int,
    ) -> None:
        is_main = distributed.is_main()
        self._path = folder / "metrics.jsonl"
        self._frames_per_step = config.train.batch_size
        self._losses = tuple(config.loss.weights)
        self._num_threads = config.data.num_threads
        self._has_warned = False
        self._board, self._wandb = None, None
        if is_main:
            if self._path.exists():
                _remove_after(start_step, self._path)
            if config.logging.wandb:
                self._wandb = _start_wandb(folder, config)
            # The queue is unlimited, because a limited one blocks forever on a full disk.
            self._board = tensorboardX.SummaryWriter(
                str(folder / "tensorboard"), purge_step=start_step + 1, max_queue=0
            )
        self._bar = tqdm.tqdm(
            total=num_steps,
            initial=start_step,
            desc="train",
            unit="step",
            disable=not is_main,
            dynamic_ncols=True,
        )
        self._start = self._last_step = start_step
        self._waited, self._since = 0.0, time.perf_counter()

    def next_batch(self, loader: Any, metrics: Any) -> Any:
        """Returns the next batch, and counts the time that the devices were idle meanwhile.

        Args:
            loader: Iterator of batches.
            metrics: Results of the previous step. If they are not ready when the batch is,
                the devices were busy and no time is counted.
        """
        started = time.perf_counter()
        batch = next(loader)
        if all(x.is_ready() for x in jax.tree.leaves(metrics)):
            self._waited += time.perf_counter() - started
        return batch

    def advance(self, step: int, metrics: Any) -> None:
        """Moves the progress bar to a step.

        The first step, which includes the compilation, is left out of the rate.

        Args:
            step: Number of the step.
            metrics: Results of the step.
        """
        if step == self._start + 1:
            jax.block_until_ready(metrics)
            self._restart_timer(step)
        self._bar.update(step - self._bar.n)

    def _restart_timer(self, step: int) -> None:
        """Restarts the measurement of the rate at a step."""
        self._waited, self._since, self._last_step = 0.0, time.perf_counter(), step

    def log(self, step: int, metrics: Mapping[str, Any], *, epoch: float) -> None:
        """Writes the metrics of a step and the rate of frames since the last record.

        Args:
            step: Number of the step.
            metrics: Metrics of the step by name.
            epoch: Number of epochs at the step, with a fraction.
        """
        values = {k: float(np.asarray(v)) for k, v in metrics.items()}
        text = [f"{k} {v:.4g}" for k, v in values.items() if k in self._losses]
        elapsed, steps = time.perf_counter() - self._since, step - self._last_step
        if steps:
            values["frames_per_s"] = steps * self._frames_per_step / elapsed
            values["data_wait_share"] = self._waited / elapsed
            text.append(f"{values['frames_per_s']:.1f} frames/s")
            self._warn_of_waiting(values["data_wait_share"])
        self._restart_timer(step)
        self._bar.set_postfix_str(" ".join(text))
        self._write(step, {**values, "epoch": epoch}, {})

    def _warn_of_waiting(self, share: float) -> None:
        """Warns once if training waits for data for more than a fifth of its time."""
        if share <= 0.2 or self._has_warned:
            return
        self._has_warned = True
        num_cpus = usable_cpus()
        num_threads = num_cpus if self._num_threads is None else self._num_threads
        _log.warning(
            "training waits for data for %.0f %% of its time: raise "
            "config.data.num_threads (%d threads read frames, on %d CPUs), or put the "
            "records and images on a faster disk",
            100 * share,
            num_threads,
            num_cpus,
        )

    def log_scores(self, step: int, scores: Scores) -> None:
        """Writes the result of an evaluation, and leaves its duration out of the rate."""
        self._write(step, scores.values, scores.figures)
        self._restart_timer(step)

    def _write(
        self, step: int, values: Mapping[str, float], figures: Mapping[str, Figure]
    ) -> None:
        if self._board is None:
            return
        with files.disk_full(self._path):
            with self._path.open("a") as file:
                file.write(json.dumps({"step": step, **values}) + "\n")
            self._board.flush()  # raises an error if the writer thread failed
            for name, value in values.items():
                self._board.add_scalar(name, value, step)
            for name, figure in figures.items():
                self._board.add_figure(name, figure, step)

    def __enter__(self) -> MetricLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        if self._board is not None:
            try:
                self._board.close()
            # The disk is full, which `_write` reported. Without this, it would be
            # reported again at exit.
            except OSError:
                writer = self._board._get_file_writer().event_writer
                writer._worker.stop()
                writer._closed = True
        if self._wandb is not None:
            self._wandb.finish()


def log_results(folder: pathlib.Path, step: int, values: Mapping[str, float]) -> None:
    """Writes the APs of the report of a finished run to its TensorBoard folder."""
    place = str(folder / "tensorboard")
    with tensorboardX.SummaryWriter(place, filename_suffix=".test") as board:
        for name, value in values.items():
            board.add_scalar(f"test/{name}", value, step)


def _remove_after(step: int, path: pathlib.Path) -> None:
    """Removes records after a step, and a last line that a killed run left incomplete."""
    lines = files.read_text(path).splitlines(keepends=True)
    try:
        kept = [x for x in lines if x.endswith("\n") and json.loads(x)["step"] <= step]
    except (ValueError, LookupError, TypeError) as error:
        raise DataError(f"{path} is corrupted: {error}") from None
    files.write_text(path, "".join(kept))


def _start_wandb(folder: pathlib.Path, config: Config) -> Any:
    """Starts or resumes a workdir's run at Weights & Biases, which mirrors TensorBoard."""
    try:
        import wandb
    except ImportError as error:
        raise UserError(
            "config.logging.wandb is set, and wandb is not installed: "
            "pip install 'radejax[wandb]'"
        ) from error
    return wandb.init(
        name=folder.name,
        id=hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:16],
        resume="allow",
        dir=str(folder),
        sync_tensorboard=True,
        project=config.logging.wandb_project,
        config=config.to_dict(),
    )
