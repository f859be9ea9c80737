"""Convolution, normalization and resampling layers with torch's default initializers.

Maps are `[B, R, A, C]`, channels last. Parameters are float32; `dtype` is the dtype of the
computation and of the output. Normalization statistics are float32 for every `dtype`. Every
layer equals its torch counterpart up to rounding.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Float

from radejax.models.convolution import conv2d, plain_conv2d, product

Initializer = Callable[..., jax.Array]
Map = Float[jax.Array, "B R A C"]
Features = Float[jax.Array, "B R A _"]
"""Like `Map`, for layers that change the number of channels."""


def uniform_fan_in(fan_in: int) -> Initializer:
    """Returns torch's default initializer, uniform within plus or minus 1 / sqrt(fan_in).

    `torch.nn.Conv2d` and `Linear` use it for weights (as Kaiming-uniform with a = sqrt(5))
    and for biases.
    """
    bound = 1.0 / math.sqrt(fan_in)

    def init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        # The first numbers do not depend on how many are drawn. Rounding the count up
        # therefore changes no weight, but lets many shapes share a compiled generator.
        size = math.prod(shape)
        count = max(2**14, 4 ** math.ceil(math.log(size, 4)))
        numbers = jax.random.uniform(key, (count,), jnp.float32, -bound, bound)
        weights: jax.Array = _cut(numbers, shape)
        return weights

    return init


@functools.partial(jax.jit, static_argnums=1)
def _cut(numbers: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns the first numbers in the given shape."""
    return numbers[: math.prod(shape)].reshape(shape)


class Layer(nn.Module, kw_only=True):
    """Base class of the layers.

    Attributes:
        dtype: Dtype of the computation and the output.
    """

    dtype: DTypeLike = jnp.float32


class Part(Layer, kw_only=True):
    """Base class of the parts of a detector, to which it passes these fields.

    Attributes:
        num_groups: Groups of the normalizations.
        remat: Recompute blocks in the backward pass instead of storing them.
    """

    num_groups: int = 32
    remat: bool = False


class Conv(Layer):
    """Convolution padded by half the kernel's size, `[B, R, A, C]` -> `[B, r, a, C']`.

    Attributes:
        features: Output channels C'.
        size: Odd kernel size per axis; size 1 is computed as a matrix product.
        dilation: Dilation of the kernel in bins.
        stride: Stride per axis; a stride above 1 requires a dilation of 1.
        use_bias: Whether to add a bias per output channel.
        initial_bias: Constant added to the initial biases, which torch draws around 0.
    """

    features: int
    size: int = 3
    dilation: int = 1
    stride: int = 1
    use_bias: bool = True
    initial_bias: float = 0.0

    @nn.compact
    def __call__(self, x: Features) -> Float[jax.Array, "B r a {self.features}"]:
        init = uniform_fan_in(self.size**2 * x.shape[-1])
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = jnp.asarray(self.param("kernel", init, shape), self.dtype)
        x = jnp.asarray(x, self.dtype)
        if self.stride == 1:
            y = conv2d(x, kernel, self.dilation)
        else:
            y = plain_conv2d(x, kernel, stride=self.stride)
        if self.use_bias:
            bias = self.param(
                "bias", lambda *args: init(*args) + self.initial_bias, (self.features,)
            )
            y = y + jnp.expand_dims(bias.astype(self.dtype), (0, 1, 2))
        return y


class Dense(Layer):
    """Linear layer on the last axis with torch's initializer.

    Attributes:
        features: Output channels.
    """

    features: int

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "*batch _"]
    ) -> Float[jax.Array, "*batch {self.features}"]:
        init = uniform_fan_in(x.shape[-1])
        kernel = self.param("kernel", init, (x.shape[-1], self.features))
        bias = self.param("bias", init, (self.features,)).astype(self.dtype)
        y = product(x.astype(self.dtype), kernel.astype(self.dtype))
        return y + jnp.expand_dims(bias, range(y.ndim - 1))


class Upsample(Layer):
    """Transposed 2x2 convolution with stride 2, `[B, R, A, C]` -> `[B, 2R, 2A, C']`.

    The outputs of neighboring inputs do not overlap, so the layer is computed as one matrix
    product and a reshape. With a dilated convolution, the weight gradient takes a second
    per frame on a CPU.

    Attributes:
        features: Output channels C'.
    """

    features: int

    @nn.compact
    def __call__(self, x: Features) -> Float[jax.Array, "B 2*R 2*A {self.features}"]:
        b, r, a, c = x.shape
        # torch computes the fan-in of a transposed convolution from its output channels.
        init = uniform_fan_in(4 * self.features)
        kernel = self.param("kernel", init, (2, 2, c, self.features))
        bias = self.param("bias", init, (self.features,)).astype(self.dtype)
        # Unlike einsum, this keeps channels innermost and does not transpose the whole map.
        matrix = kernel.astype(self.dtype).transpose(2, 0, 1, 3).reshape(c, -1)
        y = product(x.astype(self.dtype), matrix).reshape(b, r, a, 2, -1)
        y = y.swapaxes(2, 3).reshape(b, 2 * r, 2 * a, -1)
        return y + jnp.expand_dims(bias, (0, 1, 2))


def max_pool(x: Map) -> Float[jax.Array, "B R//2 A//2 C"]:
    """Returns the maximum over blocks of 2x2 bins."""
    b, r, a, c = x.shape
    return x.reshape(b, r // 2, 2, a // 2, 2, c).max((2, 4))


class GroupNorm(Layer):
    """Group normalization over bins and the channels of a group, with scale and bias.

    Sums are computed per channel and then combined into groups, so that the map is read
    with channels innermost.

    Attributes:
        num_groups: Number of groups; must divide the number of channels.
        dtype: Dtype of the output; statistics are float32.
    """

    num_groups: int

    @nn.compact
    def __call__(self, x: Map) -> Map:
        b, r, a, c = x.shape
        scale = self.param("scale", nn.initializers.ones, (c,))
        bias = self.param("bias", nn.initializers.zeros, (c,))
        x = x.astype(jnp.float32)
        group_size = c // self.num_groups

        def over_group(sums: Float[jax.Array, "B C"]) -> Float[jax.Array, "B 1 1 C"]:
            per_group = sums.reshape(b, self.num_groups, -1).sum(-1)
            per_group = per_group / (r * a * group_size)
            return jnp.repeat(per_group, group_size, -1)[:, None, None]

        centered = x - over_group(x.sum((1, 2)))
        variance = over_group(jnp.square(centered).sum((1, 2)))
        factor = jax.lax.rsqrt(variance + 1e-5) * jnp.expand_dims(scale, (0, 1, 2))
        y = centered * factor + jnp.expand_dims(bias, (0, 1, 2))
        return y.astype(self.dtype)


class ConvGNSiLU(Layer):
    """Convolution, group normalization and SiLU, `[B, R, A, C]` -> `[B, R, A, C']`.

    Attributes:
        features: Output channels C'.
        num_groups: Groups of the normalization.
        size: Odd kernel size per axis.
        dilation: Dilation of the kernel in bins.
        use_bias: Whether the convolution has a bias.
    """

    features: int
    num_groups: int
    size: int = 3
    dilation: int = 1
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Features) -> Features:
        conv = functools.partial(Conv, use_bias=self.use_bias, dtype=self.dtype)
        x = conv(self.features, self.size, self.dilation, name="conv")(x)
        x = GroupNorm(self.num_groups, dtype=self.dtype, name="norm")(x)
        return nn.silu(x)


class DoubleConvResidual(Layer):
    """Two `ConvGNSiLU` with a residual connection, which is added after the activation.

    If the numbers of channels differ, the shortcut has a 1x1 convolution.

    Attributes:
        features: Output channels.
        num_groups: Groups of the normalizations.
    """

    features: int
    num_groups: int

    @nn.compact
    def __call__(self, x: Features) -> Features:
        shortcut = x
        if x.shape[-1] != self.features:
            shortcut = Conv(self.features, 1, dtype=self.dtype, name="shortcut")(x)
        for i in (1, 2):
            x = ConvGNSiLU(
                self.features, self.num_groups, dtype=self.dtype, name=f"conv_{i}"
            )(x)
        return x + shortcut
