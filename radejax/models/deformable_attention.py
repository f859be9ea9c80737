"""Attention that samples a few learned places of a map, around a reference point.

Two forms that agree to rounding. The plain one takes any queries, several maps and
reference boxes. The lifted one serves DinoRADE, where the queries of one radar bin are
multiples of its feature and their results are averaged: linear layers run once per
bin, the average happens while sampling, and the output projection after it, which is
ten times less work.

References:
    Zhu et al., Deformable DETR, arXiv:2010.04159.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from radejax.models.deformable_sampling import (
    Sizes,
    deformable_attention,
    lifted_attention,
    wide_dtype,
)


class Linear(nn.Module):
    """Linear layer whose product and bias can be had apart.

    Attributes:
        features_in: Input channels.
        features: Output channels.
        kernel_init: Initialiser of the kernel.
        bias_init: Initialiser of the bias.
        dtype: Dtype of the computation and the output.
        precision: Of the product, as in `jax.lax.dot`.
    """

    features_in: int
    features: int
    kernel_init: Any = nn.initializers.xavier_uniform()
    bias_init: Any = nn.initializers.zeros
    dtype: Any = jnp.float32
    precision: str | None = None

    def setup(self) -> None:
        shape = (self.features_in, self.features)
        self.kernel = self.param("kernel", self.kernel_init, shape)
        self.bias = self.param("bias", self.bias_init, (self.features,))

    def product(
        self, x: Float[jax.Array, "*batch {self.features_in}"]
    ) -> Float[jax.Array, "*batch {self.features}"]:
        """The layer without its bias."""
        x, kernel = x.astype(self.dtype), self.kernel.astype(self.dtype)
        return jnp.matmul(x, kernel, precision=self.precision)

    def __call__(
        self, x: Float[jax.Array, "*batch {self.features_in}"]
    ) -> Float[jax.Array, "*batch {self.features}"]:
        bias = jnp.expand_dims(self.bias.astype(self.dtype), range(x.ndim - 1))
        return self.product(x) + bias


class DeformableAttention(nn.Module):
    """Multi-head deformable cross-attention with its four linear layers.

    Attributes:
        features: Channels C of queries, values and output.
        num_heads: Attention heads; must divide C.
        num_points: Samples per head, query and map.
        num_levels: Maps.
        chunk_size: Queries (plain) or bins (lifted) at a time; 0 chooses by platform.
        dtype: Dtype of values and output; locations and weights are float32.
    """

    features: int
    num_heads: int = 4
    num_points: int = 4
    num_levels: int = 1
    chunk_size: int = 0
    dtype: Any = jnp.float32

    def setup(self) -> None:
        features, init = self.features, nn.initializers
        samples = self.num_heads * self.num_levels * self.num_points
        # Where to look needs all its digits, whatever the dtype of the features.
        place = functools.partial(
            Linear,
            precision="highest",
            kernel_init=init.zeros,
            dtype=wide_dtype(self.dtype),
        )
        self.sampling_offsets = place(features, 2 * samples, bias_init=self._ring)
        self.attention_weights = place(features, samples)
        self.value_proj = Linear(features, features, dtype=self.dtype)
        self.output_proj = Linear(features, features, dtype=self.dtype)

    def __call__(
        self,
        query: Float[jax.Array, "B Q C"],
        reference: Float[jax.Array, "B Q L _"],
        value: Float[jax.Array, "B pixels C"],
        sizes: Sizes,
        is_valid: Bool[jax.Array, "B pixels"] | None = None,
    ) -> Float[jax.Array, "B Q C"]:
        """Attention of any queries.

        Args:
            query: `[B, Q, C]`.
            reference: `[B, Q, L, 2]` points, or `[B, Q, L, 4]` boxes (center x, y,
                width, height), in 0..1; offsets are then in units of the box.
            value: `[B, sum of H W, C]`.
            sizes: Height and width of each of the L maps.
            is_valid: `[B, sum of H W]`, False where a pixel is padding and reads zero.

        Returns:
            `[B, Q, C]`.
        """
        b, queries = query.shape[:2]
        values = self.value_proj(value)
        if is_valid is not None:
            values = jnp.where(is_valid[..., None], values, 0.0)
        values = values.reshape(b, -1, self.num_heads, self.features // self.num_heads)
        locations, weights = self.samples(query, reference, sizes)
        out = deformable_attention(
            values, sizes, locations, weights, chunk_size=self.chunk_size or 4096
        )
        return self.output_proj(out.reshape(b, queries, -1))

    def samples(
        self,
        query: Float[jax.Array, "B Q C"],
        reference: Float[jax.Array, "B Q L _"],
        sizes: Sizes,
    ) -> tuple[Float[jax.Array, "B Q heads L P 2"], Float[jax.Array, "B Q heads L P"]]:
        """Locations and weights."""
        shape = (*query.shape[:2], self.num_heads, self.num_levels, self.num_points)
        offsets = self.sampling_offsets(query).reshape(*shape, 2)
        logits = self.attention_weights(query).reshape(*shape[:3], -1)
        weights = jax.nn.softmax(logits, -1).reshape(shape)
        reference = reference[:, :, None, :, None]  # [B, Q, 1, L, 1, 2 or 4]
        if reference.shape[-1] == 4:
            step = reference[..., 2:] * (0.5 / self.num_points)
        else:
            step = jnp.array([(1 / w, 1 / h) for h, w in sizes], offsets.dtype)
            step = step.reshape(1, 1, 1, self.num_levels, 1, 2)
        return reference[..., :2] + offsets * step, weights

    def lifted(
        self,
        feature: Float[jax.Array, "B N C"],
        scale: Float[jax.Array, "B N E"],
        reference: Float[jax.Array, "#B N E 2"],
        query_weights: Float[jax.Array, "#B N E"],
        value: Float[jax.Array, "B H W C"],
    ) -> Float[jax.Array, "B N C"]:
        """Mean attention over the E queries `scale * feature` of each bin.

        Args:
            feature: `[B, N, C]`.
            scale: `[B, N, E]`; 0 for a query that is zeroed.
            reference: `[B or 1, N, E, 2]` points in 0..1.
            query_weights: `[B or 1, N, E]` weights of the mean.
            value: `[B, H, W, C]`.

        Returns:
            `[B, N, C]`: the weighted sum of what `__call__` gives for the queries.
        """
        b, n = feature.shape[:2]
        heads, points = self.num_heads, self.num_points
        values = self.value_proj(value).reshape(*value.shape[:3], heads, -1)

        offsets, logits = self.sampling_offsets, self.attention_weights
        out = lifted_attention(
            values,
            offsets.product(feature).reshape(b, n, heads, points, 2),
            logits.product(feature).reshape(b, n, heads, points),
            scale,
            reference,
            query_weights,
            offsets.bias.reshape(heads, points, 2),
            logits.bias.reshape(heads, points),
            chunk_size=self.chunk_size,
        )  # [B, N, heads, D]
        # The projection is linear: once per bin, its bias as often as the mean counts.
        out = self.output_proj.product(out.reshape(b, n, -1))
        total = query_weights.sum(-1, keepdims=True)  # 0 for bins without a query
        bias = jnp.expand_dims(self.output_proj.bias, (0, 1))
        return out + (total * bias).astype(self.dtype)

    def _ring(self, key: jax.Array, shape: tuple, dtype: Any = jnp.float32) -> Any:
        """Heads look in different directions, point i at distance i + 1."""
        del key
        angle = 2 * math.pi * np.arange(self.num_heads) / self.num_heads
        way = np.stack([np.cos(angle), np.sin(angle)], -1)
        way = way / np.abs(way).max(-1, keepdims=True)
        distance = np.arange(1, self.num_points + 1)
        grid = way[:, None, None] * distance[:, None]  # [heads, 1, P, 2]
        grid = np.broadcast_to(
            grid, (self.num_heads, self.num_levels, self.num_points, 2)
        )
        return jnp.asarray(grid.reshape(shape), dtype)
