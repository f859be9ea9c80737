"""Necks: what widens the receptive field between backbone and heads.

References:
    RADE-Net, section III-D and equation (12).
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp

from radejax.models.layers import Conv, ConvGNSiLU, GroupNorm, Map


class DilatedResidual(nn.Module):
    """Dilated `ConvGNSiLU`, convolution, normalisation, plus the input, SiLU.

    Attributes:
        dilation: Distance of the first convolution's taps in bins.
        num_groups: Groups of the normalisations.
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
        num_groups: Groups of the normalisations.
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
