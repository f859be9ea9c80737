"""Tables of ground truth, predictions and frames as column arrays.

A frame is named by its id in the frame table (an integer) or by its key "sequence/name",
such as "1/00033_00001" (K-Radar's label file, with or without .txt).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Real, Shaped
from numpy.typing import ArrayLike

from radejax.core.errors import DataError, UserError, require
from radejax.core.files import PathLike, atomic_write
from radejax.core.structures import BOX_FIELDS, CLASSES, ROIS, Boxes, frame_key
from radejax.data.dataset import LabeledFrame

KNOWN_CLASSES = (*CLASSES, "Pedestrian Group", "Bicycle Group")
"""Class names that may occur in K-Radar's labels; those not evaluated are ignored."""

Columns = Mapping[str, np.ndarray]
"""A table of frames, ground truth or predictions: arrays by the name of the column."""

AnyColumns = Mapping[str, ArrayLike]
"""A table as users pass it: lists are accepted as columns."""

AnyBoxes = AnyColumns | Boxes
"""Ground truth or predictions as users pass them."""

Roi = str | Sequence[float] | None
"""A region of interest: "narrow", "wide", (x0, x1, y0, y1, z0, z1), or None for all."""


def roi_bounds(roi: Roi, field: str = "roi") -> tuple[float, ...] | None:
    """Returns the bounds (x0, x1, y0, y1, z0, z1) of a named or given region of interest.

    Args:
        roi: One of `ROIS`, the bounds in meters in the radar frame, or None.
        field: Name of the option for the error message.

    Raises:
        UserError: The name is unknown, or the bounds are not three increasing pairs.

    Examples:
        >>> roi_bounds([0, 72, -6.4, 6.4, -2, 6])
        (0.0, 72.0, -6.4, 6.4, -2.0, 6.0)
    """
    if roi is None:
        return None
    if isinstance(roi, str):
        require(roi in ROIS, field, roi, f"one of {', '.join(ROIS)}")
        return ROIS[roi]
    bounds = np.asarray(roi, np.float64).reshape(-1)
    is_valid = bounds.size == 6 and bool((bounds[::2] < bounds[1::2]).all())
    require(is_valid, field, roi, "x0, x1, y0, y1, z0, z1 with increasing bounds")
    return tuple(bounds.tolist())


def in_roi(box: Real[np.ndarray, "N 7"], roi: Roi) -> Bool[np.ndarray, " N"]:
    """Returns a mask of boxes whose centers are inside the region, bounds included.

    Args:
        box: Boxes x, y, z, l, w, h, yaw in the radar frame.
        roi: Region in meters, see `roi_bounds`; None contains every box.

    Examples:
        >>> cars = np.array([[20.0, 0, 0, 4, 2, 1.5, 0], [20.0, 40, 0, 4, 2, 1.5, 0]])
        >>> in_roi(cars, [0, 72, -6.4, 6.4, -2, 6]).tolist()
        [True, False]
    """
    bounds = roi_bounds(roi)
    if bounds is None:
        return np.ones(len(box), bool)
    is_inside: Bool[np.ndarray, " N"]
    center = box[:, :3]
    is_inside = np.all((center >= bounds[::2]) & (center <= bounds[1::2]), axis=1)
    return is_inside


def roi_name(roi: Roi) -> str:
    """Returns a short name of a region for the names of results.

    Examples:
        >>> roi_name("narrow"), roi_name(None), roi_name([0, 72, -6, 6, -2, 6])
        ('narrow', 'none', '0,72,-6,6,-2,6')
    """
    bounds = roi_bounds(roi)
    if bounds is None:
        return "none"
    names: dict[tuple[float, ...], str] = {value: name for name, value in ROIS.items()}
    return names.get(bounds) or ",".join(f"{value:g}" for value in bounds)


def columns_of_boxes(table: AnyBoxes) -> Columns:
    """Returns boxes as columns; boxes without scores have no column score.

    Examples:
        >>> box = Boxes(np.array([7]), np.ones((1, 7)), np.array(["Sedan"]))
        >>> list(columns_of_boxes(box))
        ['frame', 'box', 'cls']
    """
    columns = table.columns() if isinstance(table, Boxes) else table
    return {name: np.asarray(x) for name, x in columns.items()}


def read_boxes(table: AnyBoxes, name: str, *, scored: bool) -> Boxes:
    """Reads boxes from the columns frame, box, cls and, for predictions, score.

    Further columns of numbers become `extras`.

    Args:
        table: Boxes, or columns by name.
        name: Name of the table in errors, such as "predictions".
        scored: Whether a score is expected.

    Raises:
        UserError: A column is missing or has the wrong shape or type.
        DataError: A value is invalid; the message names the table, frame and row.

    Examples:
        >>> table = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> read_boxes(table, "ground truth", scored=False).cls.tolist()
        ['Sedan']
    """
    columns = columns_of_boxes(table)
    if missing := [x for x in column_names(scored) if x not in columns]:
        raise UserError(f"{name} lack the columns {missing}; found {sorted(columns)}")
    frame = _frame_column(columns, name)
    box = columns["box"].astype(np.float64)
    box = box if frame.size else np.zeros((0, 7))  # an empty list has no width
    score = columns["score"].astype(np.float64) if scored else None
    usual = ("frame", "box", "cls", "score")
    others = {name: x for name, x in columns.items() if name not in usual}
    extras = {name: x for name, x in others.items() if x.dtype.kind in "biuf"}
    try:
        return Boxes(frame, box, columns["cls"].astype(str), score, extras)
    except DataError as error:
        raise DataError(f"{name}: {error}") from None


def column_names(scored: bool) -> tuple[str, ...]:
    """Returns the columns of ground truth, or of predictions with scores.

    Examples:
        >>> column_names(scored=False)
        ('frame', 'box', 'cls')
    """
    return ("frame", "box", "cls", "score")[: 4 if scored else 3]


def require_sizes(boxes: Boxes, name: str) -> None:
    """Raises a `DataError` for boxes with a size that is not positive.

    Examples:
        >>> require_sizes(Boxes.one_frame(np.ones(7), ["Sedan"]), "ground truth")
    """
    is_empty = boxes.box[:, 3:6] <= 0
    if is_empty.any():
        row, size = np.argwhere(is_empty)[0]
        hint = "" if boxes.score is None else " (or --invalid-sizes false_positive)"
        raise DataError(
            f"{name}: frame {boxes.frame[row]}, row {row}: {BOX_FIELDS[3 + size]} of the "
            f"box is {boxes.box[row, 3 + size]:g} m, expected a size above 0{hint}"
        )


def _frame_column(table: AnyColumns, name: str) -> Int[np.ndarray, " N"]:
    """Returns the frame ids of a table as int64."""
    ids = np.asarray(table["frame"])
    if ids.ndim != 1 or (ids.size and ids.dtype.kind not in "iu"):
        raise UserError(
            f"{name}: column 'frame' is {ids.dtype} of shape {ids.shape}, expected "
            "integer frame ids [N]"
        )
    return ids.astype(np.int64)


def frame_ids(frames: AnyColumns) -> Int[np.ndarray, " F"]:
    """Returns the ids of a frame table, checked to be unique integers.

    Args:
        frames: Frame table: columns of equal length, of which "frame" has the ids.

    Raises:
        UserError: The table has no column frame, it is not of integers, or a column has
            another length.
        DataError: A frame occurs twice.

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
    boxes: Boxes, classes: Sequence[str], name: str, known: Sequence[str] = ()
) -> Int[np.ndarray, " N"]:
    """Returns the index of each box into `classes`, or -1 for other known classes.

    Args:
        boxes: Boxes with class names.
        classes: Classes that are evaluated.
        name: Name of the table for the error message.
        known: Known classes besides these and K-Radar's.

    Raises:
        DataError: A class name is neither evaluated nor known.

    Examples:
        >>> box = np.ones((2, 7))
        >>> boxes = Boxes(np.array([0, 0]), box, np.array(["Sedan", "Bicycle"]))
        >>> class_indices(boxes, ["Sedan"], "ground truth").tolist()
        [0, -1]
    """
    index_of = dict.fromkeys((*KNOWN_CLASSES, *known), -1)
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
    """Returns the positions of frames in the array `ids`.

    Args:
        frame: Ids of frames, of which each may occur several times.
        ids: Ids of all frames.
        name: Name of the table for the error message.

    Raises:
        DataError: A frame is not in `ids`.

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
    """Selects rows of a table by position or mask.

    Args:
        table: Columns of equal length by name.
        rows: Positions of the rows, or a boolean mask of them.

    Examples:
        >>> table = {"frame": np.array([0, 1, 1]), "cls": np.array(["a", "b", "c"])}
        >>> take(table, np.array([1, 2]))["cls"].tolist()
        ['b', 'c']
    """
    return {name: np.asarray(column)[rows] for name, column in table.items()}


def columns_of(
    rows: Sequence[tuple[int | str, str, Sequence[float], float]],
) -> Columns:
    """Converts rows of frame, class, box and score to columns.

    Examples:
        >>> columns_of([(7, "Sedan", (20, 0, 0, 4, 2, 1.5, 0), 0.9)])["frame"].tolist()
        [7]
    """
    frame, cls, box, score = ([row[i] for row in rows] for i in range(4))
    return {
        "frame": np.array(frame) if rows else np.zeros(0, np.int64),
        "cls": np.array(cls, str),
        "box": np.array(box, np.float64).reshape(-1, 7),
        "score": np.array(score, np.float64),
    }


def tables_from_frames(
    frames: Iterable[LabeledFrame],
    split: str | None = None,
    targets: Sequence[str] = (),
) -> tuple[Boxes, Columns]:
    """Builds ground truth and frame table of a dataset such as `radejax.data.kradar.KRadar`.

    Args:
        frames: The labeled frames.
        split: Split to store in the frame table: "train", "test", "all" or a split file;
            None if it is not known.
        targets: Names of the frames' `columns` that become columns of the ground truth, NaN
            in frames without them.

    Returns:
        The ground truth and the frame columns. The frame id is the position in `frames`.

    Examples:
        >>> truth, frames = tables_from_frames([], "test")
        >>> len(truth), frames["split"].size
        (0, 0)
    """
    frames = list(frames)
    ids = np.arange(len(frames))
    box = [np.asarray(frame.boxes, np.float64).reshape(-1, 7) for frame in frames]
    cls = [str(name) for frame in frames for name in frame.classes]
    extras = {name: _joined(frames, name) for name in targets}
    ground_truth = Boxes(
        np.repeat(ids, np.array([len(rows) for rows in box], int)),
        np.concatenate([np.zeros((0, 7)), *box]),
        np.array(cls, dtype=str),
        extras=extras,
    )
    table = {"frame": ids}
    for column in ("sequence", "name", "weather", "environment", "time"):
        table[column] = np.array([getattr(frame, column) for frame in frames])
    table["simulated"] = np.array([frame.is_simulated for frame in frames], bool)
    if split is not None:
        table["split"] = np.full(len(frames), str(split))
    return ground_truth, table


def _joined(frames: Sequence[LabeledFrame], name: str) -> Float[np.ndarray, "N ..."]:
    """Returns a column of the objects of all frames, NaN in frames without it."""
    found = [frame.columns[name] for frame in frames if name in frame.columns]
    inner = max(found, key=len).shape[1:] if found else ()
    parts = [
        np.asarray(frame.columns[name], np.float64)
        if name in frame.columns and len(frame.boxes)  # others may have another shape
        else np.full((len(frame.boxes), *inner), np.nan)
        for frame in frames
    ]
    return np.concatenate([np.zeros((0, *inner)), *parts])


def write_boxes(path: PathLike, boxes: Boxes, frames: AnyColumns) -> None:
    """Writes boxes as columns to a .npz file, which `files.read_table` reads.

    Frames are written by key if the frame table has names, and by id otherwise. Keys
    remain valid for another selection or order of frames.

    Examples:
        >>> import pathlib, tempfile
        >>> boxes = Boxes(np.array([7]), np.ones((1, 7)), np.array(["Sedan"]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "truth.npz"
        ...     write_boxes(path, boxes, {"frame": [7], "name": ["1/00033_00001"]})
        ...     np.load(path)["frame"].tolist()
        ['1/00033_00001']
    """
    columns: dict[str, Any] = boxes.columns()
    if "name" in frames:
        position = frame_positions(boxes.frame, frame_ids(frames), str(path))
        columns["frame"] = np.array(frame_keys(frames), dtype=str)[position]
    with atomic_write(path) as file:
        np.savez_compressed(file, **columns)


# Frames by name -----------------------------------------------------------------------


def frame_keys(frames: AnyColumns) -> list[str]:
    """Returns the key "sequence/name" of every frame, or its name or id if that is missing.

    Examples:
        >>> frame_keys({"frame": [0], "sequence": [5], "name": ["00012_00001.txt"]})
        ['5/00012_00001']
    """
    if "name" not in frames:
        return [str(frame) for frame in np.asarray(frames["frame"])]
    names = [str(name).removesuffix(".txt") for name in np.asarray(frames["name"])]
    if "sequence" not in frames:
        return names
    pairs = zip(np.asarray(frames["sequence"]), names, strict=True)
    return [name if "/" in name else f"{number}/{name}" for number, name in pairs]


def ids_by_name(frames: AnyColumns) -> dict[str, int]:
    """Returns the id of every frame by its key and by "sequence/radar", see `frame_key`.

    Examples:
        >>> ids_by_name({"frame": [7], "name": ["5/00012_00001"]})
        {'5/00012_00001': 7, '5/00012': 7}
    """
    ids = np.asarray(frames["frame"]).tolist()
    by_key = dict(zip(map(frame_key, frame_keys(frames)), ids, strict=True))
    by_radar = {key.rpartition("_")[0]: i for key, i in by_key.items()}
    return by_key | by_radar | by_key  # keys come first and take precedence


def with_ids(
    table: Columns, frames: AnyColumns | None, where: str, *, skip: bool = False
) -> Columns:
    """Replaces the frame names of a table (keys or "sequence/radar") by frame ids.

    Args:
        table: Table with a column frame. Integer ids are not changed.
        frames: Frame table in which names are looked up.
        where: Name of the table in errors.
        skip: Whether to skip rows of frames that are not in the frame table, unless all
            rows would be skipped.

    Raises:
        DataError: A frame name is not in the frame table.

    Examples:
        >>> frames = {"frame": np.array([7]), "name": np.array(["5/00012_00001"])}
        >>> table = {"frame": np.array(["5/00012"])}
        >>> with_ids(table, frames, "boxes.json")["frame"].tolist()
        [7]
    """
    named = np.asarray(table["frame"])
    if named.dtype.kind in "iu" or not named.size:
        return {**table, "frame": named.astype(np.int64)}
    names = [frame_key(str(name)) for name in named]
    known = {} if frames is None else ids_by_name(frames)
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
