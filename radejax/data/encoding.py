"""How a projection is stored: float16 or float32 as it is, or 8 bits over [0, 1]."""

from __future__ import annotations

from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from radejax.core.errors import UserError
from radejax.core.structures import Array, Batch
from radejax.data.projection import LOG_SCALE_DB

Encoding = Literal["float16", "uint8", "float32"]
ENCODINGS = get_args(Encoding)
MAX_ERROR_DB = {
    # Half a step of the type below 1, in normalised units, times the scale.
    "float16": 2.0**-12 * LOG_SCALE_DB,
    "uint8": 0.5 / 255 * LOG_SCALE_DB,
    "float32": 2.0**-25 * LOG_SCALE_DB,
}
"""Largest rounding error of values in [0, 1], in decibels of power."""


def check_encoding(name: str) -> str:
    """The name; `UserError` if there is no such encoding."""
    if str(name) not in ENCODINGS:
        raise UserError(
            f"record dtype {name!r}, expected one of {', '.join(ENCODINGS)}"
        )
    return str(name)


def encode(
    projection: Float[np.ndarray, "*axes"], encoding: str
) -> Real[np.ndarray, "*axes"]:
    """A float projection in the type of the records.

    uint8 stores round(255 p) of p clipped to [0, 1]: 0 dB is where power is 0.76, far
    under the noise of K-Radar. `num_clipped` counts what that loses.
    """
    if encoding == "uint8":
        return np.rint(np.clip(projection, 0.0, 1.0) * 255.0).astype(np.uint8)
    return projection.astype(encoding)


def num_clipped(projection: Float[np.ndarray, "..."], encoding: str) -> int:
    """Number of values that an encoding cannot represent and clips."""
    if encoding != "uint8":
        return 0
    return int(((projection < 0.0) | (projection > 1.0)).sum())


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
