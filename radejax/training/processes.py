"""Several processes that train together: who writes, who waits, when all stop."""

from __future__ import annotations

import contextlib
import itertools
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from typing import TypeVar, cast

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

from radejax.core.errors import UserError
from radejax.training import sharding

_log = logging.getLogger(__name__)

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
    return cast(T, result)  # it is None on the other processes alone


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


@contextlib.contextmanager
def stop_on_signal(mesh: jax.sharding.Mesh) -> Iterator[Callable[[], bool]]:
    """Gives a function that tells all processes in the same step that all should stop.

    It is True once SIGTERM or SIGINT came to one of them, and to be called as often by
    every process. A second signal interrupts at once. A signal reaches processes in
    different steps, and those that go on would wait for the others without end. Each
    call therefore sends a flag around, and reads the one of the call before, which has
    arrived by then.

    Args:
        mesh: Devices of all processes.
    """
    event, before = threading.Event(), None
    any_of = jax.jit(lambda x: x.any(), out_shardings=sharding.replicated(mesh))

    def handle(number: int, _: object) -> None:
        name = signal.Signals(number).name
        if event.is_set():
            raise KeyboardInterrupt(f"second {name}")
        _log.warning("%s: saving a checkpoint, then stopping", name)
        event.set()

    def stop() -> bool:
        nonlocal before
        if jax.process_count() == 1:
            return event.is_set()
        rows = np.full(len(mesh.local_devices), event.is_set())
        found, before = before, any_of(sharding.put_batch(rows, mesh))
        return found is not None and bool(found)

    # Only a main thread may set handlers.
    is_main_thread = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGTERM, signal.SIGINT) if is_main_thread else ()
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            # None: set outside Python, by jax.distributed; it cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
