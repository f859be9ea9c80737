"""Decoupled heads: a class heatmap and eight box parameters per bin.

References:
    RADE-Net, section III-E. "Sigmoid after each convolution" there is a slip: the
    released code has GroupNorm and SiLU between convolutions and one sigmoid at the
    end of the heatmap head, which lives in losses and decoding here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax.numpy as jnp

from radejax.core.structures import DetectionMaps
from radejax.models.layers import Conv, ConvGNSiLU, Features, Map

NUM_BOX_PARAMS = 8


class Head(nn.Module):
    """What every head has: `[B, R, A, C]` -> `[B, R, A, features]`, float32.

    Attributes:
        features: Output channels.
        num_groups: Groups of the normalisations.
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
        num_groups: Groups of the normalisations.
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
        def head(features: int, bias: float, name: str) -> Head:
            return HEADS[self.kind](
                features,
                self.num_groups,
                self.dtype,
                self.remat,
                bias,
                name=name,
            )

        prior_logit = math.log(self.heatmap_prior / (1.0 - self.heatmap_prior))
        return DetectionMaps(
            heatmap_logits=head(self.num_classes, prior_logit, "heatmap")(x),
            box_params=head(NUM_BOX_PARAMS, 0.0, "box")(x),
        )
