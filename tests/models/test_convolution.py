"""Tests of `radejax.models.convolution`."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.convolution import blocked_kernel_gradient, conv2d


def arrays(*shapes, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(shape).astype(np.float32) for shape in shapes]


# 83 x 61 bins are more than one block and fill the last block in part only; the last
# shape has few bins and many weights.
@pytest.mark.parametrize(
    ("shape", "features", "size", "dilation"),
    [
        ((2, 83, 61, 3), 4, 3, 3),
        ((2, 83, 61, 3), 4, 7, 1),
        ((1, 7, 5, 3), 4, 3, 1),
        ((2, 9, 6, 130), 131, 3, 2),
    ],
)
def test_outputs_and_gradients_equal_those_of_plain_convolution(
    shape, features, size, dilation
):
    shapes = shape, (size, size, shape[-1], features), (*shape[:3], features)
    x, kernel, cotangent = map(jnp.asarray, arrays(*shapes))

    def plain(x, kernel):
        p = dilation * (size // 2)
        options = {"rhs_dilation": (dilation, dilation)}
        options["dimension_numbers"] = ("NHWC", "HWIO", "NHWC")
        padding = ((p, p), (p, p))
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), padding, **options)

    def run(convolve):
        def both(x, kernel):
            out, pull = jax.vjp(convolve, x, kernel)
            return out, pull(cotangent)

        return jax.jit(both)(x, kernel)

    actual = run(functools.partial(conv2d, dilation=dilation))
    chex.assert_trees_all_close(actual, run(plain), atol=2e-3, rtol=1e-4)


def test_blocked_kernel_gradient_accumulates_bfloat16_in_float32():
    x, grad = arrays((1, 64, 64, 2), (1, 64, 64, 2))
    ours = [jnp.asarray(v, jnp.bfloat16) for v in (x, grad)]
    actual = blocked_kernel_gradient(*ours, size=3, dilation=1)
    assert actual.dtype == jnp.bfloat16
    wide = [v.astype(jnp.float32) for v in ours]
    expected = blocked_kernel_gradient(*wide, size=3, dilation=1)
    actual = actual.astype(jnp.float32)
    np.testing.assert_allclose(actual, expected, rtol=5e-3, atol=1e-2)
