"""Channel and spatial attention on the skip connections (CBAM).

References:
    Woo et al., CBAM, arXiv:1807.06521; RADE-Net, equations (6) to (9).
"""

from __future__ import annotations

from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.models.layers import Conv, ConvGNSiLU, Dense, Map

CBAMKind = Literal["official", "paper"]

REDUCTION = 16
"""Channels per hidden unit of the channel attention's network."""


class ChannelAttention(nn.Module):
    """Scales channels by what a small network makes of their maximum and mean.

    The same two-layer network sees the global maximum and the global average; the
    sigmoid of the sum is the factor.

    Attributes:
        reduction: Channels per hidden unit.
        dtype: Dtype of the computation and the output.
    """

    reduction: int = REDUCTION
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Map) -> Map:
        channels = x.shape[-1]
        hidden = max(1, channels // self.reduction)
        squeeze = Dense(hidden, dtype=self.dtype, name="squeeze")
        excite = Dense(channels, dtype=self.dtype, name="excite")
        mean = x.mean((1, 2), dtype=jnp.float32).astype(self.dtype)
        pooled = jnp.stack([x.max((1, 2)), mean])  # [2, B, C]
        weight = nn.sigmoid(excite(nn.relu(squeeze(pooled))).sum(0))
        return x * weight[:, None, None]


class SpatialAttention(nn.Module):
    """Attention of every bin, in (0, 1).

    A 7x7 convolution over two maps: maximum and mean of the channels.

    Attributes:
        mean_first: The paper concatenates [mean, max], the released code [max, mean].
        dtype: Dtype of the computation and the output.
    """

    mean_first: bool = False
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Map) -> Float[jax.Array, "B R A 1"]:
        mean = x.mean(-1, dtype=jnp.float32).astype(self.dtype)
        pooled = [x.max(-1), mean]
        if self.mean_first:
            pooled.reverse()
        return nn.sigmoid(
            Conv(1, 7, dtype=self.dtype, name="conv")(jnp.stack(pooled, -1))
        )


class CBAM(nn.Module):
    """Channel attention, then spatial attention, on a skip connection.

    "official", the released block: `ConvGNSiLU`, both attentions, plus the output of
    the first convolution, `ConvGNSiLU`. "paper": the attentions alone.

    Attributes:
        kind: "official" or "paper".
        num_groups: Groups of the normalisations of the official block.
        dtype: Dtype of the computation and the output.
    """

    kind: CBAMKind
    num_groups: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Map) -> Map:
        is_official = self.kind == "official"
        channels = x.shape[-1]
        if is_official:
            x = ConvGNSiLU(channels, self.num_groups, dtype=self.dtype, name="start")(x)
        y = ChannelAttention(dtype=self.dtype, name="channel")(x)
        y = y * SpatialAttention(not is_official, dtype=self.dtype, name="spatial")(y)
        if is_official:
            y = y + x
            y = ConvGNSiLU(channels, self.num_groups, dtype=self.dtype, name="end")(y)
        return y
