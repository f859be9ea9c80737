"""Attention that samples a few learned places of a map around a reference point.

DinoRADE's queries of one radar bin are multiples of its feature, and their results are
averaged. Therefore linear layers run once per bin, the average is taken while sampling,
and the output projection after it, which is ten times less work than attention for
every query. With one query per bin, scale 1 and weight 1 this is Deformable DETR's
attention to one map.

Bins are sampled in chunks, and the backward pass samples again, so that memory depends
on the chunk and not on the number of queries. Locations are (x, y) with 0..1 from edge
to edge of the map; the center of the top-left pixel is at half a pixel, and samples
outside the map read zero.

References:
    Zhu et al., Deformable DETR, arXiv:2010.04159.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

_CHUNK_SIZES = {"cpu": 448, "default": 8192}
"""Bins at a time: a CPU wants the sampled rows in cache, an accelerator few large steps."""


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
        num_points: Samples per head and query.
        chunk_size: Bins at a time; 0 chooses by platform.
        dtype: Dtype of values and output; locations and weights are float32.
    """

    features: int
    num_heads: int = 4
    num_points: int = 4
    chunk_size: int = 0
    dtype: Any = jnp.float32

    def setup(self) -> None:
        features, init = self.features, nn.initializers
        samples = self.num_heads * self.num_points
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
            `[B, N, C]`: the weighted sum of the attention of the queries.
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
        grid = way[:, None] * distance[:, None]  # [heads, P, 2]
        return jnp.asarray(grid.reshape(shape), dtype)


# Sampling of all queries of a bin ---------------------------------------------------


def lifted_attention(
    value: Float[jax.Array, "B H W heads D"],
    offsets: Float[jax.Array, "B N heads P 2"],
    logits: Float[jax.Array, "B N heads P"],
    scale: Float[jax.Array, "B N E"],
    reference: Float[jax.Array, "#B N E 2"],
    query_weights: Float[jax.Array, "#B N E"],
    offset_bias: Float[jax.Array, "heads P 2"],
    logit_bias: Float[jax.Array, "heads P"],
    *,
    chunk_size: int,
) -> Float[jax.Array, "B N heads D"]:
    """Weighted mean over a bin's E queries of their attention, per head.

    Query e of bin n is `scale[n, e]` times the bin's feature, so its offsets are
    `scale * offsets + offset_bias` and its attention logits likewise, where `offsets`
    and `logits` are linear images of the feature without bias.

    Args:
        value: `[B, H, W, heads, D]`.
        offsets: `[B, N, heads, P, 2]` in pixels (x, y).
        logits: `[B, N, heads, P]`.
        scale: `[B, N, E]`.
        reference: `[B or 1, N, E, 2]` reference points, (x, y) in 0..1.
        query_weights: `[B or 1, N, E]` weights of the mean.
        offset_bias: `[heads, P, 2]`.
        logit_bias: `[heads, P]`.
        chunk_size: Bins at a time; 0 chooses by the platform that it is compiled for.

    Returns:
        `[B, N, heads, D]`.

    Raises:
        AssertionError: Arrays do not fit together.
    """
    b, bins, heads, points = logits.shape
    chex.assert_shape(value, (b, None, None, heads, None))
    chex.assert_shape(offsets, (*logits.shape, 2))
    chex.assert_shape(scale, (b, bins, None))
    chex.assert_shape(reference, (None, *scale.shape[1:], 2))
    chex.assert_shape(query_weights, (None, *scale.shape[1:]))
    chex.assert_shape(offset_bias, (heads, points, 2))
    chex.assert_shape(logit_bias, (heads, points))
    value = jnp.moveaxis(value, 3, 1)  # [B, heads, H, W, D]
    by_head = jnp.moveaxis(offsets, 2, 1), jnp.moveaxis(logits, 2, 1)

    def sample(arrays: tuple[jax.Array, ...]) -> jax.Array:
        value, offsets, logits, scale, *own = arrays
        # Geometry is per sample, or one for the whole batch.
        points, weights = own or (reference[0], query_weights[0])

        def head(arrays: tuple[jax.Array, ...]) -> jax.Array:
            value, offsets, logits, offset_bias, logit_bias = arrays
            return _lifted_head(
                chunk_size,
                value,
                offsets,
                logits,
                scale,
                points,
                weights,
                offset_bias,
                logit_bias,
            )

        return jax.lax.map(head, (value, offsets, logits, offset_bias, logit_bias))

    arrays: tuple[jax.Array, ...] = (value, *by_head, scale)
    if reference.shape[0] != 1 or query_weights.shape[0] != 1:
        arrays += tuple(
            jnp.broadcast_to(x, (b, *x.shape[1:])) for x in (reference, query_weights)
        )
    if b == 1:  # a loop of one step is still a loop to the compiler
        return jnp.moveaxis(sample(tuple(x[0] for x in arrays)), 0, 1)[None]
    return jnp.moveaxis(jax.lax.map(sample, arrays), 1, 2)


# One sample, one head ----------------------------------------------------------------
#
# The backward pass is written out so that the gradient of the map is added up in
# place; transposing the loop would allocate and add a whole map per chunk.


# The chunk is chosen in there too, where nothing is differentiated: a program lowered for
# another platform than the tracing machine's gets that platform's.


def _by_chunk(function: Callable[..., Any], chunk_size: int, *arrays: Any) -> Any:
    """`function(chunk_size, *arrays)`; a chunk size of 0 is the platform's."""
    if chunk_size:
        return function(chunk_size, *arrays)
    by_platform = {
        platform: functools.partial(function, size)
        for platform, size in _CHUNK_SIZES.items()
    }
    return jax.lax.platform_dependent(*arrays, **by_platform)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _lifted_head(chunk_size: int, value: jax.Array, *arrays: jax.Array) -> jax.Array:
    """`[N, D]` of one head: value `[H, W, D]`, the rest as in `lifted_attention`."""
    return _by_chunk(_head_forward, chunk_size, value, *arrays)


def _head_forward(chunk_size: int, value: jax.Array, *arrays: jax.Array) -> jax.Array:
    *per_bin, offset_bias, logit_bias = arrays
    pixels = value.reshape(-1, value.shape[-1])

    def chunk(parts: Sequence[jax.Array]) -> jax.Array:
        index, share = _lifted_samples(value.shape[:2], parts, offset_bias, logit_bias)
        return _weighted_rows(pixels, index, share)

    out = jax.lax.map(chunk, _to_chunks(per_bin, chunk_size))
    return out.reshape(-1, out.shape[-1])[: per_bin[0].shape[0]]


def _lifted_head_forward(chunk_size: int, *arrays: jax.Array) -> tuple[jax.Array, Any]:
    return _lifted_head(chunk_size, *arrays), arrays


def _lifted_head_backward(chunk_size: int, saved: Any, grad: jax.Array) -> tuple:
    return _by_chunk(_head_backward, chunk_size, grad, *saved)


def _head_backward(chunk_size: int, grad: jax.Array, *saved: jax.Array) -> tuple:
    value, *per_bin, offset_bias, logit_bias = saved
    size, bins = value.shape[:2], per_bin[0].shape[0]
    pixels = value.reshape(-1, value.shape[-1])

    def chunk(sums: tuple, arrays: tuple) -> tuple[tuple, list[jax.Array]]:
        grad_pixels, grad_offset_bias, grad_logit_bias = sums
        parts, grad = arrays  # grad [n, D]

        def samples(*arrays: Any) -> tuple[jax.Array, jax.Array]:
            index, share = _lifted_samples(size, *arrays)
            return share, index

        share, pull, index = jax.vjp(
            samples, parts, offset_bias, logit_bias, has_aux=True
        )
        n = index.shape[0]
        rows = _rows(pixels, index).reshape(n, -1, pixels.shape[-1])  # [n, E P 4, D]
        grad_share = jnp.einsum(
            "nd,nkd->nk", grad, rows, preferred_element_type=wide_dtype(pixels.dtype)
        )
        wide = grad.astype(wide_dtype(grad.dtype))[:, None]
        grad_rows = share.reshape(n, -1, 1) * wide  # [n, E P 4, D]
        grad_pixels = grad_pixels.at[index.reshape(-1)].add(
            grad_rows.reshape(-1, pixels.shape[-1]), mode="promise_in_bounds"
        )
        grad_parts, *grad_biases = pull(grad_share.reshape(share.shape))
        sums = (
            grad_pixels,
            grad_offset_bias + grad_biases[0],
            grad_logit_bias + grad_biases[1],
        )
        return sums, grad_parts

    zeros = (
        jnp.zeros(pixels.shape, wide_dtype(pixels.dtype)),
        jnp.zeros_like(offset_bias),
        jnp.zeros_like(logit_bias),
    )
    chunks = (_to_chunks(per_bin, chunk_size), _to_chunks([grad], chunk_size)[0])
    (grad_pixels, *grad_biases), grad_parts = jax.lax.scan(chunk, zeros, chunks)
    own_grads = [x.reshape(-1, *x.shape[2:])[:bins] for x in grad_parts]
    grad_value = grad_pixels.reshape(value.shape).astype(value.dtype)
    return (grad_value, *own_grads, *grad_biases)


_lifted_head.defvjp(_lifted_head_forward, _lifted_head_backward)


def _lifted_samples(
    size: tuple[int, ...],
    parts: Sequence[jax.Array],
    offset_bias: Float[jax.Array, "P 2"],
    logit_bias: Float[jax.Array, " P"],
) -> tuple[Int[jax.Array, "n E P 4"], Float[jax.Array, "n E P 4"]]:
    """Pixel indices and shares of a chunk of n bins."""
    offsets, logits, scale, reference, query_weights = parts
    height, width = size
    shift = scale[:, :, None, None] * offsets[:, None] + offset_bias[None, None]
    x = reference[..., None, 0] * width - 0.5 + shift[..., 0]  # [n, E, P]
    y = reference[..., None, 1] * height - 0.5 + shift[..., 1]
    weights = jax.nn.softmax(
        scale[..., None] * logits[:, None] + logit_bias[None, None], -1
    )
    index, share = _corners(x, y, height, width)
    return index, share * (weights * query_weights[..., None])[..., None]


# Sampling ----------------------------------------------------------------------------


def _corners(
    x: Float[jax.Array, "*places"],
    y: Float[jax.Array, "*places"],
    height: int,
    width: int,
) -> tuple[Int[jax.Array, "*places 4"], Float[jax.Array, "*places 4"]]:
    """Row-major indices and bilinear shares `[..., 4]` of the pixels around a place.

    Args:
        x: `[...]` in pixels, 0 at the center of the first.
        y: `[...]` likewise.
        height: Of the map.
        width: Of the map.
    """
    x_low, y_low = jnp.floor(x), jnp.floor(y)
    x_part, y_part = x - x_low, y - y_low
    index, share = [], []
    for step_y in (0, 1):
        for step_x in (0, 1):
            column, row = x_low + step_x, y_low + step_y
            is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            part = (x_part if step_x else 1 - x_part) * (
                y_part if step_y else 1 - y_part
            )
            share.append(jnp.where(is_inside, part, 0.0))
            # Outside the share is zero and any index will do. NaN is outside, too:
            # no index may ever lie beyond the map, see `_rows`.
            place = jnp.where(is_inside, row * width + column, 0.0)
            index.append(place.astype(jnp.int32))
    return jnp.stack(index, -1), jnp.stack(share, -1)


def wide_dtype(dtype: Any) -> Any:
    """Dtype for sums and locations: float32 for half precision, else unchanged."""
    return jnp.promote_types(dtype, jnp.float32)


def _rows(
    pixels: Float[jax.Array, "pixels D"], index: Int[jax.Array, "..."]
) -> Float[jax.Array, "rows D"]:
    # Indices are in the map by construction; not checking them again is faster.
    return pixels.at[index.reshape(-1)].get(mode="promise_in_bounds")


def _weighted_rows(
    pixels: Float[jax.Array, "pixels D"],
    index: Int[jax.Array, "n ..."],
    share: Float[jax.Array, "n ..."],
) -> Float[jax.Array, "n D"]:
    """Sums of rows by indices and shares."""
    n = index.shape[0]
    rows = _rows(pixels, index).reshape(n, -1, pixels.shape[-1])
    return jnp.einsum(
        "nk,nkd->nd",
        share.reshape(n, -1).astype(pixels.dtype),
        rows,
        preferred_element_type=wide_dtype(pixels.dtype),
    ).astype(pixels.dtype)


def _to_chunks(arrays: Sequence[jax.Array], size: int) -> list[jax.Array]:
    """`[N, ...]` -> `[chunks, size, ...]`, padded with zeros; one chunk if N is less."""
    size = min(size, len(arrays[0]))
    fill = -len(arrays[0]) % size
    padded = (jnp.pad(x, [(0, fill)] + [(0, 0)] * (x.ndim - 1)) for x in arrays)
    return [x.reshape(-1, size, *x.shape[1:]) for x in padded]
