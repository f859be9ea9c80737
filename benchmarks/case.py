"""One measurement of `run.py`, and what the measured parts share."""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import numpy as np


@dataclasses.dataclass(kw_only=True)
class Case:
    """A measurement that alternates with those it is compared with.

    Attributes:
        name: What is done.
        columns: Name -> function that runs it once and gives wall and CPU seconds;
            "radejax" is ours.
        frames: Frames of one call.
        dtype: Of the computation.
        error: Greatest difference of the results, relative to the greatest value; None
            where there is nothing to compare with.
        tolerance: That `error` may have; a case beyond it is no measurement.
        mib: Memory that the program needs beside its arguments.
        compile_s: Seconds that our program took to compile.
        note: What else to know; or a function that says it after the measurement.
    """

    name: str
    columns: dict[str, Callable]
    frames: int = 1
    dtype: str = "float32"
    error: float | None = None
    tolerance: float = 1e-3
    mib: float | None = None
    compile_s: float | None = None
    note: str | Callable[[], str] = ""


def difference(found, wanted):
    """Greatest difference of arrays, relative to the greatest value of each."""
    return max(
        float(np.abs(np.asarray(a, np.float32) - b).max() / np.abs(b).max())
        for a, b in zip(found, wanted, strict=True)
    )


def compiled(function, *arguments, precision=None, **options):
    """Compiled program, and the fields of a `Case` that say what it cost.

    Memory is beside arguments and results.
    """
    began = time.perf_counter()
    with jax.default_matmul_precision(precision or "default"):
        program = jax.jit(function, **options).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    mib = program.memory_analysis().temp_size_in_bytes / 2**20
    return program, {"mib": mib, "compile_s": seconds}


def timed(function):
    """Wall and CPU seconds of one call."""
    wall, processor = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - processor


def waiting(program, *arguments):
    """Function for a column: seconds of a call until its results are there."""
    return functools.partial(timed, lambda: jax.block_until_ready(program(*arguments)))
