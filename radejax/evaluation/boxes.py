"""Tables of ground truth, predictions and frames: column arrays, checked once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
        frame = _frame_column(table, name)
        box = np.asarray(table["box"], np.float64)
        box = box if frame.size else np.zeros((0, 7))  # an empty list has no width
        cls = np.asarray(table["cls"]).astype(str)
        score = np.asarray(table["score"], np.float64) if scored else None
        try:
            boxes = Boxes(frame, box, cls, score)
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


def _frame_column(table: AnyColumns, name: str) -> Int[np.ndarray, " N"]:
    """Frame ids of a table as int64."""
    ids = np.asarray(table["frame"])
    if ids.ndim != 1 or (ids.size and ids.dtype.kind not in "iu"):
        raise UserError(
            f"{name}: column 'frame' is {ids.dtype} of shape {ids.shape}, expected "
            "integer frame ids [N]"
        )
    return ids.astype(np.int64)


def frame_ids(frames: AnyColumns) -> Int[np.ndarray, " F"]:
    """Ids of a frame table, checked to be integers without repetition.

    Examples:
        >>> frame_ids({"frame": np.array([7, 9])}).tolist()
        [7, 9]
    """
    if "frame" not in frames:
        raise UserError(f"frames need a column 'frame', found {sorted(frames)}")
    ids = _frame_column(frames, "frames")
    values, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        raise DataError(f"frames: frame {values[count > 1][0]} occurs twice")
    for name, column in frames.items():
        if np.shape(column) != ids.shape:
            raise UserError(
                f"frames: column {name!r} has shape {np.shape(column)}, expected one "
                f"value for each of {ids.size} frames"
            )
    return ids


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
    index_of = dict.fromkeys(KNOWN_CLASSES, -1)
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
    is_known = np.isin(frame, ids)
    if not is_known.all():
        row = int(np.argmin(is_known))
        raise DataError(
            f"{name}: frame {frame[row]}, row {row}: no such frame among the"
            f" {ids.size} frames that are evaluated"
        )
    order = np.argsort(ids)
    return order[np.searchsorted(ids, frame, sorter=order)]


def take(table: AnyColumns, rows: Shaped[np.ndarray, " K"]) -> Columns:
    """Rows of a table, by position or mask.

    Examples:
        >>> table = {"frame": np.array([0, 1, 1]), "cls": np.array(["a", "b", "c"])}
        >>> take(table, np.array([1, 2]))["cls"].tolist()
        ['b', 'c']
    """
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
    names = [_without_suffix(name) for name in np.asarray(frames["name"]).tolist()]
    if "sequence" not in frames:
        return names
    sequences = np.asarray(frames["sequence"]).tolist()
    return [
        name if "/" in name else f"{sequence}/{name}"
        for name, sequence in zip(names, sequences, strict=True)
    ]


def _without_suffix(name: object) -> str:
    return str(name).removesuffix(".txt")


def with_ids(
    table: Columns, frames: Columns | None, where: str, *, skip: bool = False
) -> Columns:
    """A table whose frames are named by id, key or "sequence/radar", with ids.

    Args:
        table: With a column frame; ids stay as they are.
        frames: Frame table to look names up in.
        where: The table in errors.
        skip: Leave out rows of frames that the frame table does not have, unless it has
            none of them.

    Raises:
        DataError: A name that the frame table does not have.

    Examples:
        >>> frames = {"frame": np.array([7]), "name": np.array(["5/00012_00001"])}
        >>> table = {"frame": np.array(["5/00012"])}
        >>> with_ids(table, frames, "boxes.json")["frame"].tolist()
        [7]
    """
    named = np.asarray(table["frame"])
    if named.dtype.kind in "iu" or not named.size:
        return {**table, "frame": named.astype(np.int64)}
    names = [_without_suffix(name) for name in named.tolist()]
    known: dict[str, int] = {}
    if frames is not None:
        ids = np.asarray(frames["frame"]).tolist()
        by_key = dict(zip(frame_keys(frames), ids, strict=True))
        by_radar = {key.rpartition("_")[0]: i for key, i in by_key.items()}
        known = by_key | by_radar | by_key  # keys first, and they win
    is_known = np.array([name in known for name in names])
    if skip and is_known.any():
        table = take(table, is_known)
        names = [name for name in names if name in known]
    elif not is_known.all():
        row = int(np.argmin(is_known))
        raise DataError(
            f"{where}: row {row}: frame {names[row]!r:.80}, expected one of the frames "
            f"that are evaluated, such as {next(iter(known), None)!r}"
        )
    return {**table, "frame": np.array([known[name] for name in names], np.int64)}
