"""Settings shared by all tests."""

import pathlib

import jax
import pytest
from absl import flags

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
def golden() -> pathlib.Path:
    """Folder of small golden files that travel with the tests."""
    return GOLDEN
