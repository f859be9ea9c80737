"""Stride-1 convolution of channels-last maps with a fast weight gradient on CPUs.

On a CPU, XLA computes the weight gradient as a convolution whose window is the whole map.
On the finest maps of RADE-Net, this is the slowest part of a training step. This module
instead sums over blocks of rows. The shifted copies of a block stay in the cache, and one
matrix product multiplies them with the gradient of the output. Other platforms, small
convolutions and 1x1 kernels use XLA's gradient.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Float

Inputs = Float[jax.Array, "B R A C"]
Outputs = Float[jax.Array, "B R A F"]
Kernel = Float[jax.Array, "k k C F"]
Operands = tuple[jax.Array, jax.Array]  # input and kernel, or their gradients

_BLOCK_BINS = 900
"""Bins per block, so that shifted copies fit in a CPU's cache; the fastest of 200 to 28,000."""

_MIN_BINS = 4096
_MIN_WEIGHTS = 128 * 128
"""Blocks are used only for more than `_MIN_BINS` bins or `_MIN_WEIGHTS` weights per tap."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv2d(x: Inputs, kernel: Kernel, dilation: int = 1) -> Outputs:
    """Computes a convolution with stride 1 and zero padding that keeps the map's size.

    The function has a custom VJP, so it can be differentiated in reverse mode only.

    Args:
        x: `[B, R, A, C]` map.
        kernel: `[k, k, C, F]` kernel with odd k, in the dtype of `x`.
        dilation: Dilation of the kernel in bins.

    Returns:
        `[B, R, A, F]` in the dtype of `x`.
    """
    return plain_conv2d(x, kernel, dilation)


def product(
    x: Float[jax.Array, "*batch C"], kernel: Float[jax.Array, "C F"]
) -> Float[jax.Array, "*batch F"]:
    """Multiplies the last axis of `x` by a matrix, as one product of two matrices.

    The result equals `x @ kernel`. If `x` has more than two axes, XLA computes the
    gradients of `x @ kernel` 1.5 to 4 times slower on a CPU.
    """
    flat = x.reshape(-1, x.shape[-1]) @ kernel
    return flat.reshape(*x.shape[:-1], kernel.shape[-1])


def plain_conv2d(
    x: jax.Array, kernel: jax.Array, dilation: int = 1, stride: int = 1
) -> jax.Array:
    """Computes a convolution padded by half the kernel's size, with XLA's gradients."""
    if kernel.shape[:2] == (1, 1):
        return product(x[:, ::stride, ::stride], kernel[0, 0])
    padding = dilation * (kernel.shape[0] // 2)
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        window_strides=(stride, stride),
        padding=((padding, padding),) * 2,
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def _forward(
    x: jax.Array, kernel: jax.Array, dilation: int
) -> tuple[jax.Array, Operands]:
    return plain_conv2d(x, kernel, dilation), (x, kernel)


def _backward(dilation: int, saved: Operands, grad: jax.Array) -> Operands:
    x, kernel = saved
    (grad_x,) = jax.vjp(lambda x: plain_conv2d(x, kernel, dilation), x)[1](grad)

    def plain(x: Inputs, grad: Outputs) -> Kernel:
        pull = jax.vjp(lambda k: plain_conv2d(x, k, dilation), kernel)[1]
        grad_kernel: jax.Array = pull(grad)[0]
        return grad_kernel

    size, _, *channels = kernel.shape
    num_bins = x.shape[1] * x.shape[2]
    is_small = num_bins <= _MIN_BINS and math.prod(channels) <= _MIN_WEIGHTS
    if size == 1 or is_small:
        return grad_x, plain(x, grad)
    blocked = functools.partial(blocked_kernel_gradient, size=size, dilation=dilation)
    grad_kernel = jax.lax.platform_dependent(x, grad, cpu=blocked, default=plain)
    return grad_x, grad_kernel


conv2d.defvjp(_forward, _backward)


def blocked_kernel_gradient(
    x: Inputs, grad: Outputs, *, size: int, dilation: int
) -> Float[jax.Array, "{size} {size} C F"]:
    """Computes the gradient of `conv2d` with respect to its kernel, over blocks of rows.

    Args:
        x: `[B, R, A, C]` input of the convolution.
        grad: `[B, R, A, F]` gradient with respect to the output.
        size: Kernel size k per axis.
        dilation: Dilation of the kernel in bins.

    Returns:
        `[k, k, C, F]` in the dtype of `x`, accumulated in float32.
    """
    b, r, a, c = x.shape
    padding = dilation * (size // 2)
    num_blocks = -(-r // max(1, _BLOCK_BINS // a))
    rows = -(-r // num_blocks)
    # The last block is padded with rows of zeros, which do not change the sum.
    fill = num_blocks * rows - r
    x = jnp.pad(x, ((0, 0), (0, fill), (0, 0), (0, 0)))
    # The left operand of the product needs bins innermost, so the gradient is transposed
    # once here.
    grad = jnp.pad(
        grad.swapaxes(2, 3), ((0, 0), (padding, padding + fill), (0, 0), (0, 0))
    )
    offsets = [dilation * tap for tap in range(size)]

    def add_block(total: jax.Array, i: jax.Array) -> tuple[jax.Array, None]:
        image = i // num_blocks
        start = i % num_blocks * rows
        block = jax.lax.dynamic_slice(x, (image, start, 0, 0), (1, rows, a, c))[0]
        block = jnp.pad(block, ((0, 0), (padding, padding), (0, 0)))
        # Taps along azimuth shift the map; taps along range shift rows of the gradient.
        taps = jnp.concatenate([block[:, o : o + a] for o in offsets], -1)
        shape = (1, rows, *grad.shape[2:])
        starts = [(image, start + 2 * padding - o, 0, 0) for o in offsets]
        parts = [jax.lax.dynamic_slice(grad, at, shape)[0] for at in starts]
        turned = jnp.concatenate([part.swapaxes(0, 1) for part in parts])
        product = jax.lax.dot_general(
            turned.reshape(-1, rows * a),
            taps.reshape(rows * a, -1),
            (((1,), (0,)), ((), ())),
            preferred_element_type=jnp.float32,
        )  # [k * F, k * C]
        return total + product, None

    zeros = jnp.zeros((size * grad.shape[2], size * c), jnp.float32)
    total, _ = jax.lax.scan(add_block, zeros, jnp.arange(b * num_blocks))
    kernel = total.reshape(size, -1, size, c)
    return kernel.transpose(0, 2, 3, 1).astype(x.dtype)
