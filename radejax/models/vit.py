"""Vision transformer with rotary or learned position embedding, as in DINOv3 and DINOv2.

No maintained package has a DINOv3 for Linen that reads the published weight files: Equimo
uses Equinox and requires Python 3.12, and bonsai uses NNX and is pinned to an old jax.

References:
    Simeoni et al., DINOv3, arXiv:2508.10104; Oquab et al., DINOv2, arXiv:2304.07193;
    Darcet et al., registers, arXiv:2309.16588. Names and numerics are checked against
    Hugging Face transformers, Meta's code and timm.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float

from radejax.models.layers import Layer
from radejax.models.options import AttentionKind, ViTOptions

Tokens = Float[jax.Array, "B T C"]
PerHead = Float[jax.Array, "B T heads D"]
OfSample = Float[jax.Array, "T heads D"]
Rope = tuple[Float[jax.Array, "patches D"], Float[jax.Array, "patches D"]]
"""Cosines and sines of the rotary embedding, with D channels per head."""

_BLOCK = 256  # queries per block, so that the scores of a head stay in the cache
_INIT = nn.initializers.truncated_normal(0.02)


class ViT(Layer):
    """Vision transformer, images `[B, H, W, 3]` -> tokens `[B, 1 + registers + patches, C]`.

    The tokens are the class token, the registers and the patches in row-major order, after
    the final normalization. An image whose height or width is not a multiple of the patch
    size is first resized to the nearest multiples, with linear interpolation and
    antialiasing; see `ViTOptions.grid`.

    Attributes:
        options: Options of the transformer, whose `hidden_size` is C.
        dtype: Dtype of the computation; normalization statistics and the returned tokens
            are float32.
        remat: Recompute blocks in the backward pass instead of storing them.
    """

    options: ViTOptions
    remat: bool = False

    @nn.compact
    def __call__(
        self, image: Float[jax.Array, "B H W 3"]
    ) -> Float[jax.Array, "B T {self.options.hidden_size}"]:
        """Computes float32 tokens of normalized float images `[B, H, W, 3]`."""
        chex.assert_shape(image, (None, None, None, 3))
        options = self.options
        rows, columns = options.grid(*image.shape[1:3])
        size = (rows * options.patch_size, columns * options.patch_size)
        image = jax.image.resize(image, (image.shape[0], *size, 3), "linear")
        tokens = self._embed(image, rows, columns)
        head_dim = options.hidden_size // options.num_heads
        rope = None if options.position_grid else rotary_angles(rows, columns, head_dim)
        block = nn.remat(Block, prevent_cse=False) if self.remat else Block
        # One block is traced for all layers; its parameters have a leading layer axis.
        layers = nn.scan(
            block,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=nn.broadcast,
            length=options.num_layers,
        )
        tokens, _ = layers(options, self.dtype, name="layers")(tokens, rope)
        normalized: Tokens = _layer_norm(rope, jnp.float32, "norm")(tokens)
        return normalized

    def _embed(
        self, image: Float[jax.Array, "B H W 3"], rows: int, columns: int
    ) -> Float[jax.Array, "B T {self.options.hidden_size}"]:
        """Embeds patches by a linear layer and prepends the learned tokens."""
        options = self.options
        b = image.shape[0]
        size = options.patch_size
        # As patches do not overlap, the convolution is a product with flattened patches.
        patches = image.reshape(b, rows, size, columns, size, 3)
        patches = patches.transpose(0, 1, 3, 2, 4, 5).reshape(b, rows * columns, -1)
        patches = nn.Dense(
            options.hidden_size, kernel_init=_INIT, dtype=self.dtype, name="patch_embed"
        )(patches)
        shape = (1, options.num_prefix, options.hidden_size)
        prefix = self.param("prefix_tokens", _INIT, shape)
        if n := options.position_grid:
            # Positions of the class token and of the patches.
            shape = (1, 1 + n * n, options.hidden_size)
            position = self.param("position_embedding", _INIT, shape)
            prefix = prefix.at[:, :1].add(position[:, :1])
            # transformers resamples with antialiasing only in models with registers.
            smooth = options.num_registers > 0
            axes = [bicubic_weights(n, m, antialias=smooth) for m in (rows, columns)]
            grid = position[0, 1:].reshape(n, n, -1)
            grid = jnp.einsum("rn,cm,nmd->rcd", *axes, grid, precision="highest")
            patches += grid.reshape(1, rows * columns, -1).astype(self.dtype)
        prefix = jnp.broadcast_to(prefix.astype(self.dtype), (b, *prefix.shape[1:]))
        return jnp.concatenate([prefix, patches], 1)


class Block(nn.Module):
    """Transformer block with scaled residual branches; its attributes are those of `ViT`."""

    options: ViTOptions
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Tokens, rope: Rope | None) -> tuple[Tokens, None]:
        y = _layer_norm(rope, self.dtype, "norm_1")(x)
        x = x + self._scale("scale_1", x) * self._attend(y, rope)
        y = _layer_norm(rope, self.dtype, "norm_2")(x)
        x = x + self._scale("scale_2", x) * self._mlp(y)
        return x, None

    def _attend(self, x: Tokens, rope: Rope | None) -> Tokens:
        b, t, c = x.shape
        # DINOv3 has no bias of the key, and DINOv2's does not change the result: without
        # rotation it adds the same to all scores of a query.
        shape = b, t, self.options.num_heads, -1
        query, key, value = (
            self._dense(c, name, use_bias=name != "key")(x).reshape(shape)
            for name in ("query", "key", "value")
        )  # [B, T, heads, C / heads]
        if rope is not None:
            query = rotate(query, rope, self.options.num_prefix)
            key = rotate(key, rope, self.options.num_prefix)
        y = attend(query, key, value, self.options.attention).reshape(b, t, c)
        return self._dense(c, "out")(y)

    def _mlp(self, x: Tokens) -> Tokens:
        y = self._dense(self.options.mlp_dim, "up")(x)
        if self.options.gated_mlp:
            y = nn.silu(self._dense(self.options.mlp_dim, "gate")(x)) * y
        else:
            y = nn.gelu(y, approximate=False)
        return self._dense(x.shape[-1], "down")(y)

    def _dense(self, features: int, name: str, use_bias: bool = True) -> nn.Dense:
        return nn.Dense(features, use_bias, self.dtype, kernel_init=_INIT, name=name)

    def _scale(self, name: str, x: Tokens) -> Float[jax.Array, "1 1 C"]:
        init = nn.initializers.constant(self.options.layer_scale)
        scale = self.param(name, init, (x.shape[-1],)).astype(self.dtype)
        return scale[None, None]


def _layer_norm(rope: Rope | None, dtype: DTypeLike, name: str) -> nn.LayerNorm:
    epsilon = 1e-6 if rope is None else 1e-5  # DINOv2's and DINOv3's
    # The fast variance E[x^2] - E[x]^2 is imprecise if the mean is large.
    return nn.LayerNorm(epsilon, dtype=dtype, use_fast_variance=False, name=name)


# Position embeddings -----------------------------------------------------------------


def bicubic_weights(
    old: int, new: int, *, antialias: bool
) -> Float[np.ndarray, "{new} {old}"]:
    """Computes the weights of bicubic resampling along one axis, as in torch.

    The values are those of `torch.nn.functional.interpolate(..., mode="bicubic",
    align_corners=False)`.

    Args:
        old: Number of samples.
        new: Number of resampled values.
        antialias: Whether the kernel is stretched where the number decreases. Then, samples
            beyond the border have no weight; otherwise the border is repeated. The cubic
            kernel's parameter also differs, as in torch.
    """
    a, stretch = (-0.5, max(old / new, 1.0)) if antialias else (-0.75, 1.0)
    centers = (np.arange(new)[:, None] + 0.5) * old / new - 0.5
    samples = np.arange(-2, old + 2)
    d = np.abs(samples - centers) / stretch
    near = ((a + 2) * d - (a + 3)) * d * d + 1
    far = a * (((d - 5) * d + 8) * d - 4)
    weights = np.where(d < 1, near, np.where(d < 2, far, 0.0))
    if antialias:
        weights = weights[:, 2:-2] / weights[:, 2:-2].sum(1, keepdims=True)
    else:
        weights = weights @ np.eye(old)[samples.clip(0, old - 1)]
    rounded: np.ndarray = weights.astype(np.float32)
    return rounded


def rotary_angles(rows: int, columns: int, head_dim: int) -> Rope:
    """Computes the rotary position embedding of a grid of patches.

    The coordinates p of patch centers are in [-1, 1] along each axis. The first quarter of
    a head's channels encodes the row, the second quarter the column, and the second half
    repeats both. Channel i of a quarter has the angle `2 pi p / 100^(4 i / head_dim)`.

    Args:
        rows: Number of patches along the height.
        columns: Number of patches along the width.
        head_dim: Channels of a head, a multiple of 4.

    Returns:
        Cosines and sines of the angles, two float32 arrays `[rows * columns, head_dim]`.
    """
    frequency = 100.0 ** -(np.arange(head_dim // 4) * 4.0 / head_dim)

    def axis_angles(count: int) -> np.ndarray:
        position = 2.0 * (np.arange(count) + 0.5) / count - 1.0
        return 2.0 * np.pi * position[:, None] * frequency  # [count, head_dim / 4]

    def table(function: np.ufunc) -> jax.Array:
        # Only the tables per axis are constants of the compiled program, which expands
        # them to the full table.
        by_row = jnp.asarray(function(axis_angles(rows)), jnp.float32)
        by_column = jnp.asarray(function(axis_angles(columns)), jnp.float32)
        shape = (rows, columns, head_dim // 4)
        axes = by_row[:, None], by_column[None]
        half = jnp.concatenate([jnp.broadcast_to(a, shape) for a in axes], -1)
        return jnp.concatenate([half, half], -1).reshape(rows * columns, head_dim)

    return table(np.cos), table(np.sin)


def rotate(x: PerHead, rope: Rope, num_prefix: int) -> PerHead:
    """Applies the rotary embedding to the patch tokens and leaves the prefix unchanged."""
    cos, sin = (a[None, :, None].astype(jnp.float32) for a in rope)
    wide = x[:, num_prefix:].astype(jnp.float32)
    first, second = jnp.split(wide, 2, -1)
    turned = wide * cos + jnp.concatenate([-second, first], -1) * sin
    return jnp.concatenate([x[:, :num_prefix], turned.astype(x.dtype)], 1)


# Attention ---------------------------------------------------------------------------


def attend(
    query: PerHead, key: PerHead, value: PerHead, kind: AttentionKind = "auto"
) -> PerHead:
    """Computes softmax attention without a mask.

    Args:
        query: `[B, T, heads, D]` queries.
        key: `[B, T, heads, D]` keys.
        value: `[B, T, heads, D]` values.
        kind: Implementation; all of them are exact. "xla" is
            `jax.nn.dot_product_attention` with the whole score matrix in memory. "blocked"
            processes one head and a block of queries at a time, so that scores stay in the
            cache, and is six times faster than "xla" on a CPU. "cudnn" is flash attention
            for half precision on NVIDIA GPUs. "auto" selects "blocked" on CPUs, "cudnn"
            for half precision on NVIDIA GPUs, and "xla" otherwise.

    Returns:
        `[B, T, heads, D]` weighted sums of the values.
    """
    plain = jax.nn.dot_product_attention
    if kind == "auto":
        is_half = query.dtype in (jnp.bfloat16, jnp.float16)
        flash: dict[str, Callable[..., jax.Array]] = {}
        if is_half and jax.default_backend() == "gpu":  # tracing "cudnn" needs a GPU
            flash["cuda"] = functools.partial(plain, implementation="cudnn")
        # The choice is made at lowering, so that a traced program runs on each platform.
        out: PerHead = jax.lax.platform_dependent(
            query, key, value, cpu=_attend_blocked, default=plain, **flash
        )
        return out
    if kind == "blocked":
        return _attend_blocked(query, key, value)
    return plain(query, key, value, implementation=kind)


@jax.vmap  # a loop over samples would gather a batch that is split over devices
def _attend_blocked(query: OfSample, key: OfSample, value: OfSample) -> OfSample:
    t, heads, d = query.shape
    block = min(_BLOCK, t)
    queries = jnp.pad(query * d**-0.5, ((0, -t % block), (0, 0), (0, 0)))
    queries = queries.swapaxes(0, 1).reshape(heads, -1, block, d).swapaxes(2, 3)
    keys = key.swapaxes(0, 1)  # [heads, T, d]
    values = value.transpose(1, 2, 0)  # [heads, d, T]

    def one_head(arrays: tuple[jax.Array, ...]) -> jax.Array:
        blocks, keys, values = arrays  # [n, d, block], [T, d], [d, T]

        # With queries along the last axis, maximum and sum over keys are elementwise
        # operations on rows, which a CPU vectorizes.
        @jax.checkpoint  # the backward pass must not store the scores
        def one_block(x: jax.Array) -> jax.Array:
            scores = (keys @ x).astype(jnp.float32)  # [T, block]
            top = jax.lax.stop_gradient(scores.max(0, keepdims=True))
            weights = jnp.exp(scores - top)
            total = weights.sum(0, keepdims=True)
            return ((values @ weights.astype(x.dtype)) / total).astype(x.dtype)

        attended: jax.Array = jax.lax.map(one_block, blocks)
        return attended

    # [heads, n, d, block]
    out: jax.Array = jax.lax.map(one_head, (queries, keys, values))
    return out.swapaxes(2, 3).reshape(heads, -1, d)[:, :t].swapaxes(0, 1)
