"""Containers that the packages pass to each other.

`Batch`, `DetectionMaps` and `Detections` are JAX pytrees of fixed shape; `Boxes` is used
outside `jit`. Shapes are written with B frames, R range bins, A azimuth bins, D Doppler bins,
E elevation bins, N padded ground-truth boxes, K padded detections and C classes. Boxes are in
the radar (ego) frame in meters: x forward, y left, z up, with the origin of z at the LiDAR
(docs/conventions.md). The yaw is counter-clockwise from x in radians.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, PyTree, Real, Shaped
from numpy.typing import ArrayLike

from radejax.core.errors import DataError
from radejax.core.files import JsonObject

if TYPE_CHECKING:
    import pandas

Array = jax.Array | np.ndarray

CLASSES = ("Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle")
"""K-Radar's five detection classes in the order of every class axis."""

RARE_SHARE = 0.02
"""Classes with less than this fraction of the training objects of a weather are marked, as in
Table 2 of DinoRADE."""

BOX_FIELDS = ("x", "y", "z", "l", "w", "h", "yaw")
"""Names of the parameters of a box, in meters and radians."""

NARROW_ROI = (0.0, 72.0, -6.4, 6.4, -2.0, 6.0)
"""K-Radar's benchmark region: x0, x1, y0, y1, z0, z1 in meters in the ego frame."""

MIN_SIZE_M = 0.01
"""Smallest length, width and height of decoded boxes in meters; smaller ones are clipped."""

WIDE_ROI = (0.0, 72.0, -16.0, 16.0, -2.0, 7.6)
"""K-Radar's wide region: x0, x1, y0, y1, z0, z1 in meters in the ego frame."""

ROIS = {"narrow": NARROW_ROI, "wide": WIDE_ROI}
"""Regions by name. Their bounds apply to box centers and are inclusive."""


def frame_key(text: str) -> str:
    """Returns the key "sequence/radar_lidar" of a K-Radar frame in its usual spelling.

    Leading zeros and the suffix of label files may differ from it, and the sequence or the
    LiDAR number may be missing. Other names are returned unchanged.

    Examples:
        >>> frame_key("05/33_1.txt"), frame_key("5/00033"), frame_key("night/a7")
        ('5/00033_00001', '5/00033', 'night/a7')
    """
    sequence, slash, name = text.rpartition("/")
    if re.fullmatch("[0-9]{1,9}", sequence):
        sequence = str(int(sequence))
    name = name.removesuffix(".txt")
    if re.fullmatch("[0-9]{1,9}(_[0-9]{1,9})?", name):
        name = "_".join(f"{int(number):05d}" for number in name.split("_"))
    return f"{sequence}{slash}{name}"


class Batch(struct.PyTreeNode):
    """One batch of frames as the pipeline delivers it and the losses consume it.

    Attributes:
        projection: Normalized projections as they are stored: D Doppler channels, then E
            elevation channels; of every frame of a sample, see `stack_frames`.
        boxes: x, y, z, l, w, h, sin yaw, cos yaw; l, w and h are full extents; float32.
        classes: int32 class indices; any value where not `is_valid`.
        is_valid: True where a box is an object and not padding.
        frame: int32 index of the frame in its dataset; -1 for frames that pad the batch.
        image: `[B, H, W, 3]` uint8 left front camera images, the features that the image
            backbone computed from them, or None.
        camera: `Camera` or `ReferencePoints` with a leading axis B, or None.
        targets: `[B, N, ...]` columns of `config.data.targets` by name; NaN where a value
            is unknown, 0 where not `is_valid`.
    """

    # Leaves are not validated: JAX also rebuilds the tree with shapes, specs or None.
    projection: Real[Array, "B R A DE"]
    boxes: Float[Array, "B N 8"]
    classes: Int[Array, "B N"]
    is_valid: Bool[Array, "B N"]
    frame: Int[Array, " B"]
    image: Real[Array, "B _ _ _"] | None = None
    camera: PyTree[Array] | None = None
    targets: dict[str, Array] = struct.field(default_factory=dict)

    def model_inputs(self) -> tuple[PyTree[Array], ...]:
        """Returns the positional inputs of a model.

        These are the projection and, if the batch has images, the images and cameras.
        """
        projection = to_float(self.projection)
        if self.image is None:
            return (projection,)
        return projection, self.image, self.camera


def to_float(projection: Real[Array, "*axes"]) -> Float[jax.Array, "*axes"]:
    """Converts stored values of projections to float32 network input on the device.

    Batches are transferred in the dtype of the records, which takes a quarter to a half
    of the bytes of float32. The jitted train step therefore starts with this cast.

    Args:
        projection: Projections in uint8 (p = q / 255), float16, bfloat16 or float32.
    """
    values = jnp.asarray(projection).astype(jnp.float32)
    return values / 255.0 if projection.dtype == jnp.uint8 else values


class DetectionMaps(struct.PyTreeNode):
    """Predictions of a detector for every range-azimuth bin.

    Attributes:
        heatmap_logits: Logits of the center heatmap, before the sigmoid.
        box_params: Raw dx, dy, z, l, w, h, sin yaw, cos yaw; dx and dy are offsets from
            the center of the bin in meters.
        outputs: Further predictions `[B, R, A, ...]` by name, see `config.model.outputs`.
    """

    heatmap_logits: Float[jax.Array, "B R A C"]
    box_params: Float[jax.Array, "B R A 8"]
    outputs: dict[str, jax.Array] = struct.field(default_factory=dict)


class Detections(struct.PyTreeNode):
    """Detected boxes of a batch, by descending score, padded to a fixed number K.

    Attributes:
        boxes: x, y, z, l, w, h, yaw.
        scores: Scores in [0, 1]; 0 where not `is_valid`.
        classes: int32 class indices; -1 where not `is_valid`.
        is_valid: True where a row is a detection and not padding.
        num_truncated: int32 number of peaks before NMS and boxes after it that were
            dropped because of the fixed number of rows, see `detection.decode.decode`.
        num_invalid: int32 number of frames of the sample whose values cannot be radar data;
            None if only maps were decoded.
        outputs: `[B, K, ...]` further outputs of the model at the boxes' bins, by name.
        class_names: Names of the detector's classes by class index; static under `jit`.
    """

    boxes: Float[jax.Array, "B K 7"]
    scores: Float[jax.Array, "B K"]
    classes: Int[jax.Array, "B K"]
    is_valid: Bool[jax.Array, "B K"]
    num_truncated: Int[jax.Array, " B"]
    num_invalid: Int[jax.Array, " B"] | None = None
    outputs: dict[str, jax.Array] = struct.field(default_factory=dict)
    class_names: tuple[str, ...] = struct.field(pytree_node=False, default=CLASSES)

    def __repr__(self) -> str:
        """Shows only the shape: padded arrays are long, and traced arrays have no values."""
        return f"Detections(boxes {getattr(self.boxes, 'shape', self.boxes)})"

    def to_boxes(self, frame: Int[np.ndarray, " B"] | None = None) -> Boxes:
        """Returns the valid rows of all frames on the host.

        Args:
            frame: Index of every frame; its position in the batch if None. Frames with a
                negative index, which pad a batch, are left out.

        Returns:
            Boxes with scores, in the order of the frames, then by descending score.
        """
        indices = np.arange(len(self.is_valid)) if frame is None else frame
        is_real = (indices >= 0)[:, None] & np.asarray(self.is_valid)
        position, row = np.nonzero(is_real)
        cls = np.asarray(self.classes)[position, row]
        return Boxes(
            frame=indices[position].astype(np.int64),
            box=np.asarray(self.boxes, np.float64)[position, row],
            cls=np.asarray(self.class_names, object)[cls].astype(str),
            score=np.asarray(self.scores, np.float64)[position, row],
            extras={n: np.asarray(x)[position, row] for n, x in self.outputs.items()},
            num_truncated=int(np.asarray(self.num_truncated)[indices >= 0].sum()),
        )

    def to_list(self) -> list[list[JsonObject]]:
        """Returns a list of dictionaries per frame, see `Boxes.to_list`."""
        frames: list[list[JsonObject]] = [[] for _ in range(len(self.is_valid))]
        boxes = self.to_boxes()
        for frame, row in zip(boxes.frame.tolist(), boxes.to_list(), strict=True):
            frames[frame].append(row)
        return frames

    def to_pandas(self) -> pandas.DataFrame:
        """Returns a `pandas.DataFrame` with one row per detection.

        pandas is installed by the extra "notebook".
        """
        import pandas

        boxes = self.to_boxes()
        fields = {name: x.tolist() for name, x in boxes.fields().items()}
        return pandas.DataFrame({"frame": boxes.frame, **fields})


MAX_BOX_VALUE = 1e6
"""Largest valid box parameter in meters or radians; squares of larger ones lose precision."""


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Predicted or ground-truth boxes of any number of frames, outside `jit`.

    Attributes:
        frame: int64 index of each box's frame.
        box: float64 x, y, z, l, w, h, yaw in meters and radians in the radar frame.
        cls: Class names or class indices.
        score: float64 scores in [0, 1]; None for ground truth.
        extras: Further columns by name, with one row per box.
        num_truncated: Number of boxes that the detector dropped because of its fixed number
            of rows, see `Detections`; 0 if it is not known.

    Raises:
        DataError: Columns differ in length, or a value is not finite or out of range. In
            the latter case the message names the frame and the row.
    """

    frame: Int[np.ndarray, " N"]
    box: Float[np.ndarray, "N 7"]
    cls: Shaped[np.ndarray, " N"]
    score: Float[np.ndarray, " N"] | None = None
    extras: Mapping[str, Shaped[np.ndarray, "N ..."]] = dataclasses.field(
        default_factory=dict
    )
    num_truncated: int = 0

    def __post_init__(self) -> None:
        count = len(self.frame)
        num_scores = count if self.score is None else len(self.score)
        lengths = {len(self.cls), num_scores, *map(len, self.extras.values())}
        if self.box.shape != (count, 7) or lengths != {count}:
            raise DataError(
                f"columns of boxes differ: {count} frames, boxes {self.box.shape}, "
                f"{len(self.cls)} classes, {num_scores} scores"
                + "".join(f", {len(x)} of {name}" for name, x in self.extras.items())
                + "; expected one row per box"
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
    def one_frame(
        cls, box: ArrayLike, names: ArrayLike, score: ArrayLike | None = None
    ) -> Boxes:
        """Creates the boxes of a single frame, whose index is 0.

        Args:
            box: Boxes x, y, z, l, w, h, yaw.
            names: Class names.
            score: Scores; None for ground truth.
        """
        box = np.asarray(box, np.float64).reshape(-1, 7)
        score = None if score is None else np.asarray(score, np.float64)
        names = np.asarray(names, str)
        return cls(np.zeros(len(box), np.int64), box, names, score)

    @classmethod
    def concatenate(cls, parts: Sequence[Boxes]) -> Boxes:
        """Returns the boxes of all parts in their order.

        Args:
            parts: One or more tables with the same columns.
        """
        tables = [part.columns() for part in parts]
        joined = {n: np.concatenate([table[n] for table in tables]) for n in tables[0]}
        frame, box, names = (joined.pop(name) for name in ("frame", "box", "cls"))
        total = sum(part.num_truncated for part in parts)
        return cls(frame, box, names, joined.pop("score", None), joined, total)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def is_clipped(self) -> Bool[np.ndarray, " N"]:
        """Mask of the boxes with an l, w or h of at most `MIN_SIZE_M`.

        `decode` clips smaller sizes to this value by default.
        """
        smallest: Float[np.ndarray, " N"] = self.box[:, 3:6].min(axis=1)
        return smallest <= np.float32(MIN_SIZE_M)

    def take(self, rows: Shaped[np.ndarray, " K"]) -> Boxes:
        """Returns some of the boxes.

        Args:
            rows: Positions of the boxes, or a boolean mask of them.

        Examples:
            >>> boxes = Boxes.one_frame(np.zeros((2, 7)), ["Sedan", "Pedestrian"])
            >>> boxes.take(boxes.cls == "Sedan").cls.tolist()
            ['Sedan']
        """
        score = None if self.score is None else self.score[rows]
        extras = {name: column[rows] for name, column in self.extras.items()}
        return Boxes(self.frame[rows], self.box[rows], self.cls[rows], score, extras)

    def columns(self) -> dict[str, Shaped[np.ndarray, "N ..."]]:
        """Returns the columns "frame", "box", "cls", "score" if there are any, and extras."""
        columns = {"frame": self.frame, "box": self.box, "cls": self.cls}
        if self.score is not None:
            columns["score"] = self.score
        return {**columns, **self.extras}

    def fields(self) -> dict[str, Shaped[np.ndarray, "N ..."]]:
        """Returns the columns cls, score, x, y, z, l, w, h, yaw and extras for tables."""
        score = {} if self.score is None else {"score": self.score}
        box = dict(zip(BOX_FIELDS, self.box.T, strict=True))
        return {"cls": self.cls, **score, **box, **self.extras}

    def to_list(self) -> list[JsonObject]:
        """Returns one dictionary per box, with its `fields` as Python scalars and text."""
        fields = self.fields()
        rows = zip(*(column.tolist() for column in fields.values()), strict=True)
        return [dict(zip(fields, row, strict=True)) for row in rows]
