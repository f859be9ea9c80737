"""Settings shared by all tests."""

import os
import pathlib
import tempfile
import types

import pytest
from absl import flags

# Compiling takes most of the time here, so LLVM optimises nothing; read by `import jax`.
# With XLA_FLAGS= in the environment programs are what users get: CI's slow tests.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax

from radejax.core.config import load_module

# Programs that several tests or processes compile are compiled once in a session; the
# workers of pytest-xdist inherit the folder.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="radejax-test-cache-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_numpy_rank_promotion", "raise")
# grain's multiprocess prefetch reads an absl flag.
flags.FLAGS.mark_as_parsed()

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"
GOLDEN = pathlib.Path(__file__).resolve().parent / "golden"


@pytest.fixture(scope="session")
def shared() -> pathlib.Path:
    """Folder of reference data that a user does not have; skips without it."""
    if not SHARED.is_dir():
        pytest.skip("reference data (../shared) not at hand")
    return SHARED


@pytest.fixture(scope="session")
def make() -> types.ModuleType:
    """Recipes of the radar-camera golden files: seeded weights and inputs."""
    return load_module(GOLDEN / "dinorade_make.py")


@pytest.fixture(scope="session")
def golden() -> pathlib.Path:
    """Folder of small golden files that travel with the tests."""
    return GOLDEN
