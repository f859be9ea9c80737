"""Several processes that train together: who writes, who waits, when all stop."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

from radejax.core.errors import UserError
from radejax.training import sharding

T = TypeVar("T")

_WAIT_S = 7 * 24 * 3600  # projecting all of K-Radar takes hours
_numbers = itertools.count()


def is_main() -> bool:
    """True on the one process that writes logs, pictures and configurations."""
    return jax.process_index() == 0


def main_first(prepare: Callable[[], T]) -> T:
    """Calls a function on the main process, and after that on the others.

    For work that finds its own results again, such as preparing data.

    Raises:
        UserError: On the others, if the main process failed; it raises its own error.
    """
    result = main_only(prepare)
    if not is_main():
        result = prepare()
    wait_for_all("main_first")
    return result


def main_only(work: Callable[[], T]) -> T | None:
    """Calls a function on the main process, while the others wait; None on those.

    For reports and pictures, which may take long: processes that go on meanwhile would
    wait in a collective, or at JAX's end, and give up after minutes.

    Raises:
        UserError: On the others, if the main process failed; it raises its own error.
    """
    if jax.process_count() == 1:
        return work()
    result = error = None
    if is_main():
        try:
            result = work()
        except Exception as failed:
            error = failed
    wait_for_all("main_only")
    is_fine = bool(multihost_utils.broadcast_one_to_all(np.int32(error is None)))
    if error is not None:
        raise error
    if not is_fine:
        raise UserError("process 0 stopped with an error, see its output")
    return result


def wait_for_all(name: str) -> None:
    """Returns when every process has come here; hours later if need be."""
    if jax.process_count() == 1:
        return
    ocp.multihost.sync_global_processes(
        f"radejax {name} {next(_numbers)}",
        timeout=_WAIT_S,
        # All of them, named: waits at the coordinator and not in a collective, which
        # would give up after minutes.
        processes=set(range(jax.process_count())),
    )


def all_agree(is_fine: bool) -> bool:
    """True if it is true on every process."""
    if jax.process_count() == 1:
        return is_fine
    return bool(multihost_utils.process_allgather(np.int32(is_fine)).all())


class Stopped(Exception):
    """Something long, an evaluation, ends early because all processes should stop."""


class AgreedStop:
    """Tells all processes in the same step that one of them was asked to stop.

    A signal reaches processes in different steps, and those that go on would wait for
    the others without end. Each step therefore sends a flag around, and reads the one
    of the step before, which has arrived by then.

    Args:
        event: Set when this process is asked to stop.
        mesh: Devices of all processes.
    """

    def __init__(self, event: threading.Event, mesh: jax.sharding.Mesh) -> None:
        self._event = event
        self._mesh = mesh
        self._sent: jax.Array | None = None
        self._any = jax.jit(lambda x: x.any(), out_shardings=sharding.replicated(mesh))

    def __call__(self) -> bool:
        """True when all should stop; to be called as often by every process."""
        if jax.process_count() == 1:
            return self._event.is_set()
        before = self._sent
        rows = np.full(len(self._mesh.local_devices), self._event.is_set())
        self._sent = self._any(sharding.put_batch(rows, self._mesh))
        return before is not None and bool(before)
