"""The pure function from radar tensors to detections: what every detector compiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
from jaxtyping import Real

from radejax.core.structures import Array, Detections
from radejax.data.encoding import to_float
from radejax.data.projection import project_jax
from radejax.detection.decode import decode
from radejax.geometry.radar_grid import RadarGrid


def detect(
    model: nn.Module,
    grid: RadarGrid,
    options: Mapping[str, Any],
    variables: Any,
    frames: Real[Array, "B R A DE"] | Real[Array, "B D R E A"],
    image: Real[Array, "B _ _ _"] | None = None,
    camera: Any = None,
    *,
    is_tesseract: bool = False,
) -> Detections:
    """From a batch of radar tensors to detections; pure, to be jitted.

    Args:
        model: Radar or radar-camera detector.
        grid: Of its maps, see `models.map_grid`.
        options: Keyword arguments of `radejax.detection.decode.decode`.
        variables: Of the model.
        frames: Projections as they are stored, or tesseracts.
        image: Of a radar-camera model, or None for the radar alone.
        camera: Likewise.
        is_tesseract: `frames` are tesseracts, linear power.
    """
    if is_tesseract:
        frames = project_jax(frames)
    inputs = (to_float(frames),) if image is None else (to_float(frames), image, camera)
    maps: Any = model.apply(variables, *inputs, train=False)
    return decode(maps, grid, **options)
