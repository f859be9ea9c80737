"""What a run tells while it goes: progress bar, metrics.jsonl, TensorBoard."""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import tensorboardX
import tqdm

from radejax import files


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
    """

    def __init__(
        self,
        folder: pathlib.Path,
        *,
        start_step: int,
        num_steps: int,
        frames_per_step: int,
        is_main: bool = True,
    ) -> None:
        self._is_main = is_main
        self._frames_per_step = frames_per_step
        self._jsonl = folder / "metrics.jsonl"
        if is_main:
            self._drop_records_after(start_step)
        self._board = (
            tensorboardX.SummaryWriter(
                str(folder / "tensorboard"), purge_step=start_step + 1
            )
            if is_main
            else None
        )
        self._bar = tqdm.tqdm(
            total=num_steps,
            initial=start_step,
            desc="train",
            unit="step",
            disable=not is_main,
            dynamic_ncols=True,
        )
        self._last_time = time.perf_counter()
        self._last_step = start_step
        self._data_wait_s = 0.0

    def add_data_wait(self, seconds: float) -> None:
        """Counts time in which the step had no batch to work on."""
        self._data_wait_s += seconds

    def tick(self, step: int) -> None:
        """Moves the bar."""
        self._bar.update(step - self._bar.n)

    def log(self, step: int, metrics: Mapping[str, Any], *, epoch: float) -> None:
        """Writes the metrics of a step, with rate and data wait since the last log."""
        now = time.perf_counter()
        elapsed = now - self._last_time
        steps = max(step - self._last_step, 1)
        values = {k: float(np.asarray(v)) for k, v in metrics.items()}
        speed = {
            "frames_per_s": steps * self._frames_per_step / elapsed,
            "data_wait_share": self._data_wait_s / elapsed,
        }
        self._last_time, self._last_step, self._data_wait_s = now, step, 0.0
        self._bar.set_postfix_str(
            " ".join(f"{k} {v:.4g}" for k, v in values.items() if k in _ON_THE_BAR)
            + f" {speed['frames_per_s']:.1f} frames/s"
            + f" wait {speed['data_wait_share']:.0%}"
        )
        self.write(step, {**values, **speed, "epoch": epoch})

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Writes values that belong to a step, those of an evaluation for example."""
        if not self._is_main:
            return
        with self._jsonl.open("a") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            self._board.add_scalar(name, value, step)

    def close(self) -> None:
        self._bar.close()
        if self._board is not None:
            self._board.close()

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


_ON_THE_BAR = ("focal", "gwd", "smooth_l1")
