"""Deformable attention, which samples a map at learned offsets from reference points.

In DinoRADE, the queries of a radar bin are multiples of the bin's feature, and the results
of the queries are averaged. The linear layers are therefore computed once per bin, and the
output projection after the average. With ten queries per bin, this is ten times less work
than attention for every query. With one query per bin, scale 1 and weight 1, the module
equals Deformable DETR's attention to one map.

Bins are sampled in chunks, and the backward pass samples again, so that the memory in use
depends on the chunk size and not on the number of queries. Locations are (x, y) in 0..1
from edge to edge of the map, so the center of the top-left pixel is half a pixel from
either edge. Samples outside the map are zero.

References:
    Zhu et al., Deformable DETR, arXiv:2010.04159.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float, Int

from radejax.models.layers import Initializer, Layer

T = TypeVar("T")
Arrays = tuple[jax.Array, ...]
HeadInputs = tuple[jax.Array, Arrays, Arrays]
"""The arrays of `_lifted_head`, or their gradients: map, values per bin, biases."""
Places = Float[jax.Array, "*places"]

ChunkSizes = tuple[tuple[str, int], ...]  # platforms and bins, a hashable dictionary

_CHUNK_SIZES = {"cpu": (448, 64), "default": (8192, 2048)}
"""Bins per chunk of all samples together, and the least bins of each sample.

On a CPU, the sampled rows should fit into the cache; an accelerator is faster with few
large chunks.
"""


class Linear(Layer):
    """Linear layer that returns its product `[..., C']` and its bias `[C']` separately.

    Attributes:
        features: Output channels C'.
        kernel_init: Initializer of the kernel.
        bias_init: Initializer of the bias.
        dtype: Dtype of the product.
        precision: Precision of the product, as in `jax.lax.dot`.
    """

    features: int
    kernel_init: Initializer = nn.initializers.xavier_uniform()
    bias_init: Initializer = nn.initializers.zeros
    precision: str | None = None

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "*batch _"]
    ) -> tuple[Float[jax.Array, "*batch C"], Float[jax.Array, " C"]]:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        bias = self.param("bias", self.bias_init, (self.features,))
        x = x.astype(self.dtype)
        y = jnp.matmul(x, kernel.astype(self.dtype), precision=self.precision)
        return y, bias


class Queries(NamedTuple):
    """The E queries of each of N bins. One sample may be shared by the batch.

    Attributes:
        scale: `[B, N, E]` factors; query e of bin n is `scale[n, e]` times its feature.
        reference: `[B or 1, N, E, 2]` reference points, (x, y) in 0..1.
        weights: `[B or 1, N, E]` weights of the queries in the sum.
    """

    scale: Float[jax.Array, "B N E"]
    reference: Float[jax.Array, "#B N E 2"]
    weights: Float[jax.Array, "#B N E"]


class DeformableAttention(Layer):
    """Multi-head deformable cross-attention, including its four linear layers.

    Attributes:
        features: Channels C of queries, values and output.
        num_heads: Attention heads; must divide C.
        num_points: Samples per head and query.
        chunk_size: Bins per chunk; 0 selects a default for the platform.
        dtype: Dtype of values and output; locations and weights are at least float32.
    """

    features: int
    num_heads: int = 4
    num_points: int = 4
    chunk_size: int = 0

    @nn.compact
    def __call__(
        self,
        feature: Float[jax.Array, "B N C"],
        scale: Float[jax.Array, "B N E"],
        reference: Float[jax.Array, "#B N E 2"],
        query_weights: Float[jax.Array, "#B N E"],
        value: Float[jax.Array, "B H W C"],
    ) -> Float[jax.Array, "B N C"]:
        """Computes the weighted sum of the attention of each bin's queries.

        Args:
            feature: `[B, N, C]` features of the bins.
            scale: `[B, N, E]` factors; query e of bin n is `scale[n, e] * feature[n]`.
            reference: `[B or 1, N, E, 2]` reference points, (x, y) in 0..1.
            query_weights: `[B or 1, N, E]` weights of the queries in the sum.
            value: `[B, H, W, C]` map to sample.

        Returns:
            `[B, N, C]` attention of the bins.
        """
        heads = self.num_heads
        points = self.num_points
        # Sampling locations need full precision, whatever the dtype of the features.
        place = functools.partial(
            Linear,
            precision="highest",
            kernel_init=nn.initializers.zeros,
            dtype=wide_dtype(self.dtype),
        )
        offset_layer = place(
            2 * heads * points, bias_init=self._ring, name="sampling_offsets"
        )
        offsets, offset_bias = offset_layer(feature)
        logits, logit_bias = place(heads * points, name="attention_weights")(feature)
        linear = functools.partial(Linear, self.features, dtype=self.dtype)
        value, value_bias = linear(name="value_proj")(value)
        value += jnp.expand_dims(value_bias.astype(self.dtype), (0, 1, 2))

        batch = feature.shape[:2]
        out = lifted_attention(
            value.reshape(*value.shape[:3], heads, -1),
            offsets.reshape(*batch, heads, points, 2),
            logits.reshape(*batch, heads, points),
            Queries(scale, reference, query_weights),
            offset_bias.reshape(heads, points, 2),
            logit_bias.reshape(heads, points),
            chunk_size=self.chunk_size,
        )  # [B, N, heads, D]
        # As the projection is linear, it is applied to the sum over the queries, with the
        # bias multiplied by the sum of their weights.
        out, bias = linear(name="output_proj")(out.reshape(*batch, -1))
        total = query_weights.sum(-1, keepdims=True)  # 0 for bins without a query
        return out + (total * jnp.expand_dims(bias, (0, 1))).astype(self.dtype)

    def _ring(self, _: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Initializes the offsets: one direction per head, point i at i + 1 pixels."""
        angle = 2 * math.pi * np.arange(self.num_heads) / self.num_heads
        way = np.stack([np.cos(angle), np.sin(angle)], -1)
        way = way / np.abs(way).max(-1, keepdims=True)
        distance = np.arange(1, self.num_points + 1)
        grid = way[:, None] * distance[:, None]  # [heads, P, 2]
        return jnp.asarray(grid.reshape(shape), jnp.float32)


# Sampling of all queries of a bin ---------------------------------------------------


def lifted_attention(
    value: Float[jax.Array, "B H W heads D"],
    offsets: Float[jax.Array, "B N heads P 2"],
    logits: Float[jax.Array, "B N heads P"],
    queries: Queries,
    offset_bias: Float[jax.Array, "heads P 2"],
    logit_bias: Float[jax.Array, "heads P"],
    *,
    chunk_size: int,
) -> Float[jax.Array, "B N heads D"]:
    """Computes the weighted sum of the attention of each bin's E queries, per head.

    Query e of bin n is `scale[n, e]` times the bin's feature. Its offsets are therefore
    `scale * offsets + offset_bias` and its attention logits `scale * logits + logit_bias`,
    where `offsets` and `logits` are linear functions of the feature, without bias.

    Args:
        value: `[B, H, W, heads, D]` map to sample.
        offsets: `[B, N, heads, P, 2]` sampling offsets in pixels (x, y), without bias.
        logits: `[B, N, heads, P]` attention logits, without bias.
        queries: The queries of the bins.
        offset_bias: `[heads, P, 2]` bias of the offsets.
        logit_bias: `[heads, P]` bias of the logits.
        chunk_size: Bins per chunk; 0 selects a default for the platform that the function
            is compiled for.

    Returns:
        `[B, N, heads, D]` attention of the bins.
    """
    b = value.shape[0]  # symbolic in exports
    chunk_sizes = _chunk_sizes(chunk_size, b)
    value = jnp.moveaxis(value, 3, 1)  # [B, heads, H, W, D]
    offsets = jnp.moveaxis(offsets, 2, 1)
    logits = jnp.moveaxis(logits, 2, 1)
    # The geometry is either per sample or shared by the whole batch.
    geometry = (jnp.broadcast_to(x, (b, *x.shape[1:])) for x in queries)

    def sample(
        value: jax.Array, offsets: jax.Array, logits: jax.Array, *shared: jax.Array
    ) -> jax.Array:
        def head(arrays: tuple[jax.Array, ...]) -> jax.Array:
            value, offsets, logits, *biases = arrays
            per_bin = (offsets, logits, *shared)
            return _lifted_head(chunk_sizes, (value, per_bin, tuple(biases)))

        by_head = (value, offsets, logits, offset_bias, logit_bias)
        attention: jax.Array = jax.lax.map(head, by_head)
        return attention

    arrays = (value, offsets, logits, *geometry)
    if b == 1:  # on a CPU, the gradient of a batch of one is slower
        return jnp.moveaxis(sample(*(x[0] for x in arrays)), 0, 1)[None]
    # This is not a loop over the samples: if the batch is split over devices, a loop would
    # gather all of it on each of them.
    return jnp.moveaxis(jax.vmap(sample)(*arrays), 1, 2)


def _chunk_sizes(given: int, batch_size: object) -> ChunkSizes:
    """Returns the bins per chunk of each sample, by platform."""
    if given:
        return (("default", given),)
    count = batch_size if isinstance(batch_size, int) else 1  # 1 if it is symbolic
    return tuple(
        (platform, max(least, bins // count))
        for platform, (bins, least) in _CHUNK_SIZES.items()
    )


# One sample, one head ----------------------------------------------------------------
#
# The backward pass is written by hand, so that the gradient of the map is accumulated in
# place. The automatic transpose of the loop would allocate and add a whole map per chunk.


def _by_chunk(
    function: Callable[..., T], chunk_sizes: ChunkSizes, *arrays: HeadInputs | jax.Array
) -> T:
    """Calls `function(chunk_size, *arrays)` with the chunk size of the platform.

    The platform is that for which the program is lowered, which may differ from the tracing
    machine's. The forward and the backward pass call this separately, because the choice of
    the platform is not differentiated.
    """
    if len(chunk_sizes) == 1:  # jax2onnx converts no choice, not even of one
        return function(chunk_sizes[0][1], *arrays)
    by_platform = {
        platform: functools.partial(function, size) for platform, size in chunk_sizes
    }
    result: T = jax.lax.platform_dependent(*arrays, **by_platform)
    return result


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _lifted_head(chunk_sizes: ChunkSizes, inputs: HeadInputs) -> jax.Array:
    """Computes the attention `[N, D]` of one head of one sample.

    The map is `[H, W, D]`. The values per bin are offsets, logits, scale, reference and
    query weights, and the biases those of offsets and logits, all as in
    `lifted_attention`.
    """
    return _by_chunk(_head_forward, chunk_sizes, inputs)


def _head_forward(chunk_size: int, inputs: HeadInputs) -> jax.Array:
    value, per_bin, biases = inputs
    pixels = value.reshape(-1, value.shape[-1])

    def chunk(parts: Arrays) -> jax.Array:
        share, index = _lifted_samples(value.shape[:2], parts, biases)
        return jnp.einsum(
            "nk,nkd->nd",
            share.reshape(len(share), -1).astype(pixels.dtype),
            _rows(pixels, index),
            preferred_element_type=wide_dtype(pixels.dtype),
        ).astype(pixels.dtype)

    out: jax.Array = jax.lax.map(chunk, _to_chunks(per_bin, chunk_size))
    return out.reshape(-1, out.shape[-1])[: len(per_bin[0])]


def _lifted_head_forward(
    chunk_sizes: ChunkSizes, inputs: HeadInputs
) -> tuple[jax.Array, HeadInputs]:
    return _lifted_head(chunk_sizes, inputs), inputs


def _lifted_head_backward(
    chunk_sizes: ChunkSizes, inputs: HeadInputs, grad: jax.Array
) -> tuple[HeadInputs]:
    return (_by_chunk(_head_backward, chunk_sizes, inputs, grad),)


def _head_backward(chunk_size: int, inputs: HeadInputs, grad: jax.Array) -> HeadInputs:
    value, per_bin, biases = inputs
    pixels = value.reshape(-1, value.shape[-1])
    samples = functools.partial(_lifted_samples, value.shape[:2])

    def chunk(
        sums: tuple[jax.Array, Arrays], arrays: tuple[Arrays, jax.Array]
    ) -> tuple[tuple[jax.Array, Arrays], Arrays]:
        grad_pixels, grad_biases = sums
        parts, grad = arrays  # grad [n, D]
        share, pull, index = jax.vjp(samples, parts, biases, has_aux=True)
        grad_share = jnp.einsum(
            "nd,nkd->nk",
            grad,
            _rows(pixels, index),
            preferred_element_type=wide_dtype(pixels.dtype),
        )
        wide = grad.astype(wide_dtype(grad.dtype))[:, None]
        grad_rows = share.reshape(len(share), -1, 1) * wide  # [n, E P 4, D]
        grad_pixels = grad_pixels.at[index.reshape(-1)].add(
            grad_rows.reshape(-1, pixels.shape[-1]), mode="promise_in_bounds"
        )
        grad_parts, own_biases = pull(grad_share.reshape(share.shape))
        grad_biases = jax.tree.map(jnp.add, grad_biases, own_biases)
        return (grad_pixels, grad_biases), grad_parts

    grad_pixels = jnp.zeros(pixels.shape, wide_dtype(pixels.dtype))
    zeros = grad_pixels, jax.tree.map(jnp.zeros_like, biases)
    chunks = _to_chunks((per_bin, grad), chunk_size)
    (grad_pixels, grad_biases), grad_parts = jax.lax.scan(chunk, zeros, chunks)
    own_grads = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:])[: len(grad)], grad_parts
    )
    grad_value = grad_pixels.reshape(value.shape).astype(value.dtype)
    return grad_value, own_grads, grad_biases


_lifted_head.defvjp(_lifted_head_forward, _lifted_head_backward)


def _lifted_samples(
    size: tuple[int, ...], per_bin: Arrays, biases: Arrays
) -> tuple[Float[jax.Array, "n E P 4"], Int[jax.Array, "n E P 4"]]:
    """Returns the weights and indices of the pixels that a chunk of n bins samples."""
    offsets, logits, scale, reference, query_weights = per_bin
    offset_bias, logit_bias = biases
    height, width = size
    shift = scale[:, :, None, None] * offsets[:, None] + offset_bias[None, None]
    x = reference[..., None, 0] * width - 0.5 + shift[..., 0]  # [n, E, P]
    y = reference[..., None, 1] * height - 0.5 + shift[..., 1]
    weights = jax.nn.softmax(
        scale[..., None] * logits[:, None] + logit_bias[None, None], -1
    )
    index, share = _corners(x, y, height, width)
    return share * (weights * query_weights[..., None])[..., None], index


# Sampling ----------------------------------------------------------------------------


def _corners(
    x: Places, y: Places, height: int, width: int
) -> tuple[Int[jax.Array, "*places 4"], Float[jax.Array, "*places 4"]]:
    """Returns indices and bilinear weights `[..., 4]` of the four pixels around a location.

    Args:
        x: `[...]` columns in pixels, 0 at the center of the first.
        y: `[...]` rows in pixels, 0 at the center of the first.
        height: Rows of the map.
        width: Columns of the map.

    Returns:
        Row-major indices, and weights that are 0 for pixels outside the map.
    """
    x_low, y_low = jnp.floor(x), jnp.floor(y)
    x_part, y_part = x - x_low, y - y_low
    index = []
    share = []
    for step_y in (0, 1):
        for step_x in (0, 1):
            column = x_low + step_x
            row = y_low + step_y
            is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            part = (x_part if step_x else 1 - x_part) * (
                y_part if step_y else 1 - y_part
            )
            share.append(jnp.where(is_inside, part, 0.0))
            # Outside the map, the weight is zero and the index is set to 0, because
            # `_rows` requires valid indices. NaN counts as outside.
            place = jnp.where(is_inside, row * width + column, 0.0)
            index.append(place.astype(jnp.int32))
    return jnp.stack(index, -1), jnp.stack(share, -1)


def wide_dtype(dtype: DTypeLike) -> np.dtype:
    """Returns the dtype for sums and locations: float32 for half precision, else `dtype`."""
    return jnp.promote_types(dtype, jnp.float32)


def _rows(
    pixels: Float[jax.Array, "pixels D"], index: Int[jax.Array, "n ..."]
) -> Float[jax.Array, "n _ D"]:
    """Returns the pixels at the given indices as `[n, E P 4, D]`."""
    # `_corners` returns only indices inside the map, and a check would cost time.
    rows = pixels.at[index.reshape(-1)].get(mode="promise_in_bounds")
    return rows.reshape(len(index), -1, pixels.shape[-1])


def _to_chunks(arrays: T, size: int) -> T:
    """Splits `[N, ...]` into `[chunks, size, ...]`, padded with zeros.

    If N is less than `size`, there is one chunk of N.
    """
    bins = len(jax.tree.leaves(arrays)[0])
    size = min(size, bins)

    def split(x: jax.Array) -> jax.Array:
        padded = jnp.pad(x, [(0, -bins % size)] + [(0, 0)] * (x.ndim - 1))
        return padded.reshape(-1, size, *x.shape[1:])

    chunks: T = jax.tree.map(split, arrays)
    return chunks
