"""From a coarse map of image tokens to a camera map four times finer.

References:
    DinoRADE, section 3.2; layers as in the released code.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from radejax.models.convolution import product
from radejax.models.layers import Conv, Dense, uniform_fan_in

# Which of the four taps even and odd outputs see, ordered along the input.
_PHASE_TAPS = np.array([[3, 1], [2, 0]])


class TransposedConv(nn.Module):
    """Transposed 4x4 convolution, stride 2, padding 1: `[B,H,W,C]` -> `[B,2H,2W,C']`.

    Every output sees 2x2 inputs through one of four kernels, by its parity: one matrix
    product of four neighbours to four times the channels, interleaved. As a convolution,
    of a dilated input or to four times the channels, its weight gradient alone takes
    seconds on a CPU.

    Attributes:
        features: Output channels C'.
        dtype: Dtype of the computation and the output.
    """

    features: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "B H W _"]
    ) -> Float[jax.Array, "B 2*H 2*W {self.features}"]:
        b, height, width, channels = x.shape
        # torch counts the fan-in of a transposed convolution over its outputs.
        init = uniform_fan_in(16 * self.features)
        kernel = self.param("kernel", init, (4, 4, channels, self.features))
        bias = self.param("bias", init, (self.features,)).astype(self.dtype)
        kernel = kernel[_PHASE_TAPS][:, :, _PHASE_TAPS]  # phase, tap, phase, tap, C, C'
        kernel = kernel.transpose(1, 3, 4, 0, 2, 5).reshape(4 * channels, -1)
        x = jnp.pad(x.astype(self.dtype), ((0, 0), (1, 1), (1, 1), (0, 0)))
        x = jnp.concatenate(
            [
                x[:, i : i + height + 1, j : j + width + 1]
                for i in (0, 1)
                for j in (0, 1)
            ],
            -1,
        )
        y = product(x, kernel.astype(self.dtype))
        y = y.reshape(b, height + 1, width + 1, 2, 2, self.features)
        rows = [
            jnp.stack(
                [y[:, i : i + height, j : j + width, i, j] for j in (0, 1)], axis=3
            )
            for i in (0, 1)
        ]  # [B, H, W, 2, C'] each
        y = jnp.stack(rows, 2)  # [B, H, 2, W, 2, C']
        y = y.reshape(b, 2 * height, 2 * width, self.features)
        return y + jnp.expand_dims(bias, (0, 1, 2))


class CameraNeck(nn.Module):
    """Image tokens `[B, h, w, C]` -> camera map `[B, 4h, 4w, features]`.

    A linear layer, two doublings by transposed convolutions and a 3x3 convolution, the
    last three with batch normalisation and ReLU.

    Attributes:
        features: Output channels.
        dtype: Dtype of the computation and the output; statistics are float32.
    """

    features: int = 128
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self,
        tokens: Float[jax.Array, "B h w C"],
        has_image: Bool[jax.Array, " B"],
        *,
        train: bool = False,
    ) -> Float[jax.Array, "B 4*h 4*w {self.features}"]:
        """Runs the neck.

        Args:
            tokens: `[B, h, w, C]` patch tokens.
            has_image: `[B]` bool; frames without image stay out of the statistics.
            train: Normalise by the batch and update the running statistics
                (collection "batch_stats").
        """
        x = Dense(self.features, dtype=self.dtype, name="proj")(tokens)
        layers = [
            TransposedConv(self.features, dtype=self.dtype, name="up_1"),
            TransposedConv(self.features, dtype=self.dtype, name="up_2"),
            Conv(self.features, dtype=self.dtype, name="refine"),
        ]
        for layer in layers:
            x = layer(x)
            x = batch_norm(f"{layer.name}_norm", self.dtype, train)(
                x, mask=counted_frames(has_image)
            )
            x = nn.relu(x)
        return x


def counted_frames(has_image: Bool[jax.Array, " B"]) -> Bool[jax.Array, "B 1 1 1"]:
    """Mask of the frames that enter batch statistics.

    A batch without any image must not divide by zero; its map is not used.
    """
    return (has_image | ~has_image.any())[:, None, None, None]


def batch_norm(name: str, dtype: Any, train: bool) -> nn.BatchNorm:
    """Batch normalisation as torch has it by default (momentum 0.1, epsilon 1e-5).

    torch's running variance is the unbiased one; over a camera map they are equal to
    five digits.
    """
    return nn.BatchNorm(
        use_running_average=not train,
        momentum=0.9,
        epsilon=1e-5,
        dtype=dtype,
        use_fast_variance=False,
        name=name,
    )
