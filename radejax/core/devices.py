"""Devices and processes: mesh, placement of arrays, main process and signals.

Computations are data parallel: every device holds all parameters and a slice of the batch.
With `fsdp`, the large parameters and their optimizer state are also split over the same
devices, and XLA gathers them where a layer needs them.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Literal, TypeVar

import jax
import numpy as np
from jax._src import distributed as jax_distributed
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree, Shaped

from radejax.core.errors import UserError, one_line, require

_log = logging.getLogger(__name__)

T = TypeVar("T")
ParameterSharding = Literal["replicated", "fsdp"]
DATA_AXIS = "data"

_WAIT_S = 7 * 24 * 3600  # preprocessing all of K-Radar takes hours
_numbers = itertools.count()

_DONE = "done"
_GRACE_S = 5
_LONGEST = 1024  # bytes of a message between processes


# Devices -----------------------------------------------------------------------------


def make_mesh(num_devices: int | None = None) -> Mesh:
    """Creates a one-dimensional mesh over the devices of all processes.

    Args:
        num_devices: Use only this many devices, the first ones; all if None.
    """
    devices = jax.devices()[:num_devices]
    return jax.make_mesh(
        (len(devices),), (DATA_AXIS,), axis_types=(AxisType.Auto,), devices=devices
    )


def replicated(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of arrays that every device holds completely.

    Args:
        mesh: Devices, see `make_mesh`.
    """
    return NamedSharding(mesh, PartitionSpec())


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of arrays whose leading axis is the batch.

    Args:
        mesh: Devices, see `make_mesh`.
    """
    return NamedSharding(mesh, PartitionSpec(DATA_AXIS))


def check_batch_size(batch_size: int, mesh: Mesh) -> None:
    """Raises `UserError` if the batch size is not a multiple of the number of devices."""
    expected = f"a multiple of {mesh.size} devices"
    is_multiple = batch_size % mesh.size == 0
    require(is_multiple, "config.train.batch_size", batch_size, expected)


def put_batch(
    batch: PyTree[Shaped[np.ndarray, "b ..."]], mesh: Mesh
) -> PyTree[Shaped[jax.Array, "B ..."]]:
    """Puts this process's `b = B / processes` frames onto the mesh as part of a global batch.

    Args:
        batch: Pytree of the arrays of this process.
        mesh: Devices of all processes.
    """
    return jax.make_array_from_process_local_data(batch_sharding(mesh), batch)


def state_sharding(
    state: PyTree, mesh: Mesh, parameters: ParameterSharding, min_size: int = 2**16
) -> PyTree[NamedSharding]:
    """Returns a pytree of `NamedSharding` with the placement of each array of a train state.

    Args:
        state: Pytree of arrays or `jax.ShapeDtypeStruct`.
        mesh: Mesh that `make_mesh` returned.
        parameters: "replicated", or "fsdp" to split every array of at least `min_size`
            elements along its largest axis that is a multiple of the mesh size.
        min_size: Number of elements below which arrays are replicated, because splitting
            them costs more than it saves.
    """
    size = mesh.devices.size

    def place(x: jax.Array | jax.ShapeDtypeStruct) -> NamedSharding:
        axes = [a for a in range(len(x.shape)) if x.shape[a] % size == 0]
        is_small = np.prod(x.shape, dtype=int) < min_size
        if parameters == "replicated" or is_small or not axes:
            return replicated(mesh)
        spec: list[str | None] = [None] * len(x.shape)
        spec[max(axes, key=lambda a: x.shape[a])] = DATA_AXIS
        return NamedSharding(mesh, PartitionSpec(*spec))

    return jax.tree.map(place, state)


# Processes ---------------------------------------------------------------------------


def is_main() -> bool:
    """Returns True on the process that writes logs, figures and configurations."""
    return jax.process_index() == 0


def main_only(work: Callable[[], T]) -> T | None:
    """Calls a function on the main process while the other processes wait.

    It is used for data, reports and figures, which may take long. Processes that continued
    would time out after minutes in a collective or in JAX's shutdown.

    Args:
        work: Function to call.

    Returns:
        The result of the function on the main process, and None on the others.

    Raises:
        UserError: The function failed on the main process, which raises the original
            error; the other processes raise this one.
    """
    if jax.process_count() == 1:
        return work()
    result = error = None
    try:
        result = work() if is_main() else None
    except Exception as failed:
        error = failed
    # They wait at the coordinator and not in a collective, which would time out after
    # minutes.
    client = jax_distributed.global_state.client
    assert client is not None  # there are several processes
    client.wait_at_barrier(f"radejax {next(_numbers)}", timeout_in_ms=1000 * _WAIT_S)
    is_fine = all_agree(error is None)
    if error is not None:
        raise error
    if not is_fine:
        raise UserError("process 0 stopped with an error, see its output")
    return result


def all_agree(is_fine: bool) -> bool:
    """Returns whether `is_fine` is true on every process, all of which must call this."""
    return bool(multihost_utils.process_allgather(np.int32(is_fine)).all())


def list_of_main(values: list[int]) -> list[int]:
    """Returns the list of process 0 on every process, all of which must call this.

    Processes may see different entries of a folder on a network file system.

    Args:
        values: Integers below 2**31. Those of other processes than 0 are ignored.
    """
    count = int(multihost_utils.broadcast_one_to_all(np.int32(len(values))))
    own = values if is_main() else [0] * count
    values = multihost_utils.broadcast_one_to_all(np.asarray(own, np.int32)).tolist()
    return values


@contextlib.contextmanager
def end_with_others() -> Iterator[None]:
    """Ends this process with one line and exit code 1 when another one of the run is lost.

    Every process holds a connection to process 0. The operating system closes it as soon
    as one of the two ends, even if it is killed. Processes that finish the block say so
    first. One that fails says so too, and the others have a few seconds to fail with the
    same error. It must be entered by all processes, after `jax.distributed.initialize`.
    """
    state = jax_distributed.global_state
    own = f"process {state.process_id} ({socket.gethostname()})"
    links = _connect(state, own)
    has_failed = threading.Event()
    _delay_aborts()
    for name in links:
        watch = threading.Thread(target=_watch, args=(name, links, has_failed))
        watch.daemon = True
        watch.start()
    try:
        yield
    except BaseException:
        # The loss of a process makes collectives fail. `_watch` says then which one it is.
        time.sleep(1)
        has_failed.set()
        _send(f"{_GRACE_S} {own} stopped with an error, see its output", links)
        raise
    _send(_DONE, links)


def _connect(state: jax_distributed.State, own: str) -> dict[str, socket.socket]:
    """Connects process 0 with all others.

    Args:
        state: State of `jax.distributed`.
        own: Name of this process.

    Returns:
        Connections by the name of the process at the other end.

    Raises:
        UserError: Process 0 cannot be reached.
    """
    key = "radejax/process 0"
    assert state.client is not None  # `jax.distributed.initialize` sets both
    assert state.coordinator_address is not None
    if state.process_id:
        host = state.coordinator_address.rpartition(":")[0].strip("[]")
        port, _, main = state.client.blocking_key_value_get(key, 300_000).partition(" ")
        try:
            links = {main: socket.create_connection((host, port))}
        except OSError as error:
            raise UserError(
                f"cannot connect to {main} at {host}:{port} ({one_line(error)}); open all "
                "ports between the hosts of a run"
            ) from error
        _send(own, links)
        return links
    links = {}
    is_dual = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if is_dual else socket.AF_INET
    with socket.create_server(("", 0), family=family, dualstack_ipv6=is_dual) as server:
        state.client.key_value_set(key, f"{server.getsockname()[1]} {own}")
        while len(links) < state.num_processes - 1:
            link, _ = server.accept()
            links[link.recv(_LONGEST).decode()] = link
    return links


def _send(text: str, links: Mapping[str, socket.socket]) -> None:
    for link in links.values():
        with contextlib.suppress(OSError):  # that process has ended
            link.sendall(text.encode())


def _watch(
    name: str, links: Mapping[str, socket.socket], has_failed: threading.Event
) -> None:
    """Waits for the end of another process, and ends this one if it was not a normal end.

    Args:
        name: Name of the other process.
        links: Result of `_connect`.
        has_failed: Whether this process stopped with an error of its own.
    """
    try:
        text = links[name].recv(_LONGEST).decode()
    except OSError:
        text = ""
    if text == _DONE:
        return
    delay_s, _, reason = (text or f"0 {name} was lost").partition(" ")
    time.sleep(int(delay_s))
    _send(f"0 {reason}", links)
    if not has_failed.is_set():
        line = f"\nerror: {reason}; start all processes again to continue\n"
        os.write(2, line.encode())
    os._exit(1)


def _delay_aborts() -> None:
    """Makes an abort of this process wait six seconds, so that `_watch` ends it first.

    JAX aborts all processes when process 0 is lost. The handler of SIGABRT is the C
    function `sleep`, whose argument is the number of the signal.
    """
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    libc.signal(signal.SIGABRT, ctypes.cast(libc.sleep, ctypes.c_void_p))


class Stopped(Exception):
    """Raised when a signal ends a long computation, such as an evaluation, early."""


@contextlib.contextmanager
def stop_on_signal(mesh: Mesh) -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether all processes should stop.

    The function returns True on all processes in the same call, once any of them received
    SIGTERM, SIGINT, SIGUSR1 or SIGHUP. Every process must call it equally often. SIGTERM
    and SIGINT raise `KeyboardInterrupt` at once if another signal came before.

    Processes can receive a signal in different steps, and those that continue would wait
    for the others forever. With several processes, each call therefore combines the flags
    of all processes and returns the result of the previous call.

    Args:
        mesh: Devices of all processes.
    """
    event = threading.Event()
    before = None
    any_of = jax.jit(lambda x: x.any(), out_shardings=replicated(mesh))

    def handle(number: int, _: object) -> None:
        name = signal.Signals(number).name
        if event.is_set() and number in (signal.SIGTERM, signal.SIGINT):
            raise KeyboardInterrupt(f"second {name}")
        _log.warning("%s: saving a checkpoint, then stopping", name)
        event.set()

    def stop() -> bool:
        nonlocal before
        if jax.process_count() == 1:
            return event.is_set()
        rows = np.full(len(mesh.local_devices), event.is_set())
        found = before
        before = any_of(put_batch(rows, mesh))
        return found is not None and bool(found)

    numbers = [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as `nohup` sets it
        numbers.append(signal.SIGHUP)
    # Python allows only the main thread to set signal handlers.
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            # A handler that was not set from Python, such as that of jax.distributed, is
            # returned as None and cannot be restored.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
