"""Tables of ground truth, predictions and frames: column arrays, checked once."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Int, Real, Shaped
from numpy.typing import ArrayLike

from radejax.core.errors import DataError, UserError
from radejax.core.structures import BOX_FIELDS, CLASSES, ROIS, Boxes

KNOWN_CLASSES = (*CLASSES, "Pedestrian Group", "Bicycle Group")
"""Class names that may occur in K-Radar's labels; those not evaluated are ignored."""

Columns = Mapping[str, np.ndarray]
"""A table of frames, ground truth or predictions: arrays by the name of the column."""

AnyColumns = Mapping[str, ArrayLike]
"""The same as users have it: lists are accepted."""

Roi = str | Sequence[float] | None
"""A region of interest: "narrow", "wide", (x0, x1, y0, y1, z0, z1), or None for all."""


def roi_bounds(roi: Roi) -> tuple[float, ...] | None:
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
            raise UserError(f"roi is {roi!r}, expected one of {', '.join(ROIS)}")
        return ROIS[roi]
    bounds = np.asarray(roi, np.float64).reshape(-1)
    if bounds.size != 6 or not np.all(bounds[::2] < bounds[1::2]):
        raise UserError(
            f"roi is {roi}, expected x0, x1, y0, y1, z0, z1 with increasing bounds"
        )
    return tuple(bounds.tolist())


def in_roi(box: Real[np.ndarray, "N 7"], roi: Roi) -> Bool[np.ndarray, " N"]:
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


def roi_name(roi: Roi) -> str:
    """A short name of a region for the names of results.

    Examples:
        >>> roi_name("narrow"), roi_name(None), roi_name([0, 72, -6, 6, -2, 6])
        ('narrow', 'none', '0,72,-6,6,-2,6')
    """
    if roi is None or isinstance(roi, str):
        return roi or "none"
    bounds = roi_bounds(roi)
    assert bounds is not None  # only None has none
    names: dict[tuple[float, ...], str] = {value: name for name, value in ROIS.items()}
    return names.get(bounds) or ",".join(f"{value:g}" for value in bounds)


def read_boxes(table: AnyColumns | Boxes, name: str, *, scored: bool) -> Boxes:
    """Boxes from columns frame, box, cls and, for predictions, score.

    Args:
        table: The columns.
        name: Of the table in errors, such as "predictions".
        scored: Whether a score is expected.

    Raises:
        UserError: A column is missing or has the wrong shape or type.
        DataError: A value that no box may have; names the table, frame and row.

    Examples:
        >>> table = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> read_boxes(table, "ground truth", scored=False).cls.tolist()
        ['Sedan']
    """
    if isinstance(table, Boxes):
        boxes = table
    else:
        wanted = ("frame", "box", "cls", "score")[: 4 if scored else 3]
        if missing := [column for column in wanted if column not in table]:
            raise UserError(f"{name} lack the columns {missing}; found {sorted(table)}")
        frame = _integers(table["frame"], name)
        arrays = {
            "box": np.asarray(table["box"], np.float64),
            "cls": np.asarray(table["cls"]),
        }
        if scored:
            arrays["score"] = np.asarray(table["score"], np.float64)
        if frame.size == 0:  # an empty list has neither type nor width
            arrays |= {"box": arrays["box"].reshape(0, 7), "cls": np.zeros(0, str)}
        for column, values in arrays.items():
            expected = (frame.size, 7) if column == "box" else (frame.size,)
            if values.shape != expected:
                raise UserError(
                    f"{name}: column {column!r} has shape {values.shape}, expected "
                    f"{expected}"
                )
        if arrays["cls"].dtype.kind not in "UO":
            raise UserError(
                f"{name}: column 'cls' is {arrays['cls'].dtype}, expected class names as "
                "strings"
            )
        arrays["cls"] = arrays["cls"].astype(str)
        try:
            boxes = Boxes(frame, **arrays)
        except DataError as error:
            raise DataError(f"{name}: {error}") from None
    is_empty = boxes.box[:, 3:6] <= 0
    if is_empty.any():
        row, size = np.argwhere(is_empty)[0]
        hint = " (or --invalid-sizes false_positive)" if scored else ""
        raise DataError(
            f"{name}: frame {boxes.frame[row]}, row {row}: {BOX_FIELDS[3 + size]} of the "
            f"box is {boxes.box[row, 3 + size]:g} m, expected a size above 0{hint}"
        )
    return boxes


def _integers(column: ArrayLike, name: str) -> Int[np.ndarray, " N"]:
    """A column of frame ids as int64."""
    values = np.asarray(column)
    if values.ndim != 1:
        raise UserError(
            f"{name}: column 'frame' has shape {values.shape}, expected [N]"
        )
    if values.dtype.kind == "f" and np.all(values == np.floor(values)):
        values = values.astype(np.int64)
    if values.size and values.dtype.kind not in "iu":
        raise UserError(
            f"{name}: column 'frame' is {values.dtype}, expected integer frame ids"
        )
    return values.astype(np.int64)


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
        raise DataError(f"frames: frame {values[count > 1][0]} occurs twice")
    for name, column in frames.items():
        if np.shape(column)[:1] != ids.shape:
            raise UserError(
                f"frames: column {name!r} has {np.shape(column)} entries for"
                f" {ids.size} frames"
            )
    return ids


def are_simulated(frames: AnyColumns | None) -> bool:
    """Whether a frame table says that some of its frames are simulated.

    Examples:
        >>> are_simulated({"frame": [0, 1], "simulated": [False, True]})
        True
    """
    return frames is not None and bool(np.any(frames.get("simulated", False)))


def class_indices(
    boxes: Boxes, classes: Sequence[str], name: str
) -> Int[np.ndarray, " N"]:
    """Index of each box into `classes`, -1 for known classes that are not among them.

    Raises:
        DataError: A class name that is neither evaluated nor one of K-Radar's.

    Examples:
        >>> box = np.ones((2, 7))
        >>> boxes = Boxes(np.array([0, 0]), box, np.array(["Sedan", "Bicycle"]))
        >>> class_indices(boxes, ["Sedan"], "ground truth").tolist()
        [0, -1]
    """
    index_of = dict.fromkeys((*classes, *KNOWN_CLASSES), -1)
    index_of |= {name: i for i, name in enumerate(classes)}
    names, inverse = np.unique(boxes.cls, return_inverse=True)
    index = np.array([index_of.get(n, -2) for n in names.tolist()], np.int64)[inverse]
    if (index == -2).any():
        row = int(np.argmax(index == -2))
        raise DataError(
            f"{name}: frame {boxes.frame[row]}, row {row}: unknown class "
            f"{str(boxes.cls[row])!r:.80}; known: {', '.join(index_of)}"
        )
    return index


def frame_positions(
    frame: Int[np.ndarray, " N"], ids: Int[np.ndarray, " F"], name: str
) -> Int[np.ndarray, " N"]:
    """Positions of frames in the table of ids.

    Raises:
        DataError: A frame that the table does not have.

    Examples:
        >>> frame_positions(np.array([9, 7, 7]), np.array([7, 9]), "predictions").tolist()
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


def take_frames(table: Columns, ids: Shaped[np.ndarray, " F"]) -> Columns:
    """Rows of a table that are of some frames.

    Examples:
        >>> table = {"frame": np.array([0, 1, 1]), "cls": np.array(["a", "b", "c"])}
        >>> take_frames(table, np.array([1]))["cls"].tolist()
        ['b', 'c']
    """
    rows = np.isin(table["frame"], ids)
    return {name: np.asarray(column)[rows] for name, column in table.items()}


# Frames by name -----------------------------------------------------------------------


def frame_keys(frames: Columns) -> list[str]:
    """Key "sequence/name" of every frame; the id where these are not known.

    Examples:
        >>> frame_keys({"frame": [0], "sequence": [5], "name": ["00012_00001.txt"]})
        ['5/00012_00001']
    """
    if "name" not in frames:
        return [str(frame) for frame in np.asarray(frames["frame"]).tolist()]
    names = [_strip(str(name)) for name in np.asarray(frames["name"]).tolist()]
    if "sequence" not in frames:
        return names
    sequences = np.asarray(frames["sequence"]).tolist()
    return [
        name if "/" in name else f"{sequence}/{name}"
        for name, sequence in zip(names, sequences, strict=True)
    ]


def _known_frames(frames: Columns) -> dict[str, int]:
    """Ids by key, and by the part of it that a radar file has: "sequence/radar"."""
    ids = np.asarray(frames["frame"]).tolist()
    keys = dict(zip(frame_keys(frames), ids, strict=True))
    return {key.rpartition("_")[0]: frame for key, frame in keys.items()} | keys


def _strip(name: str) -> str:
    return name.removesuffix(".txt")


def find_frames(named: Any, frames: Columns | None, *, where: str) -> np.ndarray:
    """Ids of frames that are named by id, key or "sequence/radar".

    Raises:
        DataError: A frame that the table does not have, or names without a table.

    Examples:
        >>> frames = {"frame": [7], "name": ["5/00012_00001"]}
        >>> find_frames(["5/00012_00001"], frames, where="boxes.json").tolist()
        [7]
    """
    named = np.asarray(named)
    if named.size == 0:
        return np.zeros(0, np.int64)
    if named.dtype.kind in "iu":
        return named.astype(np.int64)
    # Rows of a frame are neighbors: look each frame up once.
    first = np.flatnonzero(np.append(True, named[1:] != named[:-1]))
    text = [_strip(str(name)) for name in named[first].tolist()]
    if all(re.fullmatch("-?[0-9]{1,18}", name) for name in text):
        found = [int(name) for name in text]
    elif frames is None:
        raise DataError(f"{where}: frames are named ({text[0]!r}), but none are known")
    else:
        known = _known_frames(frames)
        for row, name in zip(first.tolist(), text, strict=True):
            if name not in known:
                count, such = len(frames["frame"]), next(iter(frame_keys(frames)), "-")
                raise DataError(
                    f"{where}: row {row}: no frame {name!r:.80} among the {count} frames"
                    f" that are evaluated (such as {such!r})"
                )
        found = [known[name] for name in text]
    return np.repeat(np.array(found, np.int64), np.diff(first, append=named.size))


def of_known_frames(columns: Columns, frames: Columns) -> Columns:
    """Rows of frames that the table has; all rows if there are none.

    Examples:
        >>> frames = {"frame": [0], "name": ["5/00012_00001"]}
        >>> columns = {"frame": np.array(["5/00012", "5/00013"])}
        >>> of_known_frames(columns, frames)["frame"].tolist()
        ['5/00012']
    """
    known = _known_frames(frames)
    is_known = [_strip(str(name)) in known for name in columns["frame"].tolist()]
    if not any(is_known):
        return columns
    return {name: column[np.array(is_known)] for name, column in columns.items()}
