"""U-Net over the range-azimuth plane, with attention in the skip connections.

References:
    RADE-Net, section III-C, figure 3 and equations (6) to (9); Woo et al., CBAM,
    arXiv:1807.06521.
"""

from __future__ import annotations

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from radejax.core.options import find_part
from radejax.models import layers
from radejax.models.layers import ConvGNSiLU, DoubleConvResidual, Features, Map

REDUCTION = 16
"""Channels per hidden unit of the channel attention's network."""


class ChannelAttention(layers.Layer):
    """Scales channels by factors computed from their global maximum and global mean.

    The same two-layer network is applied to the maximum and to the mean. The factors are
    the sigmoid of the sum of both outputs.
    """

    @nn.compact
    def __call__(self, x: Map) -> Map:
        channels = x.shape[-1]
        hidden = max(1, channels // REDUCTION)
        squeeze = layers.Dense(hidden, dtype=self.dtype, name="squeeze")
        excite = layers.Dense(channels, dtype=self.dtype, name="excite")
        mean = x.mean((1, 2), dtype=jnp.float32).astype(self.dtype)
        pooled = jnp.stack([x.max((1, 2)), mean], 1)  # [B, 2, C]
        weight = nn.sigmoid(excite(nn.relu(squeeze(pooled))).sum(1))
        return x * weight[:, None, None]


class SpatialAttention(layers.Layer):
    """Computes the spatial attention weight of every bin, in (0, 1).

    The weight is the sigmoid of a 7x7 convolution over two maps, the maximum and the mean
    of the channels.

    Attributes:
        mean_first: Whether to concatenate [mean, max], as in the paper, instead of
            [max, mean], as in the authors' code.
    """

    mean_first: bool = False

    @nn.compact
    def __call__(self, x: Map) -> Float[jax.Array, "B R A 1"]:
        mean = x.mean(-1, dtype=jnp.float32).astype(self.dtype)
        pooled = [mean, x.max(-1)] if self.mean_first else [x.max(-1), mean]
        conv = layers.Conv(1, 7, dtype=self.dtype, name="conv")
        return nn.sigmoid(conv(jnp.stack(pooled, -1)))


class SkipAttention(layers.Layer):
    """Base class of the attention in a skip connection, which keeps shape and width.

    Attributes:
        num_groups: Groups of its normalizations.
    """

    num_groups: int


class CBAM(SkipAttention):
    """Channel attention followed by spatial attention.

    Attributes:
        is_official: Whether it is the block of the authors' code, which has a `ConvGNSiLU`
            before the attentions, adds the output of this convolution to theirs, and ends
            with another `ConvGNSiLU`. The paper's applies both attentions only.
    """

    is_official: bool = True

    @nn.compact
    def __call__(self, x: Map) -> Map:
        is_official = self.is_official
        block = functools.partial(
            ConvGNSiLU, x.shape[-1], self.num_groups, dtype=self.dtype
        )
        if is_official:
            x = block(name="start")(x)
        y = ChannelAttention(dtype=self.dtype, name="channel")(x)
        y = y * SpatialAttention(not is_official, dtype=self.dtype, name="spatial")(y)
        if is_official:
            y = block(name="end")(y + x)
        return y


class PaperCBAM(CBAM):
    """The CBAM of the paper."""

    is_official: bool = False


CBAMS: dict[str, type[SkipAttention]] = {
    "official": CBAM,
    "paper": PaperCBAM,
    "off": SkipAttention,
}
"""Attentions of the skip connections by their name in `config.model.cbam`."""


class InputStem(layers.Layer):
    """Encodes Doppler and elevation channels separately before mixing them.

    A 1x1 convolution encodes Doppler to `features` channels and another encodes elevation
    to `features / 2` channels. A 3x3 convolution mixes both. All convolutions have
    normalization and SiLU and no bias. An absent half is not encoded.

    Attributes:
        features: Output channels.
        doppler_bins: Number of Doppler channels, which precede the elevation channels.
        num_groups: Groups of the normalizations.
    """

    features: int
    doppler_bins: int
    num_groups: int

    @nn.compact
    def __call__(self, x: Features) -> Features:
        block = functools.partial(
            ConvGNSiLU, num_groups=self.num_groups, use_bias=False, dtype=self.dtype
        )
        halves = jnp.split(x, [self.doppler_bins], -1)
        widths = {"doppler": self.features, "elevation": self.features // 2}
        encoded = [
            block(width, size=1, name=name)(half)
            for (name, width), half in zip(widths.items(), halves, strict=True)
            if half.shape[-1]
        ]
        return block(self.features, name="mix")(jnp.concatenate(encoded, -1))


class Backbone(layers.Part):
    """U-Net, projection `[B, R, A, D+E]` -> features `[B, R, A, decoder_width]`.

    Encoder level i has `widths[i]` channels and then halves the resolution. Each decoder
    stage doubles it and concatenates the skip connection of the same level. R and A must
    be multiples of 2 ** len(widths).

    Attributes:
        doppler_bins: Number of Doppler channels of the input, used by `InputStem` only.
        widths: Channels of the encoder levels, finest first.
        decoder_width: Channels of the last decoder stage.
        cbam: Kind of the `CBAM` in the skip connections, or module:Class of another
            `SkipAttention`; "off" for skips without attention.
        input_stem: Whether to use `InputStem` instead of one 3x3 convolution.
    """

    doppler_bins: int
    widths: tuple[int, ...] = (128, 256, 512)
    decoder_width: int = 128
    cbam: str = "official"
    input_stem: bool = False

    @nn.compact
    def __call__(self, x: Features) -> Features:
        double = nn.remat(DoubleConvResidual) if self.remat else DoubleConvResidual
        block = functools.partial(double, num_groups=self.num_groups, dtype=self.dtype)
        part = find_part(self.cbam, "config.model.cbam", CBAMS)
        attend = nn.remat(part) if self.remat else part
        cbam = functools.partial(attend, self.num_groups, dtype=self.dtype)
        if self.input_stem:
            stem = functools.partial(InputStem, dtype=self.dtype, name="stem")
            x = stem(self.widths[0], self.doppler_bins, self.num_groups)(x)
        else:
            x = layers.Conv(self.widths[0], dtype=self.dtype, name="start")(x)
        skips = []
        for i, width in enumerate(self.widths, 1):
            x = block(width, name=f"encoder_{i}")(x)
            skips.append(x)
            x = layers.max_pool(x)
        for i in (1, 2):
            x = block(self.widths[-1], name=f"bottleneck_{i}")(x)
        decoder_widths = (*self.widths[-2::-1], self.decoder_width)
        for i, width in enumerate(decoder_widths, 1):
            skip = skips.pop()
            x = layers.Upsample(x.shape[-1], dtype=self.dtype, name=f"upsample_{i}")(x)
            if self.cbam != "off":
                skip = cbam(name=f"cbam_{i}")(skip)
            x = block(width, name=f"decoder_{i}")(jnp.concatenate([x, skip], -1))
        return x


BACKBONES: dict[str, type[Backbone]] = {"unet": Backbone}
"""Backbones by their name in `config.model.backbone`."""
