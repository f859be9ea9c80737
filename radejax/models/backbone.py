"""U-shaped encoder and decoder over the range-azimuth plane, with attention on the skips.

References:
    RADE-Net, section III-C, figure 3 and equations (6) to (9); Woo et al., CBAM,
    arXiv:1807.06521.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.models.layers import (
    Conv,
    ConvGNSiLU,
    Dense,
    DoubleConvResidual,
    Features,
    Map,
    Upsample,
    max_pool,
)

CBAMKind = Literal["official", "paper"]

REDUCTION = 16
"""Channels per hidden unit of the channel attention's network."""


class ChannelAttention(nn.Module):
    """Scales channels by what a small network makes of their maximum and mean.

    The same two-layer network sees the global maximum and the global average; the
    sigmoid of the sum is the factor.

    Attributes:
        dtype: Dtype of the computation and the output.
    """

    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Map) -> Map:
        channels = x.shape[-1]
        hidden = max(1, channels // REDUCTION)
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
        pooled = [mean, x.max(-1)] if self.mean_first else [x.max(-1), mean]
        conv = Conv(1, 7, dtype=self.dtype, name="conv")
        return nn.sigmoid(conv(jnp.stack(pooled, -1)))


class CBAM(nn.Module):
    """Channel attention, then spatial attention, on a skip connection.

    "official", the released block: `ConvGNSiLU`, both attentions, plus the output of
    the first convolution, `ConvGNSiLU`. "paper": the attentions alone.

    Attributes:
        kind: "official" or "paper".
        num_groups: Groups of the normalizations of the official block.
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


class InputStem(nn.Module):
    """Encodes Doppler and elevation channels apart before they are mixed.

    1x1 convolutions to `features` and `features / 2` channels, then a 3x3
    convolution; all with normalization and SiLU and without bias.

    Attributes:
        features: Output channels.
        doppler_bins: The first so many channels are Doppler, the rest elevation.
        num_groups: Groups of the normalizations.
        dtype: Dtype of the computation and the output.
    """

    features: int
    doppler_bins: int
    num_groups: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Features) -> Features:
        block = functools.partial(
            ConvGNSiLU, num_groups=self.num_groups, use_bias=False, dtype=self.dtype
        )
        doppler, elevation = jnp.split(x, [self.doppler_bins], -1)
        doppler = block(self.features, size=1, name="doppler")(doppler)
        elevation = block(self.features // 2, size=1, name="elevation")(elevation)
        mixed = jnp.concatenate([doppler, elevation], -1)
        return block(self.features, name="mix")(mixed)


class Backbone(nn.Module):
    """Projection `[B, R, A, D+E]` -> features `[B, R, A, decoder_width]`.

    Encoder level i halves the map after `widths[i]` channels; the decoder doubles it
    and joins the attended skip of the same level. R and A must be multiples of
    2 ** len(widths).

    Attributes:
        doppler_bins: Doppler channels of the input; only the stem tells them apart.
        widths: Channels of the encoder levels, finest first.
        decoder_width: Channels of the last decoder stage.
        num_groups: Groups of the normalizations.
        cbam: Attention on the skips, or None.
        input_stem: `InputStem` instead of one 3x3 convolution.
        dtype: Dtype of the computation and the output.
        remat: Recompute blocks in the backward pass instead of storing them.
    """

    doppler_bins: int
    widths: tuple[int, ...] = (128, 256, 512)
    decoder_width: int = 128
    num_groups: int = 32
    cbam: CBAMKind | None = "official"
    input_stem: bool = False
    dtype: Any = jnp.float32
    remat: bool = False

    @nn.compact
    def __call__(self, x: Features) -> Features:
        wrap = nn.remat if self.remat else lambda module: module
        shared: dict[str, Any] = {"num_groups": self.num_groups, "dtype": self.dtype}
        block = functools.partial(wrap(DoubleConvResidual), **shared)
        if self.input_stem:
            stem = InputStem(self.widths[0], self.doppler_bins, **shared, name="stem")
            x = stem(x)
        else:
            x = Conv(self.widths[0], dtype=self.dtype, name="start")(x)
        skips = []
        for i, width in enumerate(self.widths, 1):
            x = block(width, name=f"encoder_{i}")(x)
            skips.append(x)
            x = max_pool(x)
        for i in (1, 2):
            x = block(self.widths[-1], name=f"bottleneck_{i}")(x)
        decoder_widths = (*self.widths[-2::-1], self.decoder_width)
        for i, width in enumerate(decoder_widths, 1):
            skip = skips.pop()
            x = Upsample(x.shape[-1], dtype=self.dtype, name=f"upsample_{i}")(x)
            if self.cbam is not None:
                skip = wrap(CBAM)(self.cbam, **shared, name=f"cbam_{i}")(skip)
            x = block(width, name=f"decoder_{i}")(jnp.concatenate([x, skip], -1))
        return x


BACKBONES: dict[str, type[Backbone]] = {"unet": Backbone}
"""What `config.model.backbone` may name."""
