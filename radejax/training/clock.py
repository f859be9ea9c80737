"""Where the time of a training goes, and traces of it."""

from __future__ import annotations

import contextlib
import logging
import os
import pathlib
import time
from collections.abc import Iterator
from typing import Any

import jax

_log = logging.getLogger(__name__)

_IMPORTED = time.perf_counter()

PARTS = ("data", "compute", "host")


class StepClock:
    """Splits the time of the loop into waiting for data, computing, and the rest.

    "data": no device had work because the batch was not there; "compute": waiting for
    devices; "host": everything that is not timed, such as placing batches and writing
    logs; "other" does not belong to steps.
    """

    def __init__(self) -> None:
        self._mark = time.perf_counter()
        self._seconds = dict.fromkeys((*PARTS, "other"), 0.0)

    @contextlib.contextmanager
    def timing(self, part: str, behind: Any = None) -> Iterator[None]:
        """Counts the time of a block for a part, and that before the block for "host".

        Args:
            part: "data", "compute" or "other".
            behind: Tree of results under way. While devices still work on them nobody
                waits for the block, and its time counts for "compute".
        """
        self._count("host")
        yield
        is_done = all(x.is_ready() for x in jax.tree.leaves(behind))
        self._count(part if is_done else "compute")

    def _count(self, part: str) -> None:
        now = time.perf_counter()
        self._seconds[part] += now - self._mark
        self._mark = now

    def take(self) -> dict[str, float]:
        """Seconds of every part of steps since the last call."""
        self._count("host")
        taken = {part: self._seconds[part] for part in PARTS}
        self._seconds = dict.fromkeys(self._seconds, 0.0)
        return taken


class Trace:
    """A trace of some steps for TensorBoard's profiler or Perfetto.

    Args:
        folder: Where it goes; empty for none.
        first: First step of this start that is traced; 0 compiles.
        last: Last one.
    """

    def __init__(self, folder: str, first: int, last: int) -> None:
        self._folder, self._first, self._last = folder, first, last
        self._count = 0
        self._is_on = self._is_done = False

    def before_step(self) -> None:
        """Starts where the first traced step begins."""
        if self._folder and self._count == self._first:
            pathlib.Path(self._folder).mkdir(parents=True, exist_ok=True)
            jax.profiler.start_trace(self._folder)
            self._is_on = True

    def after_step(self, result: object) -> None:
        """Stops when the last traced step has computed its result."""
        if self._is_on and self._count == self._last:
            jax.block_until_ready(result)
            self.close()
        self._count += 1

    def close(self) -> None:
        """Writes what there is; a warning where the training ended before the trace."""
        if self._is_on:
            jax.profiler.stop_trace()
            self._is_on, self._is_done = False, True
        if self._folder and not self._is_done:
            _log.warning(
                "no trace in %s: this start took %d steps, and logging.profile_steps "
                "begins at step %d of a start",
                self._folder,
                self._count,
                self._first,
            )


def seconds_since_start() -> float:
    """Age of this process; where the system does not tell, since the import of this."""
    try:
        fields = pathlib.Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (OSError, AttributeError, ValueError, IndexError):
        return time.perf_counter() - _IMPORTED
