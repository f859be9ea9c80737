"""The containers that the packages pass to each other: all are JAX pytrees of fixed shape.

B frames, R range bins, A azimuth bins, D Doppler and E elevation bins, N padded
ground-truth boxes, K padded detections, C classes. Boxes are in the radar (ego) frame: x
forward, y left, z up, meters, with the z of the LiDAR (docs/conventions.md); yaw counter-clockwise
from x, radians.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, Real, Shaped

from radejax.core.errors import DataError

Array = jax.Array | np.ndarray

CLASSES = ("Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle")
"""K-Radar's five detection classes in the order of every class axis."""

RARE_SHARE = 0.02
"""Classes below this share of the training objects of a weather are marked, as in Table 2
of DinoRADE."""

BOX_FIELDS = ("x", "y", "z", "l", "w", "h", "yaw")
"""Names of the numbers of a box, meters and radians."""

NARROW_ROI = (0.0, 72.0, -6.4, 6.4, -2.0, 6.0)
"""K-Radar's benchmark region: x, y, z from and to, meters, ego frame."""

MIN_SIZE_M = 0.01
"""What sizes of decoded boxes are clipped to: none is negative."""

WIDE_ROI = (0.0, 72.0, -16.0, 16.0, -2.0, 7.6)
"""K-Radar's wide region: x, y, z from and to, meters, ego frame."""

ROIS = {"narrow": NARROW_ROI, "wide": WIDE_ROI}
"""Regions by name; bounds are inclusive, and of box centers."""


class Batch(struct.PyTreeNode):
    """One batch of frames as the pipeline delivers it and the losses consume it.

    Attributes:
        projection: Normalized projections as they are stored, D Doppler channels first,
            then E of elevation.
        boxes: x, y, z, l, w, h, sin yaw, cos yaw; full extents; float32.
        classes: int32 class indices; any value where not `is_valid`.
        is_valid: True where a box is an object and not padding.
        frame: int32 index of the frame in its dataset; -1 where the batch is filled up.
        image: `[B, H, W, 3]` uint8 left front camera images, or what the image backbone
            made of them; or None.
        camera: `Camera` or `ReferencePoints` of higher layers, `[B, ...]`; or None.
    """

    # Any leaf passes: trees of arrays are rebuilt from shapes, specs or None as well.
    projection: Real[Array, "B R A DE"]
    boxes: Float[Array, "B N 8"]
    classes: Int[Array, "B N"]
    is_valid: Bool[Array, "B N"]
    frame: Int[Array, " B"]
    image: Real[Array, "B _ _ _"] | None = None
    camera: Any = None

    def model_inputs(self) -> tuple[Any, ...]:
        """Positional inputs of a model: the projection; with images, the camera's too."""
        projection = to_float(self.projection)
        if self.image is None:
            return (projection,)
        return projection, self.image, self.camera


def to_float(projection: Real[Array, "*axes"]) -> Float[jax.Array, "*axes"]:
    """Stored values of projections to float32 network input, on the device.

    Batches travel in the type of the records (a quarter to a half of the bytes); the
    jitted train step starts with this cast.

    Args:
        projection: uint8 (p = q / 255), float16, bfloat16 or float32.
    """
    values = jnp.asarray(projection).astype(jnp.float32)
    return values / 255.0 if projection.dtype == jnp.uint8 else values


class DetectionMaps(struct.PyTreeNode):
    """What a detector predicts for every range-azimuth bin.

    Attributes:
        heatmap_logits: Center-point logits, before the sigmoid.
        box_params: Raw dx, dy, z, l, w, h, sin yaw, cos yaw; dx and dy from the center of
            the bin, in meters.
    """

    heatmap_logits: Float[jax.Array, "B R A C"]
    box_params: Float[jax.Array, "B R A 8"]


class Detections(struct.PyTreeNode):
    """Boxes of a batch, by descending score, padded to a fixed number K.

    Attributes:
        boxes: x, y, z, l, w, h, yaw.
        scores: In [0, 1]; 0 where not `is_valid`.
        classes: int32 class indices; -1 where not `is_valid`.
        is_valid: True where a row is a detection.
        num_truncated: int32 peaks above the score threshold that did not fit in K.
        class_names: Names of the class indices, the detector's; static under `jit`.
    """

    boxes: Float[jax.Array, "B K 7"]
    scores: Float[jax.Array, "B K"]
    classes: Int[jax.Array, "B K"]
    is_valid: Bool[jax.Array, "B K"]
    num_truncated: Int[jax.Array, " B"]
    class_names: tuple[str, ...] = struct.field(pytree_node=False, default=CLASSES)

    def __repr__(self) -> str:
        """Show only the shape: padded arrays are long, traced ones have no values."""
        return f"Detections(boxes {getattr(self.boxes, 'shape', self.boxes)})"

    @property
    def num_clipped(self) -> Int[np.ndarray, " B"]:
        """Detections of every frame of a size that was regressed below `MIN_SIZE_M`."""
        sizes = np.asarray(self.boxes)[..., 3:6]
        is_clipped = (sizes <= np.float32(MIN_SIZE_M)).any(-1)
        return (is_clipped & np.asarray(self.is_valid)).sum(-1)

    def to_columns(self) -> dict[str, Shaped[np.ndarray, "N ..."]]:
        """The valid rows of all frames as plain columns, as evaluation takes them.

        Returns:
            "frame" `[N]` position in the batch, "box" `[N, 7]`, "cls" `[N]` names,
            "score" `[N]`; by frame, then by descending score.
        """
        frame, row = np.nonzero(np.asarray(self.is_valid))
        indices = np.asarray(self.classes)[frame, row]
        return {
            "frame": frame,
            "box": np.asarray(self.boxes, np.float64)[frame, row],
            "cls": np.asarray(self.class_names, object)[indices].astype(str),
            "score": np.asarray(self.scores, np.float64)[frame, row],
        }

    def to_list(self) -> list[list[dict[str, Any]]]:
        """One list per frame of dictionaries: cls, score and the seven box numbers."""
        frames: list[list[dict[str, Any]]] = [[] for _ in range(self.is_valid.shape[0])]
        columns = (column.tolist() for column in self.to_columns().values())
        for frame, box, cls, score in zip(*columns, strict=True):
            values = dict(zip(BOX_FIELDS, box, strict=True))
            frames[frame].append({"cls": cls, "score": score, **values})
        return frames

    def to_pandas(self) -> Any:
        """One row a detection, as a `pandas.DataFrame` (extra "notebook")."""
        import pandas

        columns = self.to_columns()
        boxes = dict(zip(BOX_FIELDS, columns.pop("box").T, strict=True))
        return pandas.DataFrame({**columns, **boxes})


MAX_BOX_VALUE = 1e6
"""Meters and radians: squares of larger numbers lose all precision."""


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Boxes of many frames outside `jit`: predictions, ground truth, what is drawn.

    Attributes:
        frame: int64 index of each box's frame.
        box: float64 x, y, z, l, w, h, yaw in meters and radians, radar frame.
        cls: Class names, or indices of classes.
        score: float64 in [0, 1]; None for ground truth.

    Raises:
        DataError: Columns differ in length, or a value is not finite or out of range;
            names the frame and the row.
    """

    frame: Int[np.ndarray, " N"]
    box: Float[np.ndarray, "N 7"]
    cls: Shaped[np.ndarray, " N"]
    score: Float[np.ndarray, " N"] | None = None

    def __post_init__(self) -> None:
        count = len(self.frame)
        score_rows = count if self.score is None else len(self.score)
        if self.box.shape != (count, 7) or not len(self.cls) == score_rows == count:
            raise DataError(
                f"columns of boxes differ: {count} frames, boxes {self.box.shape}, "
                f"{len(self.cls)} classes, {score_rows} scores; expected one row per box"
            )
        is_good = np.abs(self.box) <= MAX_BOX_VALUE  # False for NaN too
        if not is_good.all():
            row, field = np.argwhere(~is_good)[0]
            raise DataError(
                f"frame {self.frame[row]}, row {row}: {BOX_FIELDS[field]} of the box is "
                f"{self.box[row, field]}, expected a number up to {MAX_BOX_VALUE:g}"
            )
        if self.score is None:
            return
        is_good = (self.score >= 0) & (self.score <= 1)
        if not is_good.all():
            row = int(np.argmin(is_good))
            raise DataError(
                f"frame {self.frame[row]}, row {row}: score {self.score[row]} is outside "
                "[0, 1]"
            )

    @classmethod
    def one_frame(cls, box: Any, names: Any, score: Any = None) -> Boxes:
        """Boxes of one frame, numbered 0, from boxes, class names and scores."""
        box = np.asarray(box, np.float64).reshape(-1, 7)
        score = None if score is None else np.asarray(score, np.float64)
        names = np.asarray(names, str)
        return cls(np.zeros(len(box), np.int64), box, names, score)

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Shaped[np.ndarray, " K"]) -> Boxes:
        """The boxes at positions or under a mask."""
        score = None if self.score is None else self.score[rows]
        return Boxes(self.frame[rows], self.box[rows], self.cls[rows], score)
