"""Worker processes that leave Ctrl-C to their parent and end when it dies."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from radejax.core.errors import UserError

CONTEXT = multiprocessing.get_context("spawn")
"""How the processes start: shared values for them must come from it."""

_KILLED = (
    "a worker process was killed, perhaps for want of memory; run the same command again "
    "to continue, with fewer workers"
)
_NOT_STARTED = (
    "no worker process could start: a script of your own must do its work under "
    '`if __name__ == "__main__":`, as every worker imports it, or ask for 0 workers'
)

Submit = Callable[..., concurrent.futures.Future[Any]]


@contextlib.contextmanager
def process_pool(
    num_workers: int, start: Callable[..., None], *arguments: Any
) -> Iterator[Submit]:
    """Processes for the time of a block, which gets a function to submit work with.

    Args:
        num_workers: Processes at most; they start with the first work.
        start: Called in each of them first.
        *arguments: Of `start`.

    Yields:
        `submit(function, *arguments)`, which returns a future; for any thread.

    Raises:
        UserError: A process was killed, or none could start.
    """
    started = CONTEXT.RawValue("b", 0)
    pool = concurrent.futures.ProcessPoolExecutor(
        num_workers, CONTEXT, _start, (started, start, *arguments)
    )

    def submit(function: Callable[..., Any], /, *args: Any) -> Any:
        # Ctrl-C is for this process: those that start now inherit the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return pool.submit(function, *args)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    with pool:
        try:
            yield submit
        except BrokenProcessPool:
            raise UserError(_KILLED if started.value else _NOT_STARTED) from None
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _start(started: Any, start: Callable[..., None], *arguments: Any) -> None:
    """Ends this process when its parent dies."""
    started.value = 1
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    start(*arguments)
