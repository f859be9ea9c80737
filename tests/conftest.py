"""Settings shared by all tests."""

import faulthandler
import importlib.metadata
import logging
import os
import pathlib
import tempfile
import types
from collections.abc import Generator, Iterator

import pytest
from absl import flags

# Compilation takes most of the tests' time. Therefore LLVM does not optimize, and the older
# fusion emitters are used, which compile several times as fast (jaxlib 0.11 has removed them
# and aborts on the flag). `import jax` reads the variable. With XLA_FLAGS= in the
# environment, as in some of CI's slow tests, XLA compiles with its default settings.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0"
    + " --xla_cpu_use_fusion_emitters=false"
    * (importlib.metadata.version("jaxlib") < "0.11"),
)

import jax

# Functions that several tests or processes compile are compiled once per session; the
# workers of pytest-xdist inherit the folder.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="radejax-test-cache-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
_CACHED_FROM_SECS = 0.2
jax.config.update("jax_persistent_cache_min_compile_time_secs", _CACHED_FROM_SECS)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_numpy_rank_promotion", "raise")
# grain's multiprocess prefetch reads an absl flag.
flags.FLAGS.mark_as_parsed()

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"
GOLDEN = pathlib.Path(__file__).resolve().parent / "golden"


def pytest_addoption(
    parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager
) -> None:
    parser.addoption(
        "--shapes",
        action="store_true",
        help="check the annotations of radejax, shapes of arrays among them",
    )
    # The checks are installed here, as other conftests import radejax before options are read.
    if "--shapes" in pluginmanager.getplugin("pytestconfig").invocation_params.args:
        from . import shapes

        shapes.install()


_STDERR = pytest.StashKey[int]()
_GRACE_SECS = 60.0


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_STDERR] = os.dup(2)  # before pytest captures the output


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """End the process with a traceback if a test's timeout does not end the test.

    The timeout is an exception in the main thread. It has no effect while that thread runs
    C code or waits for another thread.
    """
    marker = item.get_closest_marker("timeout")
    given = marker.args[0] if marker else item.config.getoption("timeout")
    seconds = float(item.config.getini("timeout") if given is None else given)
    if seconds:
        faulthandler.dump_traceback_later(
            seconds + _GRACE_SECS, file=item.config.stash[_STDERR], exit=True
        )
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    if config.getoption("shapes"):
        if "--shapes" not in config.invocation_params.args:
            raise pytest.UsageError("--shapes must be on the command line itself")
        skip = pytest.mark.skip(reason="passes arguments that annotations forbid")
        for item in items:
            if item.get_closest_marker("wrong_types"):
                item.add_marker(skip)


def _reset_log() -> None:
    log = logging.getLogger("radejax")
    log.handlers.clear()
    log.propagate = True
    log.setLevel(logging.NOTSET)


@pytest.fixture(autouse=True)
def _process_as_it_was() -> Iterator[None]:
    """Undo what commands set for the whole process: log handlers and JAX's cache.

    The log is also reset before a test, as fixtures of a module may run commands.
    """
    _reset_log()
    yield
    _reset_log()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _CACHED_FROM_SECS)


@pytest.fixture
def one_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run trainings on one device, as compiling for eight takes long on few cores."""
    from radejax.training import distributed

    mesh = distributed.make_mesh(1)
    monkeypatch.setattr(distributed, "make_mesh", lambda *_: mesh)


@pytest.fixture(scope="session")
def shared() -> pathlib.Path:
    """Folder of unpublished reference data. Tests are skipped if it does not exist."""
    if not SHARED.is_dir():
        pytest.skip("reference data (../shared) not available")
    return SHARED


@pytest.fixture(scope="session")
def make() -> types.ModuleType:
    """Module with the seeded weights and inputs of the radar-camera golden files."""
    from radejax.core.config import (
        load_module,
    )  # imported after --shapes has installed its checks

    return load_module(GOLDEN / "dinorade_make.py")


@pytest.fixture(scope="session")
def golden() -> pathlib.Path:
    """Folder of the golden files in the repository."""
    return GOLDEN
