"""Worker processes that leave Ctrl-C to their parent and end when it ends."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from typing import Any

from radejax.core.errors import UserError

Submit = Callable[..., concurrent.futures.Future[Any]]


@contextlib.contextmanager
def process_pool(
    num_workers: int, start: Callable[..., Any] | None = None, *arguments: Any
) -> Iterator[Submit]:
    """Runs worker processes during a block and yields a function to submit work.

    Results must be at most a few hundred bytes long. The pool reads all results from one
    pipe, and if a worker is killed while it writes one, the pool waits forever for the
    rest. Writes of less than 4 KiB are atomic and cannot be cut off. Workers should
    therefore write large results to files and return the names of the files.

    Args:
        num_workers: Number of processes.
        start: Function that each process calls first, or None.
        *arguments: Arguments of `start`.

    Yields:
        `submit(function, *arguments)`, which returns a future.

    Raises:
        UserError: A process was killed or could not start.
    """
    others = multiprocessing.active_children()
    context = multiprocessing.get_context("spawn")
    given = (start, *arguments)
    pool = concurrent.futures.ProcessPoolExecutor(num_workers, context, _start, given)
    try:
        with pool:
            _start_processes(pool, num_workers)
            try:
                yield pool.submit
            except BaseException:
                # An interrupt must not wait until the workers finish their tasks.
                for process in multiprocessing.active_children():
                    if process not in others:
                        process.terminate()
                raise
    except BrokenProcessPool:
        raise UserError(
            "a worker process ended early: it was killed, perhaps for want of memory, "
            "or it could not start because a script does its work outside of "
            '`if __name__ == "__main__":`; run the same command again to continue, '
            "with fewer workers"
        ) from None


def _start_processes(
    pool: concurrent.futures.ProcessPoolExecutor, num_workers: int
) -> None:
    """Starts the processes while SIGINT is blocked; they inherit this signal mask."""
    resource_tracker.ensure_running()  # starting it later would clear the mask
    old = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        for _ in range(num_workers):
            pool.submit(os.getpid)  # the pool starts one process per waiting task
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)


def _start(start: Callable[..., Any] | None, *arguments: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if start is not None:
        start(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    parent.join()
    os._exit(1)
