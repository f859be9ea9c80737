"""Folders of KITTI text files in the layout of K-Radar's tools.

    <folder>/<score threshold>/<condition>/{preds,gts,desc}/000012.txt and val.txt

The condition is "all" or a tag of the frame (weather, environment, time). The number of a
file is the frame's position in the dataset. A line is

    sed 0.00 0 0 50 50 150 150 h w l y z x yaw          (ground truth, 2 decimals)
    sed -1 -1 0 50 50 150 150 h w l y z x yaw score     (prediction)

and a frame without predictions has one line "dummy". Frames without ground truth are not
written. The files contain length and width unchanged; it is the reader of K-Radar's
evaluator that swaps them for every box (its issue 81).

References:
    K-Radar, pipelines/pipeline_detection_v1_0.py and utils/util_pipeline.py.
"""

from __future__ import annotations

import pathlib
import re

import numpy as np

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.core.structures import Boxes
from radejax.evaluation import boxes
from radejax.evaluation.boxes import AnyBoxes, AnyColumns, Columns

KEYS = ("sed", "bus", "ped", "mot", "bic", "peg", "big")
CLASS_KEYS = dict(zip(boxes.KNOWN_CLASSES, KEYS, strict=True))
CLASS_NAMES = {key: name for name, key in CLASS_KEYS.items()}
GT_HEADER = "0.00 0 0 50 50 150 150"
PRED_HEADER = "-1 -1 0 50 50 150 150"
DUMMY = "dummy -1 -1 0 0 0 0 0 0 0 0 0 0 0 0 0"
DESCRIPTION = ("time", "environment", "weather")
"""Columns of the frame table that the lines of a file in `desc` hold, in order."""

BOX_ORDER = [5, 4, 3, 1, 2, 0, 6]  # from x y z l w h yaw to h w l y z x yaw


def write_kitti(
    folder: PathLike,
    ground_truth: AnyBoxes,
    predictions: AnyBoxes,
    frames: AnyColumns,
    *,
    score_threshold: float = 0.0,
) -> int:
    """Writes folders that K-Radar's official evaluation script reads.

    Every weather, environment and time of the frame table gets a folder next to "all".

    Args:
        folder: Output folder; a folder named after the score threshold is created in it.
        ground_truth: Columns as for `evaluation.evaluate`, or with frame keys as in the
            files of a report. They must only contain objects of the classes, region and
            field of view to evaluate.
        predictions: Columns of the predictions in the same form, with scores.
        frames: Frame table. The position of a frame is the number of its file.
        score_threshold: Score threshold; only predictions above it are written.

    Returns:
        The number of frames written. Frames without ground truth are skipped, as in
        K-Radar's tools.

    Raises:
        UserError: K-Radar has no key for one of the classes, or no frame has ground truth.
        DataError: A frame is not in the frame table.
    """
    ids = boxes.frame_ids(frames)

    def lines(table: AnyBoxes, name: str, *, scored: bool) -> dict[int, list[str]]:
        columns = boxes.with_ids(boxes.columns_of_boxes(table), frames, name)
        position = boxes.frame_positions(columns["frame"], ids, name)
        columns = {**columns, "frame": position}
        if scored:
            columns = boxes.take(columns, columns["score"] > score_threshold)
        return _lines(columns, scored=scored)

    truth = lines(ground_truth, "ground truth", scored=False)
    found = lines(predictions, "predictions", scored=True)
    if not truth:
        raise UserError("no frame has ground truth: K-Radar's tools write none of them")
    root = files.as_path(folder) / f"{float(score_threshold)}"
    kinds = [kind for kind in DESCRIPTION if kind in frames]
    listed: dict[pathlib.Path, list[str]] = {}
    for position in sorted(truth):
        tags = {kind: str(np.asarray(frames[kind])[position]) for kind in kinds}
        texts = {
            "gts": "\n".join(truth[position]) + "\n",
            "preds": "\n".join(found.get(position, [DUMMY])) + "\n",
            "desc": "\n".join(tags.get(kind, "unknown") for kind in DESCRIPTION),
        }
        for tag in {"all", *tags.values()}:  # tags may be equal, such as "unknown"
            listed.setdefault(root / tag, []).append(f"{position:06d}")
            for kind, text in texts.items():
                path = root / tag / kind / f"{position:06d}.txt"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    for part, names in listed.items():
        files.write_text(part / "val.txt", "".join(f"{name}\n" for name in names))
    return len(truth)


def prediction_text(boxes: Boxes, frame: int) -> str:
    """Formats the predictions of a frame as a text in the format of K-Radar's tools.

    It has no final newline. A frame without detections has the line "dummy".

    Args:
        boxes: Predictions, as `Detections.to_boxes` returns them.
        frame: Index of the frame to format.

    Raises:
        UserError: K-Radar has no key for one of the classes.
    """
    found = _lines(boxes.columns(), scored=True)
    return "\n".join(found.get(frame, [DUMMY]))


def _lines(table: Columns, *, scored: bool) -> dict[int, list[str]]:
    """Returns the lines of ground truth or predictions by frame."""
    header = PRED_HEADER if scored else GT_HEADER
    box = np.asarray(table["box"], np.float64).reshape(-1, 7)
    numbers = (box if scored else np.round(box, 2))[:, BOX_ORDER]
    if scored:
        numbers = np.column_stack([numbers, np.asarray(table["score"], np.float64)])
    frames, names = (np.asarray(table[column]).tolist() for column in ("frame", "cls"))
    lines: dict[int, list[str]] = {}
    for frame, cls, row in zip(frames, names, numbers.tolist(), strict=True):
        if cls not in CLASS_KEYS:
            raise UserError(
                f"K-Radar's tools have no key for class {cls!r} (frame {frame}); known: "
                f"{', '.join(CLASS_KEYS)}"
            )
        words = [CLASS_KEYS[cls], header, *map(repr, row)]
        lines.setdefault(frame, []).append(" ".join(words))
    return lines


def read_kitti(folder: PathLike) -> tuple[Boxes, Boxes, Columns]:
    """Reads ground truth, predictions and frame table from a folder of K-Radar's tools.

    Args:
        folder: Folder with `preds` and optionally `gts` and `desc`; or the folder of a
            score threshold, of which the condition "all" is read; or the parent folder of
            a single score threshold.

    Returns:
        Ground truth, predictions and frame table. The frame id is the number of the file.
        The frame table has weather, environment and time if there is a folder `desc`.

    Raises:
        UserError: The folder `preds` is missing, or there are several score thresholds.
        DataError: A line is malformed; the message names the file and the line.
    """
    root = find_root(files.as_path(folder))
    numbers, found = _read_folder(root / "preds", scored=True)
    others, truth = _read_folder(root / "gts", scored=False)
    frames = _frame_table(sorted({*numbers, *others}), root / "desc")
    return truth, found, frames


def find_root(folder: pathlib.Path) -> pathlib.Path:
    """Returns the folder with `preds` that `read_kitti` reads; see there for errors."""
    for pattern in ("preds", "all/preds", "*/all/preds"):
        found = sorted(folder.glob(pattern))
        if len(found) > 1:
            names = ", ".join(path.parts[-3] for path in found)
            raise UserError(
                f"{folder} holds several score thresholds ({names}): name one of them"
            )
        if found:
            return found[0].parent
    raise UserError(
        f"{folder} has no folder 'preds' of predictions, neither itself nor in 'all'"
    )


def _read_folder(folder: pathlib.Path, *, scored: bool) -> tuple[list[int], Boxes]:
    """Reads the numbers of the files in a folder, which may be missing, and their boxes."""
    numbers = []
    rows = []
    for path in sorted(folder.glob("*.txt")):
        if not re.fullmatch("[0-9]{1,9}", path.stem):
            raise DataError(
                f"{path}: expected a file named by its number, as 000012.txt"
            )
        numbers.append(int(path.stem))
        for number, line in enumerate(files.read_text(path).splitlines(), 1):
            if row := _read_line(line, scored, f"{path}: line {number}"):
                rows.append((numbers[-1], *row))
    table = boxes.columns_of(rows)
    return numbers, boxes.read_boxes(table, str(folder), scored=scored)


def _read_line(
    line: str, scored: bool, where: str
) -> tuple[str, tuple[float, ...], float] | None:
    fields = line.split()
    if not fields or fields[0] == "dummy":
        return None
    expected = 16 if scored else 15
    if len(fields) != expected:
        raise DataError(f"{where}: {len(fields)} fields, expected {expected}")
    if fields[0] not in CLASS_NAMES:
        known = ", ".join(CLASS_NAMES)
        raise DataError(f"{where}: unknown class {fields[0]!r:.80}; known: {known}")
    try:
        height, width, length, y, z, x, yaw = (float(f) for f in fields[8:15])
        score = float(fields[15]) if scored else 0.0
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None
    box = (x, y, z, length, width, height, yaw)
    return CLASS_NAMES[fields[0]], box, score


def _frame_table(numbers: list[int], desc: pathlib.Path) -> Columns:
    ids = {"frame": np.array(numbers, np.int64)}
    if not desc.is_dir():
        return ids
    tags = []
    for number in numbers:
        path = desc / f"{number:06d}.txt"
        words = files.read_text(path).split() if path.is_file() else []
        tags.append(words if len(words) == 3 else ["unknown"] * 3)
    columns = np.array(tags, dtype=str).reshape(-1, 3).T
    return ids | dict(zip(DESCRIPTION, columns, strict=True))
