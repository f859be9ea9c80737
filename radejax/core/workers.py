"""Worker processes that leave Ctrl-C to their parent and end when it dies.

Each has a pipe of its own, which ends with it: a worker that is killed is known at once,
be it amid its result. The pool of `concurrent.futures` reads all results from one pipe
and waits for ever for the rest of such a one.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
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
        `submit(function, *arguments)`, which returns a future; for any thread. The
        future raises `UserError` where the process was killed, or could not start.
    """
    workers: list[_Worker] = []
    mine = threading.local()

    def work(function: Callable[..., Any], *args: Any) -> Any:
        if not hasattr(mine, "worker"):
            worker = _Worker(start, *arguments)
            workers.append(worker)
            worker.receive()
            mine.worker = worker
        return mine.worker.call(function, *args)

    try:
        with concurrent.futures.ThreadPoolExecutor(num_workers) as threads:
            try:
                yield lambda *call: threads.submit(work, *call)
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise
    finally:
        for worker in workers:
            worker.pipe.close()
        for worker in workers:
            worker.process.join()


class _Worker:
    """A process that does what it is sent, and this thread's end of its pipe."""

    def __init__(self, start: Callable[..., None], *arguments: Any) -> None:
        # Ctrl-C is for the main thread: what this one starts inherits the mask, which
        # the start of Python's resource tracker would clear.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self.pipe, theirs = CONTEXT.Pipe()
        self.process = CONTEXT.Process(
            target=_serve, args=(theirs, start, *arguments), daemon=True
        )
        self.process.start()
        theirs.close()  # now the pipe ends with the process
        self._has_started = False

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """What the function returns or raises there."""
        message = pickle.dumps((function, args))
        with contextlib.suppress(OSError):  # it is gone: `receive` tells
            self.pipe.send_bytes(message)
        return self.receive()

    def receive(self) -> Any:
        """What came of the last call; first of `start`."""
        try:
            message = self.pipe.recv_bytes()
        except (EOFError, OSError):
            self.process.join()
            is_killed = self._has_started or (self.process.exitcode or 0) < 0
            raise UserError(_KILLED if is_killed else _NOT_STARTED) from None
        self._has_started = True
        result, error = pickle.loads(message)
        if error is not None:
            raise error
        return result


def _serve(pipe: Connection, start: Callable[..., None], *arguments: Any) -> None:
    """Does what comes until the parent closes the pipe, or dies."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        pipe.send_bytes(_outcome(start, *arguments))
        while True:
            pipe.send_bytes(_outcome(_do, pipe.recv_bytes()))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    parent.join()
    os._exit(1)


def _do(message: bytes) -> Any:
    function, args = pickle.loads(message)
    return function(*args)


def _outcome(function: Callable[..., Any], *args: Any) -> bytes:
    """Result and error of a call, one of them None, as a message."""
    try:
        return pickle.dumps((function(*args), None))
    except BaseException as error:
        there = "".join(traceback.format_exception(error))
        error.add_note(f"\nIn the worker process:\n{there}")
        with contextlib.suppress(Exception):  # an error that pickle cannot carry
            return pickle.dumps((None, error))
        return pickle.dumps((None, RuntimeError(there)))
