"""The type of the measurements of `run.py`, and functions that they share."""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import numpy as np


@dataclasses.dataclass(kw_only=True)
class Case:
    """A measurement of one or several implementations in alternation.

    Attributes:
        name: Name of the measurement.
        columns: Function per implementation that runs it once and returns wall and CPU seconds;
            "radejax" is this package.
        frames: Number of frames per call.
        dtype: Data type of the computation.
        error: Largest difference of the results relative to the largest value; None if they are
            not compared.
        tolerance: Largest permitted `error`; a case above it is not measured.
        mib: Temporary memory of radejax's program in MiB, without arguments and results.
        compile_s: Time in seconds to trace and compile radejax's program, or of a first call that
            does this.
        note: Remark, or a function that returns it after the measurement.
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

    @property
    def key(self):
        """Name, dtype and frames, which identify a row."""
        return self.name, self.dtype, self.frames


def difference(found, wanted):
    """Returns the largest difference of pairs of arrays relative to the largest wanted value."""
    return max(
        float(np.abs(np.asarray(a, np.float32) - b).max() / np.abs(b).max())
        for a, b in zip(found, wanted, strict=True)
    )


def compiled(function, *arguments, precision=None, **options):
    """Returns a compiled program, and `Case` fields with its memory and compile time."""
    began = time.perf_counter()
    with jax.default_matmul_precision(precision or "default"):
        program = jax.jit(function, **options).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    mib = program.memory_analysis().temp_size_in_bytes / 2**20
    return program, {"mib": mib, "compile_s": seconds}


def first_call(function):
    """Returns the `Case` field with the time of a first call of a column, which compiles."""
    return {"compile_s": function()[0]}


def timed(function):
    """Returns wall and CPU seconds of one call; CPU seconds are those of the whole process."""
    wall, processor = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - processor


def waiting(program, *arguments):
    """Returns a function for a column that times a call until its results are ready."""
    return functools.partial(timed, lambda: jax.block_until_ready(program(*arguments)))
