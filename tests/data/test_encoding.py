import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from radejax.data.encoding import ENCODINGS, decode, encode, to_float

# Half a step of the type below 1, in decibels of power.
MAX_ERROR_DB = {
    "float16": 2.0**-12 * 184.3,
    "uint8": 0.5 / 255 * 184.3,
    "float32": 2.0**-25 * 184.3,
}


def test_eight_bits_by_hand():
    stored = encode(np.array([0.0, 1.0, 0.5, 0.1, -0.2, 1.3], np.float32), "uint8")
    assert stored.tolist() == [0, 255, 128, 26, 0, 255]  # 127.5 to even


@settings(deadline=None)
@given(
    levels=hnp.arrays(np.float32, 7, elements=st.floats(0, 1, width=32)),
    encoding=st.sampled_from(ENCODINGS),
)
def test_error_is_what_is_stated(levels, encoding):
    stored = encode(levels, encoding)
    assert stored.dtype == encoding
    error_db = np.abs(decode(stored).astype(np.float64) - levels).max() * 184.3
    assert error_db <= MAX_ERROR_DB[encoding] * (1 + 1e-3)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("jit", [False, True])
def test_device_and_host_decode_alike(encoding, jit):
    levels = np.linspace(0, 1, 300, dtype=np.float32)
    stored = encode(levels, encoding)
    function = jax.jit(to_float) if jit else to_float
    found = function(jnp.asarray(stored))
    assert found.dtype == jnp.float32
    chex.assert_trees_all_close(found, decode(stored), rtol=1e-6, atol=0)
