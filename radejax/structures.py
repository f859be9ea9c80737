"""The containers that travel between the rooms: all are JAX pytrees of fixed shape.

B frames, R range bins, A azimuth bins, D Doppler and E elevation bins, N padded
ground-truth boxes, K padded detections, C classes. Boxes live in the radar-centred
ego frame: x forward, y left, z up, metres; yaw counter-clockwise from x, radians.
"""

from __future__ import annotations

import jax
from flax import struct

CLASSES = ("Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle")
"""K-Radar's five detection classes in the order of every class axis."""


@struct.dataclass
class Batch:
    """One batch of frames as the pipeline delivers it and the losses consume it.

    Attributes:
        projection: `[B, R, A, D+E]` normalised projections, Doppler channels first.
        boxes: `[B, N, 8]` x, y, z, l, w, h, sin yaw, cos yaw; full extents.
        classes: `[B, N]` int32 class indices; any value where not `is_valid`.
        is_valid: `[B, N]` bool, True where a box is an object and not padding.
        frame: `[B]` int32 index of the frame in its data set.
        image: `[B, H, W, 3]` uint8 left front camera image, or None.
        camera: Pytree of `[B, ...]` arrays that describe the camera, or None.
    """

    projection: jax.Array
    boxes: jax.Array
    classes: jax.Array
    is_valid: jax.Array
    frame: jax.Array
    image: jax.Array | None = None
    camera: object | None = None


@struct.dataclass
class DetectionMaps:
    """What a detector predicts for every range-azimuth bin.

    Attributes:
        heatmap_logits: `[B, R, A, C]` center-point logits, before the sigmoid.
        box_params: `[B, R, A, 8]` raw dx, dy, dz, l, w, h, sin yaw, cos yaw.
    """

    heatmap_logits: jax.Array
    box_params: jax.Array


@struct.dataclass
class Detections:
    """Boxes of a batch, by descending score, padded to a fixed number K.

    Attributes:
        boxes: `[B, K, 7]` x, y, z, l, w, h, yaw.
        scores: `[B, K]` in [0, 1]; 0 where not `is_valid`.
        classes: `[B, K]` int32 class indices; -1 where not `is_valid`.
        is_valid: `[B, K]` bool, True where a row is a detection.
        num_cut: `[B]` int32 peaks above the score threshold that did not fit in K.
    """

    boxes: jax.Array
    scores: jax.Array
    classes: jax.Array
    is_valid: jax.Array
    num_cut: jax.Array
