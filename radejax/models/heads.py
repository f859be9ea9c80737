"""Necks, which enlarge the receptive field, and heads, which predict the maps.

Separate heads predict a class heatmap and eight box parameters per bin.

References:
    RADE-Net, sections III-D and III-E, and equation (12). The paper's "Sigmoid after each
    convolution" is an error: the authors' code has GroupNorm and SiLU between convolutions
    and one sigmoid at the end of the heatmap head. Here, losses and decoding apply that
    sigmoid.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import flax.linen as nn

from radejax.core.options import find_part
from radejax.core.structures import DetectionMaps
from radejax.models import layers
from radejax.models.layers import ConvGNSiLU, Features, Map


class DilatedResidual(layers.Layer):
    """Dilated `ConvGNSiLU`, convolution and normalization, with a residual, then SiLU.

    Attributes:
        dilation: Dilation of the first convolution in bins.
        num_groups: Groups of the normalizations.
    """

    dilation: int
    num_groups: int

    @nn.compact
    def __call__(self, x: Map) -> Map:
        features = x.shape[-1]
        block = functools.partial(ConvGNSiLU, dilation=self.dilation, dtype=self.dtype)
        y = block(features, self.num_groups, name="conv_1")(x)
        y = layers.Conv(features, dtype=self.dtype, name="conv_2")(y)
        y = layers.GroupNorm(self.num_groups, dtype=self.dtype, name="norm")(y)
        return nn.silu(x + y)


class Neck(layers.Part):
    """Base class of the necks, which keep the shape of a map."""


class DilatedNeck(Neck):
    """Three `DilatedResidual` blocks with dilations 1, 2 and 3."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        block = nn.remat(DilatedResidual) if self.remat else DilatedResidual
        for i in (1, 2, 3):
            x = block(i, self.num_groups, dtype=self.dtype, name=f"block_{i}")(x)
        return x


class PlainNeck(Neck):
    """Three `ConvGNSiLU` blocks."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        block = nn.remat(ConvGNSiLU) if self.remat else ConvGNSiLU
        width = x.shape[-1]
        for i in (1, 2, 3):
            x = block(width, self.num_groups, dtype=self.dtype, name=f"block_{i}")(x)
        return x


NECKS: dict[str, type[Neck]] = {"dilated": DilatedNeck, "plain": PlainNeck}
"""Necks by their name in `config.model.neck`."""


NUM_BOX_PARAMS = 8


class Head(layers.Part):
    """Base class of the heads, `[B, R, A, C]` -> `[B, R, A, features]` in float32.

    Attributes:
        features: Output channels.
        dtype: Dtype of the computation up to the last convolution.
        initial_bias: Constant added to the initial biases of the last convolution.
    """

    features: int
    initial_bias: float = 0.0

    def convolve(self, x: Features, widths: Sequence[int]) -> Features:
        """Applies `ConvGNSiLU` blocks and a 1x1 convolution in float32.

        Args:
            x: Features `[B, R, A, C]`.
            widths: Channels of the blocks.

        Returns:
            The output `[B, R, A, features]`.
        """
        block = nn.remat(ConvGNSiLU) if self.remat else ConvGNSiLU
        for i, width in enumerate(widths, 1):
            x = block(width, self.num_groups, dtype=self.dtype, name=f"conv_{i}")(x)
        out = layers.Conv(self.features, 1, initial_bias=self.initial_bias, name="out")
        return out(x)


class ExpandedHead(Head):
    """Head with three blocks that have as many channels as the input."""

    @nn.compact
    def __call__(self, x: Features) -> Features:
        return self.convolve(x, (x.shape[-1],) * 3)


class DefaultHead(Head):
    """Head with one block that has half as many channels as the input, at most 64."""

    @nn.compact
    def __call__(self, x: Features) -> Features:
        return self.convolve(x, (min(64, x.shape[-1] // 2),))


HEADS: dict[str, type[Head]] = {"expanded": ExpandedHead, "default": DefaultHead}
"""Heads by their name in `config.model.heads`."""


class Heads(layers.Part):
    """Heatmap head and box head, features `[B, R, A, C]` -> `DetectionMaps` in float32.

    Attributes:
        num_classes: Channels of the heatmap.
        kind: Name of the heads' type in `HEADS`, or "module:Class".
        dtype: Dtype of the computation up to the last convolution.
        heatmap_prior: Approximate score of every bin in an untrained model, 0.5 in the
            authors' code. A lower value (0.1 in CenterNet) suits mostly empty scenes.
        outputs: Names and channels of further heads.
    """

    num_classes: int
    kind: str = "expanded"
    heatmap_prior: float = 0.5
    outputs: Mapping[str, int] = dataclasses.field(default_factory=dict)

    @nn.compact
    def __call__(self, x: Map) -> DetectionMaps:
        head = functools.partial(
            find_part(self.kind, "config.model.heads", HEADS),
            num_groups=self.num_groups,
            dtype=self.dtype,
            remat=self.remat,
        )
        logit = math.log(self.heatmap_prior / (1.0 - self.heatmap_prior))
        heatmap = head(self.num_classes, initial_bias=logit, name="heatmap")
        box = head(NUM_BOX_PARAMS, name="box")
        others = {name: head(size, name=name)(x) for name, size in self.outputs.items()}
        return DetectionMaps(heatmap(x), box(x), others)
