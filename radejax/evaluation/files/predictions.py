"""Predictions and ground truth in files: NPZ, JSON and CSV, read and written.

Every format holds the columns frame, cls, x, y, z, l, w, h, yaw and, for predictions,
score. A frame is named by its id in the frame table (an integer) or by its key
"sequence/name", such as "1/00033_00001" (K-Radar's label file, with or without .txt).
"""

from __future__ import annotations

import csv
import io
import json
import pathlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from radejax.core import files, schema
from radejax.core.archives import read_npz
from radejax.core.errors import DataError, UserError
from radejax.core.structures import BOX_FIELDS
from radejax.evaluation.columns import AnyColumns, Columns, read_name, wanted_columns

_SCORED = wanted_columns(scored=True)


def frame_keys(frames: Columns) -> list[str]:
    """Key "sequence/name" of every frame; the id where these are not known."""
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
    """Ids by key, and by the half of it that a radar file tells: "sequence/radar"."""
    ids = np.asarray(frames["frame"]).tolist()
    keys = dict(zip(frame_keys(frames), ids, strict=True))
    return {key.rpartition("_")[0]: frame for key, frame in keys.items()} | keys


def _strip(name: str) -> str:
    return name.removesuffix(".txt")


def read_table(
    path: str | pathlib.Path, frames: Columns | None = None, *, scored: bool = True
) -> Columns:
    """Reads predictions (or, not `scored`, ground truth) from .npz, .json or .csv.

    Args:
        path: The file; or the folder of `radejax detect`, a .json a frame, of which
            frames that the table does not have are left.
        frames: Frame table to look frames up in; None leaves integer ids as they are.
        scored: Whether a score is expected.

    Returns:
        Columns frame, box, cls and score, as `average_precision.evaluate` takes them.

    Raises:
        FileNotFoundError: Names the file.
        UserError: An unknown kind of file.
        DataError: Missing columns, a value that is no number, an unknown frame; the
            message names the file and the row.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        columns = _read_folder(path)
        if frames is not None:
            columns = of_known_frames(columns, frames)
        return _checked(columns, frames, path, _SCORED)
    if not path.is_file():
        raise FileNotFoundError(2, "no such file", str(path))
    readers = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
    if path.suffix not in readers:
        raise UserError(
            f"{path}: cannot read '{path.suffix}'; known: {', '.join(readers)}"
            " and folders in KITTI's layout"
        )
    columns = readers[path.suffix](path)
    return _checked(columns, frames, path, wanted_columns(scored))


def _checked(
    columns: Columns, frames: Columns | None, path: pathlib.Path, wanted: Sequence[str]
) -> Columns:
    """The wanted columns, frames by id."""
    missing = [name for name in wanted if name not in columns]
    if missing:
        raise DataError(f"{path}: lacks {missing}; found {sorted(columns)}")
    table = {name: columns[name] for name in wanted}
    if table["frame"].size == 0:  # an empty list has neither type nor width
        table.update(cls=np.zeros(0, str), box=np.zeros((0, 7)))
    table["frame"] = find_frames(columns["frame"], frames, where=str(path))
    return table


def find_frames(
    named: np.ndarray | Sequence[Any], frames: Columns | None, *, where: str
) -> np.ndarray:
    """Ids of frames that are named by id, key or "sequence/radar", half of a key.

    Raises:
        DataError: A frame that the table does not have, or names without a table.
    """
    named = np.asarray(named)
    if named.size == 0:
        return np.zeros(0, np.int64)
    if named.dtype.kind in "iu":
        return named.astype(np.int64)
    # Rows of a frame are neighbours, and a million of them are looked up once a frame.
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
                    f"{where}: row {row}: no frame {name!r} among the {count} frames"
                    f" that are evaluated (such as {such!r})"
                )
        found = [known[name] for name in text]
    return np.repeat(np.array(found, np.int64), np.diff(first, append=named.size))


def _read_folder(folder: pathlib.Path) -> Columns:
    """All files of `radejax detect`."""
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise UserError(f"{folder} has no predictions: no .json files")
    tables = [table for table in map(_read_json, paths) if table["frame"].size]
    if lacking := [name for table in tables for name in _SCORED if name not in table]:
        raise DataError(f"{folder}: lacks {lacking[0]!r}")
    none = np.zeros(0)
    return {
        name: np.concatenate([table[name] for table in tables]) if tables else none
        for name in _SCORED
    }


def of_known_frames(columns: Columns, frames: Columns) -> Columns:
    """Rows of frames that the table has; all if there is none, for `find_frames`."""
    known = _known_frames(frames)
    is_known = [_strip(str(name)) in known for name in columns["frame"].tolist()]
    if not any(is_known):
        return columns
    return {name: column[np.array(is_known)] for name, column in columns.items()}


def _read_npz(path: pathlib.Path) -> Columns:
    columns = read_npz(path)
    if "class_names" in columns and columns.get("cls", np.zeros(0)).dtype.kind in "iu":
        columns["cls"] = columns["class_names"][columns["cls"]]
    return columns


def _read_json(path: pathlib.Path) -> Columns:
    content = files.read_json(path)
    if isinstance(content, dict) and isinstance(content.get("frame"), list):
        columns = content
    else:
        columns = _columns_of_records(_records(content, path), path)
    columns = schema.check(columns, _JSON, str(path))
    names = [name.removesuffix("?") for name in _JSON]
    return {name: np.asarray(columns[name]) for name in names if name in columns}


_JSON = {
    "frame?": list[int] | list[str],
    "cls?": list[str],
    "box?": list[tuple[float, float, float, float, float, float, float]],
    "score?": list[float],
}
"""Columns; which of them must be there `read_table` knows."""


def _records(content: Any, path: pathlib.Path) -> Iterator[dict]:
    """Flat records of a list of records or of a mapping frame -> list of records."""
    is_by_frame = isinstance(content, dict)
    for frame, listed in content.items() if is_by_frame else [(None, content)]:
        if not isinstance(listed, list) or any(
            not isinstance(item, dict) for item in listed
        ):
            where = f"{path}: frame {frame!r}" if is_by_frame else str(path)
            raise DataError(
                f"{where}: expected a list of objects with frame, cls, box and score"
            )
        yield from ({"frame": frame, **r} if is_by_frame else r for r in listed)


def _columns_of_records(records: Iterator[dict], path: pathlib.Path) -> dict[str, list]:
    columns: dict[str, list] = {"frame": [], "cls": [], "box": [], "score": []}
    for row, record in enumerate(records):
        box = record.get("box", [record.get(name) for name in BOX_FIELDS])
        if not isinstance(box, list) or len(box) != 7 or None in box:
            raise DataError(
                f"{path}: row {row}, frame {record.get('frame')}: box is {box}, expected"
                f" 7 numbers {', '.join(BOX_FIELDS)}"
            )
        for name in ("frame", "cls"):
            if name not in record:
                raise DataError(f"{path}: row {row}: lacks {name!r}")
            columns[name].append(read_name(record[name], f"{path}: row {row}"))
        columns["box"].append(box)
        columns["score"].append(record.get("score"))
    lacking = [row for row, score in enumerate(columns["score"]) if score is None]
    if lacking and len(lacking) < len(columns["score"]):
        raise DataError(f"{path}: row {lacking[0]}: lacks 'score'")
    if lacking:
        del columns["score"]
    return columns


def _read_csv(path: pathlib.Path) -> Columns:
    reader = csv.DictReader(
        io.StringIO(files.read_text(path), newline=""), skipinitialspace=True
    )
    frame, cls, values = [], [], []
    try:
        header = reader.fieldnames or []
        missing = [n for n in ("frame", "cls", *BOX_FIELDS) if n not in header]
        if missing:
            raise DataError(
                f"{path}: line 1: lacks columns {missing}; found {str(header)[:200]}"
            )
        numbers = [n for n in (*BOX_FIELDS, "score") if n in header]
        for line in reader:
            where = f"{path}: line {reader.line_num}"
            frame.append(read_name(line["frame"], where))
            cls.append(read_name(line["cls"], where))
            values.append([_number(line[n], n, path, reader.line_num) for n in numbers])
    except csv.Error as error:
        raise DataError(f"{path}: line {reader.line_num}: {error}") from None
    table = np.array(values, np.float64).reshape(-1, len(numbers))
    columns = {"frame": np.array(frame), "cls": np.array(cls, str), "box": table[:, :7]}
    if "score" in numbers:
        columns["score"] = table[:, 7]
    return columns


def _number(text: str | None, name: str, path: pathlib.Path, line: int) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise DataError(
            f"{path}: line {line}: {name} is {text!r:.80}, expected a number"
        ) from None


def write_table(
    path: str | pathlib.Path, table: AnyColumns, frames: Columns | None = None
) -> None:
    """Writes columns as .npz, .json or .csv; `read_table` gives the same back.

    Args:
        path: The file; its suffix chooses the format. Written whole or not at all.
        table: Columns frame, box, cls and, for predictions, score.
        frames: Frame table; with it frames are written by key, which survives another
            selection or order of frames, and without it by id.
    """
    path = pathlib.Path(path)
    frame = np.asarray(table["frame"], np.int64)
    if frames is not None:
        ids = np.asarray(frames["frame"]).tolist()
        keys = dict(zip(ids, frame_keys(frames), strict=True))
        frame = np.array([keys[i] for i in frame.tolist()], dtype=str)
    columns = {
        "frame": frame,
        "cls": np.asarray(table["cls"], dtype=str),
        "box": np.asarray(table["box"], np.float64).reshape(-1, 7),
    }
    if "score" in table:
        columns["score"] = np.asarray(table["score"], np.float64)
    if path.suffix == ".npz":
        with files.atomic_path(path) as temporary, open(temporary, "wb") as file:
            # NumPy would have `allow_pickle`, which none is named, a bool.
            np.savez_compressed(file, **columns)  # type: ignore[arg-type]
    elif path.suffix == ".json":
        files.write_text(path, json.dumps({k: v.tolist() for k, v in columns.items()}))
    elif path.suffix == ".csv":
        files.write_text(path, _csv_text(columns))
    else:
        raise UserError(f"{path}: cannot write '{path.suffix}'; known: .npz .json .csv")


def _csv_text(columns: Columns) -> str:
    flat = {**columns, **dict(zip(BOX_FIELDS, columns["box"].T, strict=True))}
    names = [name for name in ("frame", "cls", *BOX_FIELDS, "score") if name in flat]
    rows = zip(*(flat[name].tolist() for name in names), strict=True)
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([names, *rows])
    return buffer.getvalue()
