"""Necks, which widen the receptive field, and heads, which predict.

Heads are decoupled: a class heatmap and eight box parameters per bin.

References:
    RADE-Net, sections III-D and III-E, and equation (12). "Sigmoid after each
    convolution" there is a slip: the released code has GroupNorm and SiLU between
    convolutions and one sigmoid at the end of the heatmap head, which lives in losses
    and decoding here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax.numpy as jnp

from radejax.core.structures import DetectionMaps
from radejax.models.layers import Conv, ConvGNSiLU, Features, GroupNorm, Map


class DilatedResidual(nn.Module):
    """Dilated `ConvGNSiLU`, convolution, normalization, plus the input, SiLU.

    Attributes:
        dilation: Distance of the first convolution's taps in bins.
        num_groups: Groups of the normalizations.
        dtype: Dtype of the computation and the output.
    """

    dilation: int
    num_groups: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Map) -> Map:
        features = x.shape[-1]
        y = ConvGNSiLU(
            features,
            self.num_groups,
            dilation=self.dilation,
            dtype=self.dtype,
            name="conv_1",
        )(x)
        y = Conv(features, dtype=self.dtype, name="conv_2")(y)
        y = GroupNorm(self.num_groups, dtype=self.dtype, name="norm")(y)
        return nn.silu(x + y)


class Neck(nn.Module):
    """What every neck has; it keeps shape and width.

    Attributes:
        num_groups: Groups of the normalizations.
        dtype: Dtype of the computation and the output.
        remat: Recompute blocks in the backward pass instead of storing them.
    """

    num_groups: int = 32
    dtype: Any = jnp.float32
    remat: bool = False


class DilatedNeck(Neck):
    """Three `DilatedResidual`, of dilation 1, 2 and 3."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        block = nn.remat(DilatedResidual) if self.remat else DilatedResidual
        for i in (1, 2, 3):
            x = block(i, self.num_groups, dtype=self.dtype, name=f"block_{i}")(x)
        return x


class PlainNeck(Neck):
    """Three `ConvGNSiLU`."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        block, width = nn.remat(ConvGNSiLU) if self.remat else ConvGNSiLU, x.shape[-1]
        for i in (1, 2, 3):
            x = block(width, self.num_groups, dtype=self.dtype, name=f"block_{i}")(x)
        return x


NECKS: dict[str, type[Neck]] = {"dilated": DilatedNeck, "plain": PlainNeck}
"""What `config.model.neck` may name."""


NUM_BOX_PARAMS = 8


class Head(nn.Module):
    """What every head has: `[B, R, A, C]` -> `[B, R, A, features]`, float32.

    Attributes:
        features: Output channels.
        num_groups: Groups of the normalizations.
        dtype: Dtype of the computation up to the last convolution.
        remat: Recompute blocks in the backward pass instead of storing them.
        initial_bias: What the output's initial biases scatter around.
    """

    features: int
    num_groups: int = 32
    dtype: Any = jnp.float32
    remat: bool = False
    initial_bias: float = 0.0

    def convolve(self, x: Features, widths: Sequence[int]) -> Features:
        """`ConvGNSiLU` of these widths, then a 1x1 convolution in float32."""
        block = nn.remat(ConvGNSiLU) if self.remat else ConvGNSiLU
        for i, width in enumerate(widths, 1):
            x = block(width, self.num_groups, dtype=self.dtype, name=f"conv_{i}")(x)
        out = Conv(self.features, 1, initial_bias=self.initial_bias, name="out")
        return out(x)


class ExpandedHead(Head):
    """Three blocks of the input's width."""

    @nn.compact
    def __call__(self, x: Features) -> Features:
        return self.convolve(x, (x.shape[-1],) * 3)


class DefaultHead(Head):
    """One block of half the input's width and at most 64 channels."""

    @nn.compact
    def __call__(self, x: Features) -> Features:
        return self.convolve(x, (min(64, x.shape[-1] // 2),))


HEADS: dict[str, type[Head]] = {"expanded": ExpandedHead, "default": DefaultHead}
"""What `config.model.heads` may name."""


class Heads(nn.Module):
    """Features `[B, R, A, C]` -> `DetectionMaps`, float32.

    Attributes:
        num_classes: Channels of the heatmap.
        kind: Of `HEADS`.
        num_groups: Groups of the normalizations.
        dtype: Dtype of the computation up to the last convolution.
        remat: Recompute blocks in the backward pass instead of storing them.
        heatmap_prior: Confidence that an untrained model gives every bin: 0.5 as
            released; less (CenterNet: 0.1) starts nearer to a mostly empty scene.
    """

    num_classes: int
    kind: str = "expanded"
    num_groups: int = 32
    dtype: Any = jnp.float32
    remat: bool = False
    heatmap_prior: float = 0.5

    @nn.compact
    def __call__(self, x: Map) -> DetectionMaps:
        head = functools.partial(
            HEADS[self.kind],
            num_groups=self.num_groups,
            dtype=self.dtype,
            remat=self.remat,
        )
        logit = math.log(self.heatmap_prior / (1.0 - self.heatmap_prior))
        heatmap = head(self.num_classes, initial_bias=logit, name="heatmap")
        return DetectionMaps(heatmap(x), head(NUM_BOX_PARAMS, name="box")(x))
