"""What a run tells while it goes: bar, metrics.jsonl, TensorBoard, Weights & Biases."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import tensorboardX
import tqdm

from radejax.core import files
from radejax.core.errors import DiskFullError, UserError
from radejax.training.clock import StepClock


@dataclasses.dataclass(frozen=True)
class Scores:
    """What an evaluation during training found.

    Attributes:
        values: Metrics; the name of each tells its protocol.
        best: The one that decides which checkpoint is best; None where undefined.
        pictures: `[H, W, 3]` uint8 by name, on the main process.
    """

    values: Mapping[str, float]
    best: float | None = None
    pictures: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


class Watch:
    """Logs of one run, consistent with the step it starts from.

    Records of steps after `start_step`, left by a run that was interrupted later than
    its last checkpoint, are dropped: they will be written again.

    Args:
        folder: Work folder; `metrics.jsonl` and `tensorboard/` go there.
        start_step: Step of the restored state.
        num_steps: Of the whole training.
        frames_per_step: For the rate.
        is_main: False on all processes but the first, which then log nothing.
        wandb_project: Also log to this project of Weights & Biases; None: do not.
        config: What Weights & Biases shows as the run's configuration.

    Raises:
        UserError: Weights & Biases is asked for and not installed.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        *,
        start_step: int,
        num_steps: int,
        frames_per_step: int,
        is_main: bool = True,
        wandb_project: str | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        self._is_main = is_main
        self._frames_per_step = frames_per_step
        self._jsonl = folder / "metrics.jsonl"
        if is_main:
            self._drop_records_after(start_step)
        self._board = _Board(folder / "tensorboard", start_step) if is_main else None
        self._bar = tqdm.tqdm(
            total=num_steps,
            initial=start_step,
            desc="train",
            unit="step",
            disable=not is_main,
            dynamic_ncols=True,
        )
        self._wandb = (
            _start_wandb(wandb_project, folder, config)
            if is_main and wandb_project is not None
            else None
        )
        self._last_step = start_step
        self.clock = StepClock()

    def tick(self, step: int) -> None:
        """Moves the bar."""
        self._bar.update(step - self._bar.n)

    def log(self, step: int, metrics: Mapping[str, Any], *, epoch: float) -> None:
        """Writes the metrics of a step, with rate and times since the last log."""
        values = {k: float(np.asarray(v)) for k, v in metrics.items()}
        self.clock.lap("compute")  # the metrics had to be waited for
        speed = self._speed(step)
        text = [f"{k} {v:.4g}" for k, v in values.items() if k in _ON_THE_BAR]
        if speed:
            text.append(f"{speed['frames_per_s']:.1f} frames/s")
            text.append(f"wait {speed['data_wait_share']:.0%}")
        self._bar.set_postfix_str(" ".join(text))
        self.write(step, {**values, **speed, "epoch": epoch})

    def start_timing(self, step: int) -> None:
        """Forgets the time up to a step: the first one's is that of compiling."""
        self.clock.lap("other")
        self.clock.take()
        self._last_step = step

    def _speed(self, step: int) -> dict[str, float]:
        """Rate and times since the last log; nothing where no step was timed."""
        seconds, steps = self.clock.take(), step - self._last_step
        self._last_step = step
        elapsed = sum(seconds.values())
        if not steps or not elapsed:
            return {}
        return {
            "frames_per_s": steps * self._frames_per_step / elapsed,
            "data_wait_share": seconds["data"] / elapsed,
            **{f"{k}_ms_per_step": 1e3 * v / steps for k, v in seconds.items()},
        }

    def log_scores(self, step: int, scores: Scores) -> None:
        """Writes what an evaluation found."""
        self.write(step, scores.values)
        if not self._is_main:
            return
        for name, picture in scores.pictures.items():
            self._board.add_image(name, picture, step)
        if self._wandb is not None and scores.pictures:
            import wandb

            images = {k: wandb.Image(v) for k, v in scores.pictures.items()}
            self._wandb.log(images, step=step)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Writes values that belong to a step."""
        if not self._is_main:
            return
        try:
            with self._jsonl.open("a") as file:
                file.write(json.dumps({"step": step, **values}) + "\n")
        except OSError as error:
            if files.is_no_space(error):
                raise _disk_full(self._jsonl) from error
            raise
        for name, value in values.items():
            self._board.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log(dict(values), step=step)

    def close(self) -> None:
        self._bar.close()
        if self._board is not None:
            self._board.close()
        if self._wandb is not None:
            self._wandb.finish()

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _drop_records_after(self, step: int) -> None:
        if not self._jsonl.exists():
            return
        kept = []
        for line in self._jsonl.read_text().splitlines():
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line + "\n")
            except json.JSONDecodeError:  # the line a killed run was writing
                break
        files.write_text(self._jsonl, "".join(kept))


class _Board:
    """TensorBoard's files, written by a thread of tensorboardX.

    On a full disk that thread ends, and a queue of limited length would then take no
    more and block for ever: its length is not limited (0), and the thread looked at.
    """

    def __init__(self, folder: pathlib.Path, start_step: int) -> None:
        self._folder = folder
        try:
            self._writer = tensorboardX.SummaryWriter(
                str(folder), purge_step=start_step + 1, max_queue=0
            )
        except OSError as error:
            if files.is_no_space(error):
                raise _disk_full(folder) from error
            raise
        self._events = self._writer.file_writer.event_writer

    def add_scalar(self, name: str, value: float, step: int) -> None:
        self._check()
        self._writer.add_scalar(_board_name(name), value, step)

    def add_image(self, name: str, picture: np.ndarray, step: int) -> None:
        self._check()
        self._writer.add_image(name, picture, step, dataformats="HWC")

    def close(self) -> None:
        if self._events._worker.is_alive():
            self._writer.close()
        else:  # the program's end would wait for the queue, and close what is full
            self._events._event_queue.cancel_join_thread()
            self._events._closed = True

    def _check(self) -> None:
        if not self._events._worker.is_alive():
            raise _disk_full(self._folder)


def _disk_full(path: pathlib.Path) -> DiskFullError:
    return DiskFullError(
        f"no space left to write {path}; checkpoints are intact, free some and run the "
        "same command again"
    )


_ON_THE_BAR = ("focal", "gwd", "smooth_l1")


def _board_name(name: str) -> str:
    """A name with the characters that TensorBoard takes."""
    return re.sub(r"[^\w./-]", "_", name)


def _start_wandb(
    project: str, folder: pathlib.Path, config: Mapping[str, Any] | None
) -> Any:
    """The run of a work folder at Weights & Biases, continued if it is there."""
    try:
        import wandb
    except ImportError as error:
        raise UserError(
            "config.watch.wandb is set, and wandb is not installed: "
            "pip install 'radejax[wandb]'"
        ) from error
    return wandb.init(
        project=project,
        name=folder.name,
        id=hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:16],
        resume="allow",
        dir=str(folder),
        config=dict(config or {}),
    )
