"""Tests of `radejax.models.layers`; weights/test_radenet_torch.py has torch's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.layers import Conv, Dense, GroupNorm, Upsample


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_group_norm_equals_its_definition(offset):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 5, 3, 8)) * 3.0 + offset
    scale, bias = rng.standard_normal((2, 8))
    groups = x.reshape(2, 5, 3, 4, 2)
    mean = groups.mean((1, 2, 4), keepdims=True)
    variance = groups.var((1, 2, 4), keepdims=True)
    expected = ((groups - mean) / np.sqrt(variance + 1e-5)).reshape(x.shape)
    expected = expected * scale + bias
    params = {"scale": jnp.asarray(scale, jnp.float32), "bias": bias}
    actual = GroupNorm(4).apply({"params": params}, jnp.asarray(x, jnp.float32))
    # The input itself is only good to 1e-4 at an offset of 1000.
    np.testing.assert_allclose(actual, expected, atol=3e-4 if offset else 1e-5)


def test_group_norm_of_small_variance():
    """Of 100 and a little noise, whose variance sums of squares in bfloat16 would lose."""
    noise = np.random.default_rng(0).integers(-2, 3, (1, 16, 16, 8))
    x = 100.0 + jnp.asarray(noise, jnp.float32)
    params = {"scale": jnp.ones(8), "bias": jnp.zeros(8)}
    expected = GroupNorm(4).apply({"params": params}, x)
    narrow = GroupNorm(4, dtype=jnp.bfloat16)
    actual = narrow.apply({"params": params}, x.astype(jnp.bfloat16))
    assert actual.dtype == jnp.bfloat16
    np.testing.assert_allclose(actual.astype(jnp.float32), expected, atol=2e-2)

    def of_constant_map(x):
        return jnp.square(GroupNorm(4).apply({"params": params}, x)).sum()

    value, grad = jax.value_and_grad(of_constant_map)(jnp.full((1, 4, 4, 8), 7.0))
    np.testing.assert_allclose(value, 0.0, atol=1e-6)
    assert np.isfinite(grad).all()


@pytest.mark.parametrize(
    ("module", "fan_in"),
    [(Conv(64, 3), 9 * 16), (Dense(64), 16), (Upsample(64), 4 * 64)],
)
def test_initial_weights_and_biases_fill_torchs_interval(module, fan_in):
    params = module.init(jax.random.key(0), jnp.zeros((1, 2, 2, 16)))["params"]
    bound = fan_in**-0.5
    for leaf in params.values():
        assert bound * 0.9 < np.abs(leaf).max() <= bound
