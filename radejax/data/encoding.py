"""How a projection is stored: float16 or float32 as it is, or 8 bits over [0, 1]."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from radejax.core.structures import Array, Batch

ENCODINGS = ("float16", "uint8", "float32")


def encode(
    projection: Float[np.ndarray, "*axes"], encoding: str
) -> Real[np.ndarray, "*axes"]:
    """Convert a float projection to the type of the records.

    uint8 stores round(255 p) of p clipped to [0, 1]. p = 0 is a power of 0.76, far below
    the noise of K-Radar, and p = 1 one of 1.6e18, far above its echoes.
    """
    if encoding == "uint8":
        return np.rint(np.clip(projection, 0.0, 1.0) * 255.0).astype(np.uint8)
    return projection.astype(encoding)


def decode(stored: Real[np.ndarray, "*axes"]) -> Float[np.ndarray, "*axes"]:
    """Inverse of `encode` on the host: float32."""
    if stored.dtype == np.uint8:
        return stored.astype(np.float32) / np.float32(255.0)
    return stored.astype(np.float32)


def to_float(projection: Real[Array, "*axes"]) -> Float[jax.Array, "*axes"]:
    """`decode` on the device: stored values of a batch to float32 network input.

    Batches travel in the type of the records (a quarter to a half of the bytes); the
    jitted train step starts with this cast.

    Args:
        projection: uint8 (p = q / 255), float16, bfloat16 or float32.
    """
    values = jnp.asarray(projection).astype(jnp.float32)
    return values / 255.0 if projection.dtype == jnp.uint8 else values


def model_inputs(batch: Batch) -> tuple[Any, ...]:
    """Positional inputs of the model: the projection, and the camera's if there is one."""
    projection = to_float(batch.projection)
    if batch.image is None:
        return (projection,)
    return projection, batch.image, batch.camera
