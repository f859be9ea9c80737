"""Tests of `radejax.models.convolution`."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.convolution import blocked_kernel_gradient, conv2d


def naive_conv(x, kernel, dilation):
    """Sum over taps of shifted copies, float64."""
    size = kernel.shape[0]
    p = dilation * (size // 2)
    r, a = x.shape[1:3]
    padded = np.pad(x.astype(np.float64), ((0, 0), (p, p), (p, p), (0, 0)))
    return sum(
        padded[:, i * dilation : i * dilation + r, j * dilation : j * dilation + a]
        @ kernel[i, j].astype(np.float64)
        for i in range(size)
        for j in range(size)
    )


def arrays(*shapes, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(shape).astype(np.float32) for shape in shapes]


def test_impulse_spreads_the_flipped_kernel():
    x = jnp.zeros((1, 5, 5, 1)).at[0, 2, 2, 0].set(1.0)
    kernel = jnp.arange(9.0).reshape(3, 3, 1, 1)
    y = conv2d(x, kernel)[0, 1:4, 1:4, 0]
    np.testing.assert_array_equal(y, [[8, 7, 6], [5, 4, 3], [2, 1, 0]])


@pytest.mark.parametrize(("size", "dilation"), [(1, 1), (3, 1), (3, 2), (3, 3), (7, 1)])
def test_equals_sum_of_shifted_copies(size, dilation):
    x, kernel = arrays((2, 11, 9, 4), (size, size, 4, 3))
    y = jax.jit(conv2d, static_argnums=2)(x, kernel, dilation)
    np.testing.assert_allclose(y, naive_conv(x, kernel, dilation), atol=2e-5)


# 83 x 61 bins are more than one block and fill the last block in part only; the last
# shape has few bins and many weights.
@pytest.mark.parametrize(
    ("shape", "features"),
    [((2, 83, 61, 3), 4), ((1, 7, 5, 3), 4), ((2, 9, 6, 130), 131)],
)
@pytest.mark.parametrize(("size", "dilation"), [(1, 1), (3, 1), (3, 3), (7, 1)])
def test_gradients_equal_those_of_plain_convolution(shape, features, size, dilation):
    shapes = shape, (size, size, shape[-1], features), (*shape[:3], features)
    x, kernel, cotangent = map(jnp.asarray, arrays(*shapes))

    def plain(x, kernel):
        p = dilation * (size // 2)
        return jax.lax.conv_general_dilated(
            x,
            kernel,
            (1, 1),
            ((p, p), (p, p)),
            rhs_dilation=(dilation, dilation),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )

    def gradients(f):
        return jax.jit(lambda x, k: jax.vjp(f, x, k)[1](cotangent))(x, kernel)

    actual = gradients(functools.partial(conv2d, dilation=dilation))
    chex.assert_trees_all_close(actual, gradients(plain), atol=2e-3, rtol=1e-4)


def test_blocked_kernel_gradient_accumulates_bfloat16_in_float32():
    x, grad = arrays((1, 64, 64, 2), (1, 64, 64, 2))
    ours = [jnp.asarray(v, jnp.bfloat16) for v in (x, grad)]
    actual = blocked_kernel_gradient(*ours, size=3, dilation=1)
    assert actual.dtype == jnp.bfloat16
    wide = [v.astype(jnp.float32) for v in ours]
    expected = blocked_kernel_gradient(*wide, size=3, dilation=1)
    np.testing.assert_allclose(
        actual.astype(jnp.float32), expected, rtol=5e-3, atol=1e-2
    )
