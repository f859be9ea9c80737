"""Hooks of the training loop: functions that are called after each step.

A hook is a function `hook(step, state, metrics)` of the number of steps taken, the state after
them, and the metrics of the last one. The computation of the arrays may not be finished when
it is called.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np
import tqdm
from jaxtyping import Int

from radejax.config import Config
from radejax.core import devices
from radejax.core.errors import DataError, require
from radejax.core.structures import Batch
from radejax.core.workers import usable_cpus
from radejax.training.metric_writer import MetricWriter
from radejax.training.step import Metrics, TrainState, make_schedule

_log = logging.getLogger(__name__)

Hook = Callable[[int, TrainState, Metrics], None]

OwnHook = Callable[[int, TrainState, Metrics], Mapping[str, float] | None]
"""Function of `config.train.hooks`, which may return values to be logged."""

STEPS_IN_FLIGHT = 2  # more steps would only keep more batches in memory


def every(num_steps: int, count: int, hook: Hook) -> Hook:
    """Returns a hook that calls another one every `count` steps and after the last step.

    With `count` 0, it is never called.
    """

    def call(step: int, state: TrainState, metrics: Metrics) -> None:
        if count and (step % count == 0 or step == num_steps):
            hook(step, state, metrics)

    return call


def logged(hook: OwnHook, writer: MetricWriter) -> Hook:
    """Returns a hook that writes the values that another one returns, if there are any."""

    def call(step: int, state: TrainState, metrics: Metrics) -> None:
        values = hook(step, state, metrics)
        is_mapping = isinstance(values, Mapping)
        name = getattr(hook, "__name__", "a function")
        name = f"the result of {name} in config.train.hooks"
        require(values is None or is_mapping, name, values, "numbers by name, or None")
        if values:
            writer.write(step, {name: float(x) for name, x in values.items()})

    return call


class ProgressBar(tqdm.tqdm):
    """Hook that shows the number of steps on the main process."""

    def __init__(self, start_step: int, num_steps: int) -> None:
        super().__init__(
            total=num_steps,
            initial=start_step,
            desc="train",
            unit="step",
            disable=not devices.is_main(),
            dynamic_ncols=True,
        )

    def __call__(self, step: int, state: TrainState, metrics: Metrics) -> None:
        tqdm.tqdm.update(self, step - self.n)  # `self.update` would be untyped


class Throughput:
    """Iterator over batches that measures the rate of steps and the waits for batches.

    It is also the first hook of the loop. If the last step is finished when the next
    batch arrives, the devices were idle, and the time of reading the batch is counted as waiting.

    Args:
        batches: Endless iterator.
        start_step: Number of steps that were taken before.

    Attributes:
        frame: Indices of the frames of the last batch of this process.
    """

    frame: Int[np.ndarray, " B"]

    def __init__(self, batches: Iterator[Batch], start_step: int) -> None:
        self._batches = batches
        self._start = start_step
        self._metrics: Metrics = {}
        self.restart(start_step)

    def __iter__(self) -> Throughput:
        return self

    def __next__(self) -> Batch:
        started = time.perf_counter()
        batch = next(self._batches)
        if all(x.is_ready() for x in jax.tree.leaves(self._metrics)):
            self._waited_s += time.perf_counter() - started
        self.frame = np.asarray(batch.frame)
        return batch

    def __call__(self, step: int, state: TrainState, metrics: Metrics) -> None:
        """Leaves the first step out of the rate, because it includes the compilation."""
        self._metrics = metrics
        if step == self._start + 1:
            jax.block_until_ready(metrics)
            self.restart(step)

    def restart(self, step: int) -> None:
        """Restarts the measurement at a step."""
        self._first_step = step
        self._waited_s = 0.0
        self._since_s = time.perf_counter()

    def measure(self, step: int) -> tuple[float, float] | None:
        """Returns the steps per second and the fraction of waiting, and restarts.

        The result is None if no step was taken since the last restart.
        """
        elapsed_s = time.perf_counter() - self._since_s
        steps_per_s = (step - self._first_step) / elapsed_s
        waiting = self._waited_s / elapsed_s
        self.restart(step)
        return (steps_per_s, waiting) if steps_per_s else None


@dataclasses.dataclass
class Log:
    """Hook that writes metrics, learning rate and rate of frames, and shows the losses.

    Attributes:
        config: Config of the run.
        steps_per_epoch: Number of batches of one pass over the data.
        throughput: Measurement of the rate since the last call.
        writer: Writer of the values.
        bar: Progress bar.
    """

    config: Config
    steps_per_epoch: int
    throughput: Throughput
    writer: MetricWriter
    bar: tqdm.tqdm
    has_warned: bool = False

    def __post_init__(self) -> None:
        self._schedule = make_schedule(self.config.train, self.steps_per_epoch)

    def __call__(self, step: int, state: TrainState, metrics: Metrics) -> None:
        given = {**metrics, "learning_rate": self._schedule(step - 1)}
        values = {name: float(np.asarray(x)) for name, x in given.items()}
        losses = self.config.loss.weights
        text = [f"{name} {x:.4g}" for name, x in values.items() if name in losses]
        if (measured := self.throughput.measure(step)) is not None:
            steps_per_s, waiting = measured
            values["frames_per_s"] = steps_per_s * self.config.train.batch_size
            values["data_wait_share"] = waiting
            text.append(f"{values['frames_per_s']:.1f} frames/s")
            self._warn_of_waiting(waiting)
        self.bar.set_postfix_str(" ".join(text))
        self.writer.write(step, {**values, "epoch": step / self.steps_per_epoch})

    def _warn_of_waiting(self, fraction: float) -> None:
        """Warns once if training waits for data for more than a fifth of its time."""
        if fraction <= 0.2 or self.has_warned:
            return
        self.has_warned = True
        num_cpus = usable_cpus()
        num_threads = self.config.data.num_threads
        _log.warning(
            "training waits for data for %.0f %% of its time: raise "
            "config.data.num_threads (%d threads read frames, on %d CPUs), or put the "
            "records and images on a faster disk",
            100 * fraction,
            num_cpus if num_threads is None else num_threads,
            num_cpus,
        )


@dataclasses.dataclass
class CheckSkipped:
    """Hook that reports steps that were skipped, and ends a training that diverges.

    A step is skipped if its loss or gradient is not finite. Only steps that the loop has
    waited for are examined, so that the devices stay busy.

    Attributes:
        limit: Number of consecutive skipped steps above which `DataError` is raised.
        log_every_steps: Least number of steps between two warnings.
        throughput: Iterator over the batches of the steps.
        keys: Keys of the frames by their index; indices are reported without them.
        num_skipped: Number of steps skipped up to the last one that was examined.
        num_in_row: Number of consecutive steps skipped up to the same step.
    """

    limit: int
    log_every_steps: int
    throughput: Throughput
    keys: Sequence[str]
    num_skipped: int
    num_in_row: int

    def __post_init__(self) -> None:
        self._pending = collections.deque[tuple[int, Metrics, np.ndarray]]()
        self._next_warning = 0
        self._first = ""  # description of the first skipped step of the current row

    def __call__(self, step: int, state: TrainState, metrics: Metrics) -> None:
        self._pending.append((step, metrics, self.throughput.frame))
        if len(self._pending) > STEPS_IN_FLIGHT:
            self._examine(*self._pending.popleft())

    def finish(self) -> None:
        """Examines all steps that were taken."""
        while self._pending:
            self._examine(*self._pending.popleft())

    def check_total(self, num_steps: int) -> None:
        """Raises `DataError` if most of the steps of a whole training were skipped."""
        if 2 * self.num_skipped > num_steps:
            raise DataError(
                f"{self.num_skipped} of {num_steps} steps were skipped because loss or "
                f"gradient was not finite, so that the model is hardly trained{self._first}"
            )

    def _examine(
        self, step: int, metrics: Metrics, frame: Int[np.ndarray, " B"]
    ) -> None:
        skipped = int(metrics["skipped"])
        if skipped == self.num_skipped:
            self.num_in_row = 0
            return
        self.num_skipped = skipped
        self.num_in_row += 1
        values = {name: float(np.asarray(x)) for name, x in metrics.items()}
        wrong = [f"{name} {x}" for name, x in values.items() if not math.isfinite(x)]
        keys = [self.keys[i] if self.keys else str(i) for i in frame.tolist()]
        text = f"step {step} has {', '.join(wrong)}; its frames are {', '.join(keys)}"
        if self.num_in_row == 1 or not self._first:
            self._first = (
                f": {text}. Look at these frames, lower config.train.learning_rate, or "
                "find the operation with JAX_DEBUG_NANS=1 (docs/debugging.md)"
            )
        if self.num_in_row > self.limit:
            raise DataError(
                f"loss or gradient was not finite in {self.num_in_row} steps in a row (limit "
                f"config.train.max_skipped_steps={self.limit}){self._first}"
            )
        if step >= self._next_warning:
            self._next_warning = step + self.log_every_steps
            total = f"{skipped} so far" if skipped > 1 else "the first one"
            _log.warning("a step was skipped (%s): %s", total, text)


class Trace(contextlib.ExitStack):
    """Hook that writes a profiler trace of a few steps, to be used in a `with` statement.

    Args:
        folder: Folder of the trace.
        start_step: Number of steps that were taken before.
        num_steps: Number of steps of the whole training.
        steps: First and last step of the trace, counted from `start_step`.
    """

    def __init__(
        self, folder: str, start_step: int, num_steps: int, steps: tuple[int, int]
    ) -> None:
        super().__init__()
        self._folder = folder
        self._start = start_step
        self._first, self._last = steps
        self._num_left = num_steps - start_step
        if self._num_left <= self._first:
            _log.warning("no trace: %d steps are left to train", self._num_left)

    def __enter__(self) -> Trace:
        self(self._start, None, None)
        return self

    def __call__(self, step: int, state: object, metrics: object) -> None:
        taken = step - self._start
        if taken == self._first < self._num_left:
            options = jax.profiler.ProfileOptions()
            # Stopping the tracer of Python functions can crash the process while threads
            # are running.
            options.python_tracer_level = 0
            self.enter_context(
                jax.profiler.trace(self._folder, profiler_options=options)
            )
        if taken == self._last + 1:
            jax.block_until_ready(metrics)
            self.close()
