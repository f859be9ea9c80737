"""Values of a run by step: metrics.jsonl, TensorBoard, Weights & Biases."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import pathlib
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import tensorboardX
from matplotlib.figure import Figure

from radejax.config import Config
from radejax.core import devices, files
from radejax.core.errors import DataError, UserError

if TYPE_CHECKING:
    import wandb


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


class MetricWriter:
    """Writes values and figures by step on the main process, to be used in a `with` statement.

    If a run is interrupted after its last checkpoint, it leaves records of steps after
    `start_step`. They are removed, because these steps are repeated.

    Args:
        folder: Workdir of the run, for `metrics.jsonl` and `tensorboard/`.
        config: Config of the run, which is also logged to Weights & Biases if
            `config.logging.wandb` is set.
        start_step: Step of the restored state.

    Raises:
        UserError: `config.logging.wandb` is set, but wandb is not installed.
        DataError: `metrics.jsonl` is corrupted.
        DiskFullError: No space is left on the disk. `write` can raise it too.
    """

    def __init__(self, folder: pathlib.Path, config: Config, start_step: int) -> None:
        self._path = folder / "metrics.jsonl"
        self._started_s = time.perf_counter()
        self._board: tensorboardX.SummaryWriter | None = None
        self._wandb: wandb.Run | None = None
        if not devices.is_main():
            return
        if self._path.exists():
            _remove_after(start_step, self._path)
        if config.logging.wandb:
            self._wandb = _start_wandb(folder, config)
        # The queue is unlimited, because a limited one blocks forever on a full disk.
        self._board = tensorboardX.SummaryWriter(
            str(folder / "tensorboard"), purge_step=start_step + 1, max_queue=0
        )

    def write(
        self,
        step: int,
        values: Mapping[str, float],
        figures: Mapping[str, Figure] | None = None,
    ) -> None:
        """Writes values and figures by name, and minutes since the writer was created."""
        if self._board is None:
            return
        with files.disk_full(self._path):
            record = {n: x if math.isfinite(x) else None for n, x in values.items()}
            minutes = round((time.perf_counter() - self._started_s) / 60, 4)
            with self._path.open("a") as file:
                file.write(
                    json.dumps({"step": step, "minutes": minutes, **record}) + "\n"
                )
            self._board.flush()  # raises an error if the writer thread failed
            for name, value in values.items():
                self._board.add_scalar(name, value, step)
            for name, figure in (figures or {}).items():
                self._board.add_figure(name, figure, step)

    def __enter__(self) -> MetricWriter:
        return self

    def __exit__(self, *_: object) -> None:
        if self._board is not None:
            try:
                self._board.close()
            # The disk is full, which `write` reported. Without this, it would be
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


def _start_wandb(folder: pathlib.Path, config: Config) -> wandb.Run:
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
