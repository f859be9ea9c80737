"""Necks: what widens the receptive field between backbone and heads.

References:
    RADE-Net, section III-D and equation (12).
"""

from __future__ import annotations

from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from radejax.models.layers import Conv, ConvGNSiLU, GroupNorm

NeckKind = Literal["dilated", "plain"]


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
    def __call__(self, x: jax.Array) -> jax.Array:
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
    """Three blocks that keep shape and width, `[B, R, A, C]` -> `[B, R, A, C]`.

    Attributes:
        kind: "dilated" for `DilatedResidual` of dilation 1, 2, 3; "plain" for
            three `ConvGNSiLU`.
        num_groups: Groups of the normalisations.
        dtype: Dtype of the computation and the output.
        remat: Recompute blocks in the backward pass instead of storing them.
    """

    kind: NeckKind = "dilated"
    num_groups: int = 32
    dtype: Any = jnp.float32
    remat: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        wrap = nn.remat if self.remat else lambda module: module
        residual, plain = wrap(DilatedResidual), wrap(ConvGNSiLU)
        features = x.shape[-1]
        for i in (1, 2, 3):
            name = f"block_{i}"
            if self.kind == "dilated":
                block = residual(i, self.num_groups, dtype=self.dtype, name=name)
            else:
                block = plain(features, self.num_groups, dtype=self.dtype, name=name)
            x = block(x)
        return x
