"""KITTI text folders as K-Radar's tools write and read them.

    <folder>/<score cut>/<condition>/{preds,gts,desc}/000012.txt and val.txt

with condition "all" or a tag of the frame (weather, environment, time). The number of a
file is the frame's position in the data set; `core.kitti_text` shows its lines. Frames
without ground truth are not written. K-Radar's evaluator then compares every box with l
and w exchanged (its issue 81): that is the reader's doing, the numbers in the files are
the plain ones.

References:
    K-Radar, pipelines/pipeline_detection_v1_0.py and utils/util_pipeline.py.
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterable, Mapping

import numpy as np

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.kitti_text import CLASS_KEYS, DUMMY, object_lines
from radejax.evaluation.files.predictions import Columns

CLASS_NAMES = {key: name for name, key in CLASS_KEYS.items()}


def write_kitti(
    folder: str | pathlib.Path,
    ground_truth: Mapping[str, np.ndarray],
    predictions: Mapping[str, np.ndarray],
    frames: Mapping[str, np.ndarray],
    *,
    score_threshold: float = 0.0,
    conditions: Iterable[str] = ("weather", "environment", "time"),
) -> int:
    """Writes folders that K-Radar's official evaluation script reads.

    Args:
        folder: Where; a folder named after the score cut is made in it.
        ground_truth: Columns as in `average_precision.evaluate`, already reduced to the
            classes, region and field of view that shall count.
        predictions: The same with scores.
        frames: Frame table; the position of a frame is the number of its file.
        score_threshold: Only predictions above it are written.
        conditions: Columns of the frame table whose values get folders beside "all".

    Returns:
        Number of frames written; those without ground truth are left out, as K-Radar's
        tools do.

    Raises:
        UserError: A class K-Radar has no key for.
    """
    root = pathlib.Path(folder) / f"{float(score_threshold)}"
    score = np.asarray(predictions["score"], np.float64)
    above = np.flatnonzero(score > score_threshold)
    truth = object_lines(ground_truth, np.arange(len(ground_truth["cls"])), None)
    found = object_lines(predictions, above, score)
    kinds = [kind for kind in conditions if kind in frames]
    ids = np.asarray(frames["frame"]).tolist()
    listed: dict[pathlib.Path, list[str]] = {root / "all": []}
    for position, frame in enumerate(ids):
        if frame not in truth:
            continue
        tags = {kind: str(np.asarray(frames[kind])[position]) for kind in kinds}
        description = "\n".join(
            tags.get(kind, "unknown") for kind in ("time", "environment", "weather")
        )
        for part in ("all", *tags.values()):
            name = f"{position:06d}.txt"
            listed.setdefault(root / part, []).append(f"{position:06d}")
            for kind, lines in (
                ("gts", truth[frame]),
                ("preds", found.get(frame, [DUMMY])),
            ):
                _write(root / part / kind / name, "\n".join(lines) + "\n")
            _write(root / part / "desc" / name, description)
    for part, names in listed.items():
        part.mkdir(parents=True, exist_ok=True)
        files.write_text(part / "val.txt", "".join(f"{name}\n" for name in names))
    return len(listed[root / "all"])


def _write(path: pathlib.Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def read_kitti(
    folder: str | pathlib.Path, *, condition: str = "all"
) -> tuple[Columns, Columns, Columns]:
    """Reads ground truth, predictions and frame table from a folder of K-Radar's tools.

    Args:
        folder: A folder with `preds` (or `pred`) and perhaps `gts` (or `gt`) and `desc`,
            or the folder of a score cut around it, or the one around that if it holds a
            single score cut.
        condition: Which condition's folder to read.

    Returns:
        Ground truth, predictions and frame table. The frame id is the number of the file;
        the frame table has weather, environment and time where `desc` tells them.

    Raises:
        FileNotFoundError: No such folder.
        UserError: Nothing to read in it, or several score cuts.
        DataError: A malformed line; names the file and the line.
    """
    root = _find_root(pathlib.Path(folder), condition)
    preds, gts = _part(root, "preds", "pred"), _part(root, "gts", "gt")
    found = _read_folder(preds, scored=True)
    truth = _read_folder(gts, scored=False) if gts else {}
    numbers = sorted({*truth, *found})
    return (
        _columns(truth, scored=False),
        _columns(found, scored=True),
        _frame_table(numbers, _part(root, "desc")),
    )


def is_kitti(path: str | pathlib.Path) -> bool:
    """Whether a path is a folder that `read_kitti` should try."""
    return pathlib.Path(path).is_dir()


def _find_root(folder: pathlib.Path, condition: str) -> pathlib.Path:
    if not folder.is_dir():
        raise FileNotFoundError(2, "no such folder", str(folder))
    for root in (folder, folder / condition):
        if _part(root, "preds", "pred"):
            return root
    cuts = [
        p for p in sorted(folder.iterdir()) if _part(p / condition, "preds", "pred")
    ]
    if len(cuts) == 1:
        return cuts[0] / condition
    if cuts:
        names = ", ".join(p.name for p in cuts)
        raise UserError(
            f"{folder} holds several score cuts ({names}): name one of them"
        )
    raise UserError(
        f"{folder} has no folder 'preds' of predictions, neither itself nor in"
        f" '{condition}'"
    )


def _part(root: pathlib.Path, *names: str) -> pathlib.Path | None:
    return next((root / name for name in names if (root / name).is_dir()), None)


def _read_folder(folder: pathlib.Path, *, scored: bool) -> dict[int, list[tuple]]:
    """(class, box, score) of every line by frame number."""
    content = {}
    for path in sorted(folder.glob("*.txt")):
        if not path.stem.isdigit():
            raise DataError(
                f"{path}: expected a file named by its number, as 000012.txt"
            )
        text = path.read_text(encoding="utf-8")
        content[int(path.stem)] = [
            row
            for number, line in enumerate(text.splitlines(), 1)
            if (row := _read_line(line, scored, f"{path}: line {number}"))
        ]
    return content


def _read_line(line: str, scored: bool, where: str) -> tuple | None:
    fields = line.split()
    if not fields or fields[0] == "dummy":
        return None
    expected = 16 if scored else 15
    if len(fields) != expected:
        raise DataError(f"{where}: {len(fields)} fields, expected {expected}")
    name = CLASS_NAMES.get(fields[0], fields[0])
    try:
        height, width, length, y, z, x, yaw = (float(f) for f in fields[8:15])
        score = float(fields[15]) if scored else 0.0
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None
    return name, (x, y, z, length, width, height, yaw), score


def _columns(content: Mapping[int, list[tuple]], *, scored: bool) -> Columns:
    rows = [(frame, *row) for frame, listed in content.items() for row in listed]
    columns = {
        "frame": np.array([row[0] for row in rows], np.int64),
        "cls": np.array([row[1] for row in rows], dtype=str),
        "box": np.array([row[2] for row in rows], np.float64).reshape(-1, 7),
    }
    if scored:
        columns["score"] = np.array([row[3] for row in rows], np.float64)
    return columns


def _frame_table(numbers: list[int], desc: pathlib.Path | None) -> Columns:
    table: Columns = {"frame": np.array(numbers, np.int64)}
    if desc is None:
        return table
    tags = []
    for number in numbers:
        path = desc / f"{number:06d}.txt"
        lines = path.read_text(encoding="utf-8").split() if path.is_file() else []
        tags.append(lines if len(lines) == 3 else ["unknown"] * 3)
    for index, kind in enumerate(("time", "environment", "weather")):
        table[kind] = np.array([tag[index] for tag in tags], dtype=str)
    return table
