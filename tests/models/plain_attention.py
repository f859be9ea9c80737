"""Deformable attention to several maps in plain form: the oracle of the module."""

import jax
import jax.numpy as jnp


@jax.numpy_rank_promotion("allow")
def plain_samples(value, sizes, locations, weights):
    """Weighted sums of bilinear samples: every pixel, weighted by its hat function.

    Shapes: value `[B, pixels, heads, D]`, locations `[B, Q, heads, L, P, 2]`, weights
    `[B, Q, heads, L, P]`; returns `[B, Q, heads * D]`.
    """
    out, start = 0.0, 0
    for level, (height, width) in enumerate(sizes):
        grid = value[:, start : start + height * width]
        grid = grid.reshape(len(value), height, width, *value.shape[2:])
        start += height * width
        x = locations[..., level, :, 0, None] * width - 0.5 - jnp.arange(width)
        y = locations[..., level, :, 1, None] * height - 0.5 - jnp.arange(height)
        x, y = (jnp.maximum(1 - jnp.abs(v), 0) for v in (x, y))
        share = weights[..., level, :, None] * y
        sums = "bqkpy,bqkpx,byxkd->bqkd"
        out += jnp.einsum(sums, share, x, grid, precision="highest")
    return out.reshape(*out.shape[:2], -1)


@jax.numpy_rank_promotion("allow")
def plain_attention(params, query, reference, value, sizes, counts, is_valid=None):
    """Deformable DETR's attention; returns its output, locations and weights."""
    heads, points = counts
    shape = (*query.shape[:2], heads, len(sizes), points)

    def dense(x, name):
        kernel, bias = params[name]["kernel"], params[name]["bias"]
        return jnp.matmul(x, kernel, precision="highest") + bias

    values = dense(value, "value_proj")
    if is_valid is not None:
        values = jnp.where(is_valid[..., None], values, 0.0)
    values = values.reshape(*value.shape[:2], heads, -1)
    offsets = dense(query, "sampling_offsets").reshape(*shape, 2)
    logits = dense(query, "attention_weights").reshape(*shape[:3], -1)
    weights = jax.nn.softmax(logits, -1).reshape(shape)
    reference = reference[:, :, None, :, None]
    if reference.shape[-1] == 4:
        step = reference[..., 2:] * (0.5 / points)
    else:
        step = 1 / jnp.array([(w, h) for h, w in sizes], offsets.dtype)[:, None]
    locations = reference[..., :2] + offsets * step
    out = plain_samples(values, sizes, locations, weights)
    return dense(out, "output_proj"), locations, weights
