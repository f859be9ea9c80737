"""What a run tells while it goes: bar, metrics.jsonl, TensorBoard, Weights & Biases."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import pathlib
import re
import socket
import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import tensorboardX
import tqdm
from jaxtyping import UInt8
from tensorboardX import summary

# Protobuf makes them when it is imported.
from tensorboardX.proto.event_pb2 import Event, SessionLog  # type: ignore[attr-defined]

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.losses.detection import LOSSES
from radejax.training import processes
from radejax.training.checkpoints import BEST
from radejax.training.clock import StepClock, seconds_since_start

_log = logging.getLogger(__name__)

Values = Mapping[str, float]
Pictures = Mapping[str, UInt8[np.ndarray, "_ _ 3"]]


@dataclasses.dataclass(frozen=True)
class Scores:
    """What an evaluation during training found.

    Attributes:
        values: Metrics; the name of each tells its protocol.
        best: The one that decides which checkpoint is best; None where undefined.
        pictures: Images `[H, W, 3]` by name, on the main process.
    """

    values: Values
    best: float | None = None
    pictures: Pictures = dataclasses.field(default_factory=dict)

    def with_best(self) -> dict[str, float] | None:
        """What a checkpoint keeps; None where it could not become the best."""
        return None if self.best is None else {**self.values, BEST: self.best}


class Watch:
    """Logs of one run, consistent with the step it starts from; the main process's.

    `timing` is that of a `StepClock`, whose times are logged. Records of steps after
    `start_step`, left by a run that was interrupted later than its last checkpoint, are
    dropped: they will be written again.

    Args:
        folder: Work folder; `metrics.jsonl` and `tensorboard/` go there.
        start_step: Step of the restored state.
        num_steps: Of the whole training.
        frames_per_step: For the rate.
        wandb: Also log to Weights & Biases, with this "project" and the "config" that
            is shown there; None: do not.

    Raises:
        UserError: Weights & Biases is asked for and not installed.
        DiskFullError: No space is left, here or in any of the methods.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        start_step: int,
        num_steps: int,
        frames_per_step: int,
        wandb: Mapping[str, Any] | None = None,
    ) -> None:
        self._clock = StepClock()
        self.timing = self._clock.timing
        self._frames_per_step = frames_per_step
        self._start_step = self._last_step = start_step
        self._logs: list[_Jsonl | _Board | _Wandb] = []
        if processes.is_main():
            self._logs.append(_Jsonl(folder / "metrics.jsonl", start_step))
            if wandb is not None:
                self._logs.append(_Wandb(folder, wandb))
            self._logs.append(_Board(folder / "tensorboard", start_step))
        self._bar = tqdm.tqdm(
            total=num_steps,
            initial=start_step,
            desc="train",
            unit="step",
            disable=not processes.is_main(),
            dynamic_ncols=True,
        )

    def tick(self, step: int, metrics: Any) -> None:
        """Moves the bar; of the first step tells the time, and does not count it."""
        self._bar.update(step - self._bar.n)
        if step == self._start_step + 1:
            with self.timing("compute"):
                jax.block_until_ready(metrics)
            _log.info(
                "first step %.1f s after the start, %.1f s of it to compile and run it",
                seconds_since_start(),
                self._clock.take()["compute"],
            )
            self._last_step = step

    def log(self, step: int, metrics: Mapping[str, Any], *, epoch: float) -> None:
        """Writes the metrics of a step, with rate and times since the last log."""
        with self.timing("compute"):  # the metrics have to be waited for
            values = {k: float(np.asarray(v)) for k, v in metrics.items()}
        speed = self._speed(step)
        text = [f"{k} {v:.4g}" for k, v in values.items() if k in LOSSES]
        if speed:
            text.append(f"{speed['frames_per_s']:.1f} frames/s")
            text.append(f"wait {speed['data_wait_share']:.0%}")
        self._bar.set_postfix_str(" ".join(text))
        self._write(step, {**values, **speed, "epoch": epoch}, {})

    def _speed(self, step: int) -> dict[str, float]:
        """Rate and times since the last log; nothing where no step was timed."""
        seconds, steps = self._clock.take(), step - self._last_step
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
        self._write(step, scores.values, scores.pictures)

    def _write(self, step: int, values: Values, pictures: Pictures) -> None:
        for log in self._logs:
            log.write(step, values, pictures)

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        for log in self._logs:
            log.close()


class _Jsonl:
    """One line a step; pictures are left out."""

    def __init__(self, path: pathlib.Path, start_step: int) -> None:
        self._path = path
        if path.exists():
            self._drop_after(start_step)

    def _drop_after(self, step: int) -> None:
        kept, lines = [], files.read_text(self._path).splitlines()
        for number, line in enumerate(lines, 1):
            where = f"{self._path}, line {number}"
            try:
                if files.parse_json(line, {"step": float}, where)["step"] <= step:
                    kept.append(line + "\n")
            except DataError:
                if number < len(lines):  # not the one a killed run was writing
                    raise
        files.write_text(self._path, "".join(kept))

    def write(self, step: int, values: Values, _: Pictures) -> None:
        with _told_if_full(self._path), self._path.open("a") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")

    def close(self) -> None:
        """Nothing is open between lines."""


class _Board:
    """TensorBoard's events, written at once.

    tensorboardX's `SummaryWriter` hands them to a thread, which ends on a full disk:
    nobody is told, and what is handed over next waits for ever.
    """

    def __init__(self, folder: pathlib.Path, start_step: int) -> None:
        self._folder = folder
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}"
        with _told_if_full(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._records = tensorboardX.RecordWriter(str(folder / name))
            self._add(file_version="brain.Event:2")
            # TensorBoard drops what earlier starts wrote of this step and later ones.
            begun = SessionLog(status=SessionLog.START)
            self._add(step=start_step + 1, session_log=begun)
            self._records.flush()

    def _add(self, **fields: Any) -> None:
        event = Event(wall_time=time.time(), **fields)
        self._records.write(event.SerializeToString())

    def write(self, step: int, values: Values, pictures: Pictures) -> None:
        with _told_if_full(self._folder):
            for name, value in values.items():
                name = re.sub(r"[^\w./-]", "_", name)  # TensorBoard takes no others
                self._add(step=step, summary=summary.scalar(name, value))
            for name, picture in pictures.items():
                image = summary.image(name, picture, dataformats="HWC")
                self._add(step=step, summary=image)
            self._records.flush()

    def close(self) -> None:
        with contextlib.suppress(OSError):  # said by `write`
            self._records.close()


class _Wandb:
    """The run of a work folder at Weights & Biases, continued if it is there."""

    def __init__(self, folder: pathlib.Path, arguments: Mapping[str, Any]) -> None:
        try:
            import wandb
        except ImportError as error:
            raise UserError(
                "config.logging.wandb is set, and wandb is not installed: "
                "pip install 'radejax[wandb]'"
            ) from error
        self._image = wandb.Image
        self._run = wandb.init(
            name=folder.name,
            id=hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:16],
            resume="allow",
            dir=str(folder),
            **arguments,
        )

    def write(self, step: int, values: Values, pictures: Pictures) -> None:
        self._run.log(dict(values), step=step)
        if pictures:
            images = {k: self._image(v) for k, v in pictures.items()}
            self._run.log(images, step=step)

    def close(self) -> None:
        self._run.finish()


def _told_if_full(path: pathlib.Path) -> contextlib.AbstractContextManager[None]:
    message = (
        f"no space left to write {path}; checkpoints are intact, free some and run the "
        "same command again"
    )
    return files.disk_full(path, message)
