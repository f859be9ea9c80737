"""Column tables of frames, ground truth and predictions: checked once, then trusted.

Everything downstream works on `Objects`: frames and classes as dense indices, boxes
in float64, rows sorted by (frame, class) with the caller's order kept inside a frame,
because that order decides ties in K-Radar's protocol.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Real, Shaped
from numpy.typing import ArrayLike

from radejax.core.errors import DataError, UserError
from radejax.core.structures import BOX_FIELDS, CLASSES, ROIS

_MOST = 1e6  # metres and radians: far from where squares are no numbers any more

KNOWN_CLASSES = (*CLASSES, "Pedestrian Group", "Bicycle Group")
"""Class names that may occur in K-Radar's labels; those not asked for are ignored."""

Columns = Mapping[str, np.ndarray]
"""A table: frames, ground truth or predictions by the name of the column."""

AnyColumns = Mapping[str, ArrayLike]
"""The same as users hold it: lists will do."""


_LONGEST_NAME = 200


def read_name(value: object, where: str) -> str:
    """A name that was read, as text.

    An array of names is as wide as its longest one: a single line of a file would take
    thousands of times its size.

    Raises:
        DataError: It is longer than any name; says `where` it was read.

    Example:
        >>> read_name("Bus or Truck", "detections.csv, line 2")
        'Bus or Truck'
    """
    name = str(value)
    if len(name) > _LONGEST_NAME:
        raise DataError(
            f"{where}: {name[:40]!r}... is no name: {len(name)} characters, expected "
            f"at most {_LONGEST_NAME}"
        )
    return name


@dataclasses.dataclass(frozen=True)
class Objects:
    """Boxes of many frames, sorted by frame, then class, then the caller's order.

    Attributes:
        frame: Index into the frame table.
        box: x, y, z, l, w, h, yaw in metres and radians, ego frame.
        cls: Index into the evaluated classes.
        score: Zeros for ground truth.
        row: Row in the caller's table.
    """

    frame: Int[np.ndarray, " N"]
    box: Float[np.ndarray, "N 7"]
    cls: Int[np.ndarray, " N"]
    score: Float[np.ndarray, " N"]
    row: Int[np.ndarray, " N"]

    def __len__(self) -> int:
        return self.frame.size

    def take(self, index: Int[np.ndarray, " K"] | Bool[np.ndarray, " N"]) -> Objects:
        """The rows that `index` (positions or mask) selects."""
        return Objects(
            *(getattr(self, field.name)[index] for field in dataclasses.fields(self))
        )


def roi_bounds(roi: str | Sequence[float] | None) -> tuple[float, ...] | None:
    """Bounds (x0, x1, y0, y1, z0, z1) of a named or given region of interest.

    Raises:
        UserError: An unknown name, or not six increasing bounds.

    Examples:
        >>> roi_bounds([0, 72, -6.4, 6.4, -2, 6])
        (0.0, 72.0, -6.4, 6.4, -2.0, 6.0)
    """
    if roi is None:
        return None
    if isinstance(roi, str):
        if roi not in ROIS:
            raise UserError(f"unknown roi {roi!r}; known: {', '.join(ROIS)}")
        return ROIS[roi]
    bounds = np.asarray(roi, np.float64).reshape(-1)
    if bounds.size != 6 or not np.all(bounds[::2] < bounds[1::2]):
        raise UserError(
            f"roi must be (x0, x1, y0, y1, z0, z1) with increasing bounds, got {roi}"
        )
    return tuple(bounds.tolist())


def in_roi(
    box: Real[np.ndarray, "N 7"], roi: str | Sequence[float] | None
) -> Bool[np.ndarray, " N"]:
    """True for boxes whose centers are inside the region, bounds included.

    Examples:
        >>> cars = np.array([[20.0, 0, 0, 4, 2, 1.5, 0], [20.0, 40, 0, 4, 2, 1.5, 0]])
        >>> in_roi(cars, [0, 72, -6.4, 6.4, -2, 6]).tolist()
        [True, False]
    """
    bounds = roi_bounds(roi)
    if bounds is None:
        return np.ones(len(box), bool)
    low, high = np.array(bounds[::2]), np.array(bounds[1::2])
    return np.all((box[:, :3] >= low) & (box[:, :3] <= high), axis=1)


def roi_name(roi: str | Sequence[float] | None) -> str:
    """A short name of a region for labels and file names.

    Examples:
        >>> roi_name("narrow"), roi_name(None), roi_name([0, 72, -6, 6, -2, 6])
        ('narrow', 'none', '0,72,-6,6,-2,6')
    """
    if roi is None:
        return "none"
    if isinstance(roi, str):
        return roi
    bounds = tuple(float(value) for value in np.asarray(roi).reshape(-1))
    names: dict[tuple[float, ...], str] = {roi: name for name, roi in ROIS.items()}
    return names.get(bounds) or ",".join(f"{value:g}" for value in bounds)


def frame_ids(frames: AnyColumns) -> Int[np.ndarray, " F"]:
    """Ids of a frame table, checked to be integers without repetition.

    Examples:
        >>> frame_ids({"frame": np.array([7, 9])}).tolist()
        [7, 9]
    """
    if "frame" not in frames:
        raise UserError(f"frames need a column 'frame', found {sorted(frames)}")
    ids = _integers(frames["frame"], "frames")
    values, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        twice = values[count > 1][0]
        rows = np.flatnonzero(ids == twice)[:2].tolist()
        raise DataError(f"frames: frame {twice} occurs twice, in rows {rows}")
    for name, column in frames.items():
        if np.shape(column)[:1] != ids.shape:
            raise UserError(
                f"frames: column {name!r} has {np.shape(column)} entries for"
                f" {ids.size} frames"
            )
    return ids


def are_simulated(frames: AnyColumns | None) -> bool:
    """Whether a frame table says that frames of it are simulated.

    Examples:
        >>> are_simulated({"frame": np.array([7, 9])})
        False
    """
    return frames is not None and bool(np.any(frames.get("simulated", False)))


def wanted_columns(scored: bool) -> tuple[str, ...]:
    """Names of the columns of ground truth or, `scored`, of predictions.

    Examples:
        >>> wanted_columns(scored=False)
        ('frame', 'box', 'cls')
    """
    return ("frame", "box", "cls", "score")[: 4 if scored else 3]


def read_columns(
    table: AnyColumns, *, name: str, scored: bool
) -> tuple[
    Int[np.ndarray, " N"],
    Float[np.ndarray, "N 7"],
    Shaped[np.ndarray, " N"],
    Float[np.ndarray, " N"],
]:
    """Frame, box, class name and score of every row of a column table.

    Raises:
        UserError: A column is missing or has the wrong shape or type.
        DataError: A value no box may have, named by frame and row: not finite, a size
            that is not positive, a score outside [0, 1].

    Examples:
        >>> table = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> frame, box, cls, score = read_columns(table, name="ground truth", scored=False)
        >>> frame.tolist(), box.shape, cls.tolist(), score.tolist()
        ([0], (1, 7), ['Sedan'], [0.0])
    """
    missing = [column for column in wanted_columns(scored) if column not in table]
    if missing:
        raise UserError(f"{name} lack the columns {missing}; found {sorted(table)}")
    frame = _integers(table["frame"], name)
    num = frame.size
    box = np.asarray(table["box"], np.float64)
    box = box.reshape(0, 7) if num == 0 else box
    if box.shape != (num, 7):
        raise UserError(
            f"{name}: column 'box' has shape {box.shape}, expected ({num}, 7):"
            " x, y, z, l, w, h, yaw"
        )
    cls = np.asarray(table["cls"])
    if num and cls.dtype.kind not in "UO":
        raise UserError(
            f"{name}: column 'cls' holds {cls.dtype}, expected class names as strings"
        )
    cls = cls.astype(str)
    score = np.asarray(table["score"], np.float64) if scored else np.zeros(num)
    for column, values in (("cls", cls), ("score", score)):
        if values.shape != (num,):
            raise UserError(
                f"{name}: column {column!r} has shape {values.shape}, expected ({num},)"
            )
    otherwise = " (or --invalid_sizes false_positive)" if scored else ""
    for bad, first, must in (
        (~(np.abs(box) <= _MOST), 0, f"is {{}}, expected a number up to {_MOST:g}"),
        (box[:, 3:6] <= 0, 3, "is {:g} m, expected a size above 0" + otherwise),
    ):
        if bad.any():
            row, column = np.argwhere(bad)[0] + (0, first)
            raise DataError(
                f"{name}: frame {frame[row]}, row {row}: {BOX_FIELDS[column]} of the box "
                + must.format(box[row, column])
            )
    bad = ~((score >= 0) & (score <= 1))
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(
            f"{name}: frame {frame[row]}, row {row}: score {score[row]} is outside [0, 1]"
        )
    return frame, box, cls, score


def _integers(column: ArrayLike, name: str) -> Int[np.ndarray, " N"]:
    """A column of frame ids as int64."""
    values = np.asarray(column)
    if values.ndim != 1:
        raise UserError(
            f"{name}: column 'frame' has shape {values.shape}, expected [N]"
        )
    if values.size == 0:
        return values.astype(np.int64)
    if values.dtype.kind == "f" and np.all(values == np.floor(values)):
        values = values.astype(np.int64)
    if values.dtype.kind not in "iu":
        raise UserError(
            f"{name}: column 'frame' holds {values.dtype}, expected integer frame ids"
        )
    return values.astype(np.int64)


def class_indices(
    cls: Shaped[np.ndarray, " N"],
    frame: Int[np.ndarray, " N"],
    classes: Sequence[str],
    *,
    name: str,
) -> Int[np.ndarray, " N"]:
    """Index into `classes`, -1 for known classes that were not asked for.

    Raises:
        DataError: A class name that is neither asked for nor one of K-Radar's.

    Examples:
        >>> cls, frame = np.array(["Sedan", "Bicycle"]), np.array([0, 0])
        >>> class_indices(cls, frame, ["Sedan"], name="ground truth").tolist()
        [0, -1]
    """
    index_of = dict.fromkeys((*classes, *KNOWN_CLASSES), -1)
    index_of |= {name: i for i, name in enumerate(classes)}
    names, inverse = np.unique(cls, return_inverse=True)
    index = np.array([index_of.get(n, -2) for n in names.tolist()], np.int64)[inverse]
    if (index == -2).any():
        row = int(np.argmax(index == -2))
        raise DataError(
            f"{name}: frame {frame[row]}, row {row}: unknown class {str(cls[row])!r};"
            f" known: {', '.join(index_of)}"
        )
    return index


def dense_frames(
    frame: Int[np.ndarray, " N"], ids: Int[np.ndarray, " F"], *, name: str
) -> Int[np.ndarray, " N"]:
    """Positions of `frame` in the table of ids.

    Raises:
        DataError: A frame that the table does not have.

    Examples:
        >>> dense_frames(np.array([9, 7, 7]), np.array([7, 9]), name="predictions").tolist()
        [1, 0, 0]
    """
    order = np.argsort(ids, kind="stable")
    position = np.searchsorted(ids[order], frame)
    position = np.minimum(position, max(ids.size - 1, 0))
    known = ids[order][position] == frame if ids.size else np.zeros(frame.size, bool)
    if not known.all():
        row = int(np.argmin(known))
        raise DataError(
            f"{name}: frame {frame[row]}, row {row}: no such frame among the"
            f" {ids.size} frames that are evaluated"
        )
    return order[position]
