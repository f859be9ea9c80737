"""Settings shared by all tests."""

import faulthandler
import importlib.metadata
import logging
import os
import pathlib
import tempfile
import types
from collections.abc import Callable, Generator, Iterator
from typing import Any

import jax
import numpy as np
import pytest
from absl import flags

# Functions that several tests or processes compile are compiled once per session; the
# workers of pytest-xdist inherit the folder.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="radejax-test-cache-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
_CACHED_FROM_SECS = 0.2
jax.config.update("jax_persistent_cache_min_compile_time_secs", _CACHED_FROM_SECS)
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_numpy_rank_promotion", "raise")
# grain's multiprocess prefetch reads an absl flag.
flags.FLAGS.mark_as_parsed()

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"
TESTS = pathlib.Path(__file__).resolve().parent
GOLDEN = TESTS / "golden"

NUMERICAL = (
    *("models", "losses", "detection", "geometry", "weights"),
    *("data/test_projection.py", "training/test_state.py", "training/test_step.py"),
    "inference/test_detector.py",
)
"""Tests whose results depend on the device; an accelerator runs only these."""


def pytest_addoption(
    parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager
) -> None:
    parser.addoption(
        "--platform",
        choices=["cpu", "cuda", "tpu"],
        default="cpu",
        help="where to run; an accelerator runs the numerical tests only",
    )
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
    _set_up_jax(config.getoption("platform"))


# Compilation takes most of the tests' time. Therefore LLVM does not optimize, and the older
# fusion emitters are used, which compile several times as fast (jaxlib 0.11 has removed them
# and aborts on the flag). On a GPU, no algorithm is chosen by timing. With XLA_FLAGS= in the
# environment, as in some of CI's slow tests, XLA compiles with its default settings.
_FAST_ON_CPU = "--xla_backend_optimization_level=0" + (
    " --xla_cpu_use_fusion_emitters=false"
    * (importlib.metadata.version("jaxlib") < "0.11")
)
_FAST_ON_GPU = "--xla_gpu_autotune_level=0"


def _set_up_jax(platform: str) -> None:
    """Selects the platform. JAX reads all of this when a device is first used.

    Raises:
        pytest.UsageError: JAX finds no such accelerator.
    """
    if platform == "cpu":
        os.environ.setdefault("XLA_FLAGS", _FAST_ON_CPU)
        jax.config.update("jax_platforms", "cpu")
        return
    os.environ.setdefault("XLA_FLAGS", _FAST_ON_GPU)
    # Processes share the memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    jax.config.update("jax_platforms", f"{platform},cpu")
    # The default of a GPU is TF32, that of a TPU bfloat16: 1e-3 and more from the golden files.
    jax.config.update("jax_default_matmul_precision", "highest")
    if jax.default_backend() == "cpu":
        raise pytest.UsageError(
            f"--platform {platform}: JAX finds no such device, only "
            f"{jax.devices()[0].device_kind}; install radejax[{platform}]"
        )


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
    places = [TESTS / name for name in NUMERICAL]
    for item in items:
        is_within = not {item.path, *item.path.parents}.isdisjoint(places)
        if is_within and not item.get_closest_marker("cpu_only"):
            item.add_marker("numerical")
    if config.getoption("platform") != "cpu":
        others = [x for x in items if not x.get_closest_marker("numerical")]
        config.hook.pytest_deselected(items=others)
        items[:] = [x for x in items if x.get_closest_marker("numerical")]
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


@pytest.fixture(autouse=True)
def _tolerances(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Make the tolerances of arrays ten times as wide on an accelerator.

    They were chosen on CPUs. An accelerator adds in another order, and its elementary functions
    differ in the last bits. TF32 would still be noticed, with errors of a hundred times these.
    """
    if request.config.getoption("platform") == "cpu":
        return
    on_cpu = np.testing.assert_allclose  # chex calls it too

    def wider(
        actual: Any, desired: Any, rtol: float = 1e-7, atol: float = 0.0, **options: Any
    ) -> None:
        on_cpu(actual, desired, 10 * rtol, 10 * atol, **options)

    monkeypatch.setattr(np.testing, "assert_allclose", wider)


@pytest.fixture(scope="session")
def one_device() -> jax.sharding.Mesh:
    """Mesh of one device, as compiling for eight takes long on few cores."""
    from radejax.core import devices

    return devices.make_mesh(1)


@pytest.fixture
def commands_on_one_device(
    one_device: jax.sharding.Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run commands, which use all devices, on one."""
    from radejax.core import devices

    monkeypatch.setattr(devices, "make_mesh", lambda *_: one_device)


@pytest.fixture(scope="session")
def shared() -> pathlib.Path:
    """Folder of unpublished reference data. Tests are skipped if it does not exist."""
    if not SHARED.is_dir():
        pytest.skip("reference data (../shared) not available")
    return SHARED


@pytest.fixture(scope="session")
def make() -> types.ModuleType:
    """Module with the seeded weights and inputs of the radar-camera golden files."""
    # Imported after --shapes has installed its checks.
    from radejax.config import load_module

    return load_module(GOLDEN / "dinorade_make.py")


@pytest.fixture(scope="session")
def radenet_golden() -> types.ModuleType:
    """Module with seeded weights, configs and inputs of `models_radenet.npz`."""
    from radejax.config import load_module

    return load_module(GOLDEN / "models_radenet.py")


@pytest.fixture(scope="session")
def released() -> Callable[[str], dict[str, np.ndarray]]:
    """Function from a group of `tests/golden/released.npz` to its arrays."""
    arrays = dict(np.load(GOLDEN / "released.npz"))

    def group(name: str) -> dict[str, np.ndarray]:
        keys = [key for key in arrays if key.startswith(f"{name}/")]
        found = {key.removeprefix(f"{name}/"): arrays[key] for key in keys}
        assert found, name
        return found

    return group


@pytest.fixture(scope="session")
def golden() -> pathlib.Path:
    """Folder of the golden files in the repository."""
    return GOLDEN
