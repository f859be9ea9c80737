"""Worker processes that leave Ctrl-C to their parent and end with it, and their number."""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import math
import multiprocessing
import os
import pathlib
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from radejax.core.errors import UserError

T = TypeVar("T")
Submit = Callable[..., concurrent.futures.Future[Any]]

# At K-Radar's size, 446 MB were measured for reading a compressed radar tensor and 320 MB
# for simulating with images, libraries included.
_WORKER_BYTES = 450e6
_CONTROL_GROUPS = pathlib.Path("/sys/fs/cgroup")
_PROC = pathlib.Path("/proc")


def usable_cpus() -> int:
    """Returns the number of CPUs that this process may use, at least 1.

    These are the CPUs of its affinity (`taskset`, Slurm), up to the limit of its control
    groups (containers).
    """
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    for group in _control_groups("cpu"):
        names = "cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us"
        values = "".join(_read(group / name) for name in names).split()
        if values and values[0].isdigit():  # "max" and "-1" are no limit
            quota, period = map(int, values)
            count = min(count, math.ceil(quota / period))
    return max(count, 1)


def default_workers() -> int:
    """Returns the number of worker processes for which there are CPUs and memory.

    Half of the available memory is left to this process and the cache of files.
    """
    meminfo = _read(_PROC / "meminfo")  # of Linux
    found = re.search(r"^MemAvailable: *(\d+) kB", meminfo, re.MULTILINE)
    available = 1024 * int(found[1]) if found else math.inf
    for group in _control_groups("memory"):
        limit = _read(group / "memory.max") or _read(group / "memory.limit_in_bytes")
        if limit.strip().isdigit():
            available = min(available, int(limit))
    return int(max(1, min(usable_cpus(), available / 2 // _WORKER_BYTES)))


def _control_groups(controller: str) -> Iterator[pathlib.Path]:
    """Yields the folders of the control groups that limit this process.

    A group also has the limits of those above it. Version 1 has a tree for each
    controller, version 2 one tree for all.
    """
    for line in _read(_PROC / "self" / "cgroup").splitlines():
        _, controllers, name = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        tree = _CONTROL_GROUPS / controller if controllers else _CONTROL_GROUPS
        group = pathlib.PurePosixPath(name)
        yield from (tree / one.relative_to("/") for one in (group, *group.parents))


def _read(path: pathlib.Path) -> str:
    """Returns the text of a file of the kernel, or "" if there is no such file."""
    return path.read_text() if path.is_file() else ""


@contextlib.contextmanager
def process_pool(
    num_workers: int, start: Callable[..., object] | None = None, *arguments: object
) -> Iterator[Submit]:
    """Runs worker processes during a block and yields a function to submit work.

    In the processes, JAX uses CPUs only.

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
    end_rerun()
    others = multiprocessing.active_children()
    context = multiprocessing.get_context("spawn")
    begin = functools.partial(_start, start, *arguments)
    pool = concurrent.futures.ProcessPoolExecutor(num_workers, context, begin)
    try:
        with pool:
            try:
                yield functools.partial(_submit, pool)
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


def end_rerun() -> None:
    """Ends a worker that runs the main script again because it lacks the guard.

    It ends silently, as `process_pool` of the main process raises the error. What has side
    effects before it starts workers calls this first.
    """
    process = multiprocessing.current_process()
    if getattr(process, "_inheriting", False):  # while a worker imports the script
        raise SystemExit(1)


def _submit(
    pool: concurrent.futures.ProcessPoolExecutor,
    function: Callable[..., T],
    *arguments: object,
) -> concurrent.futures.Future[T]:
    """Submits work while SIGINT is blocked.

    A process that the pool starts for it inherits this signal mask. A mask that the process
    sets itself would come too late: Ctrl-C would end it while it imports its modules.
    """
    resource_tracker.ensure_running()  # starting it later would clear the mask
    old = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(function, *arguments)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)


def _start(start: Callable[..., object] | None, *arguments: object) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The accelerator is the parent's, which has reserved its memory.
    os.environ["JAX_PLATFORMS"] = "cpu"
    if "jax" in sys.modules:  # imported with the main module
        sys.modules["jax"].config.update("jax_platforms", "cpu")
    if start is not None:
        start(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    parent.join()
    os._exit(1)
