"""Image normalization, ResNet-50, and the necks that compute camera maps for both backbones.

Images are transferred as uint8 and normalized inside the jitted model. The trunk of the
ResNet (stem and first three stages) is frozen and its last stage is trained, so they are
separate modules. `radejax.weights.image_backbone` reads both from torchvision's file.

References:
    DinoRADE, section 3.2. The layers of the neck are those of the authors' code.
    He et al., Deep residual learning, arXiv:1512.03385. Strides are those of torchvision.
"""

from __future__ import annotations

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Bool, Float, Real

from radejax.models.convolution import product
from radejax.models.layers import Conv, Dense, Layer, uniform_fan_in

Tokens = Float[jax.Array, "B h w C"]
HasImage = Bool[jax.Array, " B"]
Mask = Bool[jax.Array, "B 1 1 1"] | None

_IMAGENET = np.array([(0.485, 0.456, 0.406), (0.229, 0.224, 0.225)], np.float32)
"""Mean and standard deviation of ImageNet's RGB values, scaled to [0, 1]."""


def normalize(
    image: Real[jax.Array, "B H W 3"], *, standardize: bool = True
) -> Float[jax.Array, "B H W 3"]:
    """Normalizes images to the scale that ImageNet-trained backbones expect.

    Args:
        image: `[B, H, W, 3]` RGB, either uint8 in 0..255 or floats. Floats are assumed to
            be normalized and are returned unchanged.
        standardize: Whether to subtract ImageNet's mean and divide by its standard
            deviation. The released DinoRADE only scales to [0, 1] for its ResNet.

    Returns:
        `[B, H, W, 3]` float32 for uint8 input, otherwise the input.
    """
    if jnp.issubdtype(image.dtype, jnp.floating):
        return image
    scaled = image.astype(jnp.float32) / 255.0
    if standardize:
        mean, std = _IMAGENET.reshape(2, 1, 1, 1, 3)
        scaled = (scaled - mean) / std
    return scaled


# Kernel taps that contribute to even (row 0) and odd (row 1) outputs, in input order.
_PHASE_TAPS = np.array([[3, 1], [2, 0]])


class TransposedConv(Layer):
    """Transposed 4x4 convolution, stride 2, padding 1: `[B,H,W,C]` -> `[B,2H,2W,C']`.

    Every output depends on 2x2 inputs through one of four kernels, selected by the parity
    of its row and column. All four are therefore computed by one matrix product, from the
    channels of four neighbors to 4 C' channels, which are then interleaved. With a
    convolution instead, of a dilated input or to 4 C' channels, the weight gradient takes
    seconds on a CPU.

    Attributes:
        features: Output channels C'.
        dtype: Dtype of the computation and the output.
    """

    features: int

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "B H W _"]
    ) -> Float[jax.Array, "B 2*H 2*W {self.features}"]:
        b, height, width, channels = x.shape
        # torch computes the fan-in of a transposed convolution from its output channels.
        init = uniform_fan_in(16 * self.features)
        kernel = self.param("kernel", init, (4, 4, channels, self.features))
        bias = self.param("bias", init, (self.features,)).astype(self.dtype)
        kernel = kernel[_PHASE_TAPS][:, :, _PHASE_TAPS]  # phase, tap, phase, tap, C, C'
        kernel = kernel.transpose(1, 3, 4, 0, 2, 5).reshape(4 * channels, -1)
        x = jnp.pad(x.astype(self.dtype), ((0, 0), (1, 1), (1, 1), (0, 0)))
        corners = np.ndindex(2, 2)
        x = jnp.concatenate(
            [x[:, i : i + height + 1, j : j + width + 1] for i, j in corners], -1
        )
        y = product(x, kernel.astype(self.dtype))
        y = y.reshape(b, height + 1, width + 1, 2, 2, self.features)
        rows = [
            jnp.stack([y[:, i : i + height, j : j + width, i, j] for j in (0, 1)], 3)
            for i in (0, 1)
        ]  # [B, H, W, 2, C'] each
        y = jnp.stack(rows, 2)  # [B, H, 2, W, 2, C']
        y = y.reshape(b, 2 * height, 2 * width, self.features)
        return y + jnp.expand_dims(bias, (0, 1, 2))


class CameraNeck(Layer):
    """Image tokens `[B, h, w, C]` -> camera map `[B, 4h, 4w, features]`.

    The layers are a linear layer, two transposed convolutions that each double the
    resolution, and a 3x3 convolution. The convolutions are each followed by batch
    normalization and ReLU.

    Attributes:
        features: Output channels.
        dtype: Dtype of the computation and the output; statistics are float32.
    """

    features: int = 128

    @nn.compact
    def __call__(
        self, tokens: Tokens, has_image: HasImage, *, train: bool = False
    ) -> Float[jax.Array, "B 4*h 4*w {self.features}"]:
        """Runs the neck.

        Args:
            tokens: `[B, h, w, C]` patch tokens.
            has_image: `[B]` bool, False for frames that are excluded from the batch
                statistics because they have no image.
            train: Whether to normalize by batch statistics and update the running
                statistics (collection "batch_stats").
        """
        x = Dense(self.features, dtype=self.dtype, name="proj")(tokens)
        for name in ("up_1", "up_2", "refine"):
            layer = Conv if name == "refine" else TransposedConv
            x = layer(self.features, dtype=self.dtype, name=name)(x)
            norm = batch_norm(f"{name}_norm", self.dtype, train)
            x = nn.relu(norm(x, mask=counted_frames(has_image)))
        return x


def counted_frames(has_image: HasImage) -> Bool[jax.Array, "B 1 1 1"]:
    """Returns the mask of the frames that enter the batch statistics.

    In a batch without any image, all frames enter, to avoid a division by zero. Its camera
    map is not used.
    """
    return (has_image | ~has_image.any())[:, None, None, None]


def batch_norm(name: str, dtype: DTypeLike, train: bool) -> nn.BatchNorm:
    """Returns batch normalization with torch's defaults (momentum 0.1, epsilon 1e-5).

    Unlike here, torch's running variance is unbiased. Over a camera map, the two variances
    agree to five digits.
    """
    return nn.BatchNorm(
        use_running_average=not train,
        momentum=0.9,
        epsilon=1e-5,
        dtype=dtype,
        use_fast_variance=False,
        name=name,
    )


STRIDE = 16
"""Image pixels per pixel of the trunk's output, along each axis."""


class FrozenBatchNorm(Layer):
    """Batch normalization with fixed statistics, which are stored as parameters.

    A frozen backbone thus has only parameters, and no forward pass updates any of them.

    Attributes:
        dtype: Dtype of the output.
    """

    @nn.compact
    def __call__(self, x: Float[jax.Array, "B H W C"]) -> Float[jax.Array, "B H W C"]:
        shape = (x.shape[-1],)
        scale = self.param("scale", nn.initializers.ones, shape)
        var = self.param("var", nn.initializers.ones, shape)
        bias = self.param("bias", nn.initializers.zeros, shape)
        mean = self.param("mean", nn.initializers.zeros, shape)
        factor = scale * jax.lax.rsqrt(var + 1e-5)
        shift = jnp.expand_dims(bias - mean * factor, (0, 1, 2)).astype(self.dtype)
        return x * jnp.expand_dims(factor, (0, 1, 2)).astype(self.dtype) + shift


def _conv(features: int, size: int, stride: int, dtype: DTypeLike, name: str) -> Conv:
    return Conv(features, size, stride=stride, use_bias=False, dtype=dtype, name=name)


class ResNetLayer(Layer, kw_only=True):
    """Base class of the layers of a ResNet.

    Attributes:
        frozen: Whether to normalize with fixed statistics, as in a detector's trunk.
            Otherwise there is batch normalization, which pretraining the trunk needs too.
    """

    frozen: bool = True

    def _normalize(
        self, x: jax.Array, name: str, train: bool, mask: Mask = None
    ) -> jax.Array:
        if self.frozen:
            return FrozenBatchNorm(dtype=self.dtype, name=name)(x)
        y: jax.Array = batch_norm(name, self.dtype, train)(x, mask=mask)
        return y


class Bottleneck(ResNetLayer):
    """Residual block of 1x1, 3x3 and 1x1 convolutions; the 3x3 convolution has the stride.

    If the numbers of channels differ, the shortcut has a 1x1 convolution.

    Attributes:
        features: Channels of the first two convolutions; the output has four times as many.
        stride: Stride of the block.
        dtype: Dtype of the computation and the output.
    """

    features: int
    stride: int

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "B H W C"], train: bool, mask: Mask = None
    ) -> Float[jax.Array, "B h w {4*self.features}"]:
        def block(
            x: jax.Array, features: int, size: int, stride: int, name: str
        ) -> jax.Array:
            x = _conv(features, size, stride, self.dtype, f"conv_{name}")(x)
            return self._normalize(x, f"norm_{name}", train, mask)

        y = nn.relu(block(x, self.features, 1, 1, "1"))
        y = nn.relu(block(y, self.features, 3, self.stride, "2"))
        y = block(y, 4 * self.features, 1, 1, "3")
        if x.shape[-1] != 4 * self.features:
            x = block(x, 4 * self.features, 1, self.stride, "shortcut")
        return nn.relu(x + y)


class ResNetTrunk(ResNetLayer):
    """Stem and first three stages of a ResNet, with a stride of 16 in total.

    Attributes:
        width: Channels of the stem, 64 in ResNet-50; the output has 16 times as many.
        depths: Number of blocks in each of the three stages.
        dtype: Dtype of the computation; the output is float32.
    """

    width: int = 64
    depths: tuple[int, int, int] = (3, 4, 6)

    @nn.compact
    def __call__(
        self, image: Float[jax.Array, "B H W 3"], train: bool = False
    ) -> Float[jax.Array, "B (H+15)//16 (W+15)//16 {16*self.width}"]:
        x = _conv(self.width, 7, 2, self.dtype, "stem_conv")(image)
        x = nn.relu(self._normalize(x, "stem_norm", train))
        x = nn.max_pool(x, (3, 3), (2, 2), ((1, 1), (1, 1)))
        for stage, depth in enumerate(self.depths, 1):
            width = self.width * 2 ** (stage - 1)
            shared = functools.partial(Bottleneck, frozen=self.frozen, dtype=self.dtype)
            for i in range(1, depth + 1):
                stride = 2 if stage > 1 and i == 1 else 1
                block = shared(width, stride, name=f"stage_{stage}_block_{i}")
                x = block(x, train)
        return x.astype(jnp.float32)


class ResNetNeck(Layer):
    """Last stage of a ResNet, with stride 2, and a 1x1 convolution.

    Attributes:
        features: Output channels.
        width: Channels of the ResNet's stem, 64 in ResNet-50.
        dtype: Dtype of the computation and the output.
    """

    features: int = 128
    width: int = 64

    @nn.compact
    def __call__(
        self, x: Tokens, has_image: HasImage, *, train: bool = False
    ) -> Float[jax.Array, "B (h+1)//2 (w+1)//2 {self.features}"]:
        """Runs the neck; the arguments are those of `CameraNeck`, with x the trunk's output."""
        mask = counted_frames(has_image)
        shared = functools.partial(Bottleneck, frozen=False, dtype=self.dtype)
        for i, stride in enumerate((2, 1, 1), 1):
            x = shared(8 * self.width, stride, name=f"block_{i}")(x, train, mask)
        return Conv(self.features, 1, use_bias=False, dtype=self.dtype, name="proj")(x)
