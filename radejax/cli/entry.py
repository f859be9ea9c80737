"""What `train.py`, `evaluate.py` and `radejax` share: errors, logging, JAX's set-up.

JAX and absl are imported by the functions that use them: `--help` should not wait.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import pathlib
import signal
import sys
from collections.abc import Iterator

from radejax.core.errors import UserError, one_line
from radejax.core.files import is_no_space

FAILED = 1
WRONG_USE = 2
INTERRUPTED = 128 + signal.SIGINT

_WRONG_PATH = (
    FileNotFoundError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)


@contextlib.contextmanager
def exit_codes(*, debug: bool = False) -> Iterator[None]:
    """Ends the program with one line instead of a traceback for the user's errors.

    Exit code 2 for wrong use (arguments, folders), 1 for damaged data or a full disk, 130
    for an interrupt: see `core.errors`. Where the caller closed standard error, what is
    said goes nowhere instead of into the next file that is opened.

    Args:
        debug: Let the traceback through.
    """
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, for the program's life
    try:
        yield
    except KeyboardInterrupt as error:
        second = f" ({error})" if str(error) else ""
        _fail(UserError(f"interrupted{second}"), INTERRUPTED, debug)
    except ValueError as error:
        if not hasattr(error, "exit_code"):
            raise
        _fail(error, error.exit_code, debug)
    except _WRONG_PATH as error:
        _fail(error, WRONG_USE, debug)
    except OSError as error:
        if error.errno != errno.EROFS and not is_no_space(error):
            raise
        _fail(error, WRONG_USE if error.errno == errno.EROFS else FAILED, debug)


def _fail(error: Exception, code: int, debug: bool) -> None:
    if debug:
        raise error
    message = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{error.strerror}: {error.filename}"
        if isinstance(error, FileNotFoundError):
            message = f"no such file or folder: {error.filename}"
        if error.errno == errno.EROFS:
            message += "; name another place (--out, --workdir, --records, --data)"
    sys.stderr.write(f"error: {message}\n")
    raise SystemExit(code)


def join_processes(
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> None:
    """Joins the other processes of a run; to be called before anything uses JAX.

    Under Slurm, Open MPI, Kubernetes and on TPU pods JAX finds the arguments itself.

    Args:
        coordinator: "host:port" of process 0, with a port that is free there.
        num_processes: Of the run.
        process_id: Of this process, from 0.

    Raises:
        UserError: JAX finds no cluster, or the coordinator is not reached.
    """
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, num_processes, process_id)
    except (ValueError, RuntimeError) as error:
        raise UserError(
            f"cannot join the other processes ({one_line(error)}); without Slurm, Open "
            "MPI or a TPU pod give --coordinator HOST:PORT, --num-processes and "
            "--process-id"
        ) from error
    if jax.process_index():
        logging.getLogger("radejax").setLevel(logging.ERROR)
        os.environ["TQDM_DISABLE"] = "1"  # read when tqdm is imported


def set_up_jax(*, cache: bool = True) -> None:
    """Logging at level info without noise, and a compilation cache that persists.

    Args:
        cache: Keep compiled programs in the folder that the environment variable
            JAX_COMPILATION_CACHE_DIR names, or the user's cache folder.
    """
    import jax
    from absl import flags
    from absl import logging as absl_logging

    log = logging.getLogger("radejax")
    if not log.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.setLevel(logging.INFO)
        log.propagate = False
    # Orbax logs every step it takes; its errors are raised as well.
    absl_logging.set_verbosity(absl_logging.FATAL)
    flags.FLAGS.mark_as_parsed()  # grain's worker processes read one of theirs
    if not cache:
        return
    home = os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache")
    folder = os.environ.get(
        "JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(home) / "radejax" / "jax")
    )
    jax.config.update("jax_compilation_cache_dir", folder)
    # Every program: the fifty small ones of a start take a second and 200 kB.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
