"""Ground truth, predictions and frames, from wherever they lie, as columns."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from radejax.core import files, schema
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.data.kradar import KRadar
from radejax.data.kradar.folders import are_simulated
from radejax.evaluation.columns import Columns
from radejax.evaluation.files import kitti, predictions


@dataclasses.dataclass(frozen=True)
class Source:
    """Where ground truth and frames come from.

    Attributes:
        data: Root folders of K-Radar, or none.
        labels: Folder or zip of a label revision.
        label_version: v1.0, v1.1, v2.0 or v2.1.
        split: "train", "test", a split file, or None for every frame.
        ground_truth: File of ground truth instead, or the folder of a report or a run.
        frames: JSON file of the frame table (columns) for `ground_truth`; by default the
            `frames.json` beside it.
        sequences: Only frames of these; all if empty.
        weather: Likewise.
        z_offset_m: Added to the z of predictions.
        yaw_degrees: Yaws of predictions are degrees.
    """

    data: tuple[str, ...] = ()
    labels: str | None = None
    label_version: str = "v2.1"
    split: str | None = "test"
    ground_truth: str | None = None
    frames: str | None = None
    sequences: tuple[int, ...] = ()
    weather: tuple[str, ...] = ()
    z_offset_m: float = 0.0
    yaw_degrees: bool = False

    def corrected(self, found: Columns) -> Columns:
        """Predictions in metres and radians of the radar frame."""
        box = np.array(found["box"], np.float64).reshape(-1, 7)
        box[:, 2] += self.z_offset_m
        if self.yaw_degrees:
            box[:, 6] = np.deg2rad(box[:, 6])
        return {**found, "box": box}


def load(
    path: PathLike, source: Source, classes: Sequence[str]
) -> tuple[Columns, Columns, Columns, dict[str, int]]:
    """Ground truth, predictions, frame table and counts of what loading left out.

    Args:
        path: Predictions: a .npz, .json or .csv file, the folder of `radejax detect`, one
            in KITTI's layout, or that of an earlier report.
        source: Ground truth; a KITTI folder and a report bring their own.
        classes: Classes to load from labels.

    Raises:
        UserError: No ground truth anywhere, or no frame of the part that is asked for.
        FileNotFoundError: Names what is missing.
        DataError: Malformed content.
    """
    truth, found, frames, left_out = _load(pathlib.Path(path), source, classes)
    found = source.corrected(found)
    for column, wanted in (("sequence", source.sequences), ("weather", source.weather)):
        if not wanted:
            continue
        if column not in frames:
            raise UserError(
                f"the frames do not say their {column}: give --data or --labels"
            )
        values = np.asarray(frames[column]).astype(str)
        chosen = np.isin(values, [str(value) for value in wanted])
        if not chosen.any():
            raise UserError(
                f"no frames of {column} {', '.join(map(str, wanted))}; there are "
                f"{', '.join(np.unique(values))}"
            )
        frames = {name: np.asarray(v)[chosen] for name, v in frames.items()}
        truth, found = (_of_frames(table, frames["frame"]) for table in (truth, found))
    return truth, found, frames, left_out


def _of_frames(table: Columns, ids: np.ndarray) -> Columns:
    rows = np.isin(table["frame"], ids)
    return {name: np.asarray(column)[rows] for name, column in table.items()}


def _load(
    path: pathlib.Path, source: Source, classes: Sequence[str]
) -> tuple[Columns, Columns, Columns, dict[str, int]]:
    """As `load`, of all frames."""
    frames: Columns | None = None
    left_out: dict[str, int] = {}
    if (path / "predictions.npz").is_file():
        frames = _frames_of_report(path)
        truth = predictions.read_table(path / "ground_truth.npz", frames, scored=False)
        found = predictions.read_table(path / "predictions.npz", frames)
        return truth, found, frames, left_out
    is_boxes = any(path.glob("*.json")) and not (path / "preds").is_dir()
    if source.ground_truth:
        truth, frames = _ground_truth(source.ground_truth, source.frames)
    elif source.data or source.labels:
        data = KRadar(
            list(source.data) or None,
            source.labels,
            version=source.label_version,
            split=source.split,
            classes=classes,
        )
        truth, frames = tables_from_frames(data, source.split or "all")
        left_out = {f"labels: {what}": int(n) for what, n in data.counts.items()}
    elif path.is_dir() and not is_boxes:
        return (*kitti.read_kitti(path), left_out)
    else:
        raise UserError(
            f"{path} holds predictions only: say where the ground truth is, with --data,"
            " --labels or --ground_truth"
        )
    if path.is_dir() and not is_boxes:
        found = kitti.read_kitti(path)[1]
        if frames is not None and (path / "frames.json").is_file():
            found = _of_detect(path, found, frames)
    else:
        found = predictions.read_table(path, frames)
    if frames is None:
        frames = {"frame": np.union1d(truth["frame"], found["frame"])}
    return truth, found, frames, left_out


def _ground_truth(
    path: PathLike, table: PathLike | None
) -> tuple[Columns, Columns | None]:
    """Of a file, a report or a run, with the frame table that is named or beside it."""
    path = pathlib.Path(path)
    of_report = (path / "ground_truth.npz", path / "evaluation" / "ground_truth.npz")
    path = next((place for place in of_report if place.is_file()), path)
    frames = None
    if table:
        frames = _read_frames(table)
    elif path.with_name("frames.json").is_file():
        frames = _frames_of_report(path.parent)
    return predictions.read_table(path, frames, scored=False), frames


def stored_from(path: PathLike) -> float:
    """Score from which on predictions were stored, as the report of a run says; or 0.

    Runs of before `evaluation.min_score` stored what their score cut left.
    """
    path = pathlib.Path(path)
    if not (path / "source.json").is_file() or not (path / "metrics.json").is_file():
        return 0.0
    options = files.read_json(path / "metrics.json")["options"]
    return float(options.get("min_score", options["score_threshold"]))


def _read_frames(path: PathLike) -> Columns:
    """A frame table written by `report.write_report`."""
    column = list[int] | list[str] | list[bool] | list[float]
    columns = files.read_json(path, dict[str, column])
    hint = {"frame": list[int], "name?": list[str], "sequence?": list[int]}
    columns = schema.check(columns, hint, str(path))
    for name, values in columns.items():
        if len(values) != len(columns["frame"]):
            raise DataError(
                f"{path}: column {name!r} has {len(values)} entries for "
                f"{len(columns['frame'])} frames"
            )
    return {name: np.asarray(values) for name, values in columns.items()}


def _of_detect(folder: pathlib.Path, found: Columns, frames: Columns) -> Columns:
    """KITTI's files of `radejax detect`, whose list says which frame has which number."""
    names = _read_frames(folder / "frames.json")["name"]
    named = predictions.of_known_frames(
        {**found, "frame": names[found["frame"]]}, frames
    )
    ids = predictions.find_frames(named["frame"], frames, where=str(folder))
    return {**named, "frame": ids}


def _frames_of_report(path: pathlib.Path) -> Columns:
    """A report's frame table; in older ones `source.json` names the data instead."""
    frames = dict(_read_frames(path / "frames.json"))
    source = path / "source.json"
    if "simulated" not in frames and source.is_file():
        roots = map(
            pathlib.Path, files.read_json(source, {"roots": list[str]})["roots"]
        )
        frames["simulated"] = np.full(frames["frame"].size, are_simulated([*roots]))
    return frames


def tables_from_frames(
    frames: Iterable[Any], split: str | None = None
) -> tuple[Columns, Columns]:
    """Ground truth and frame table of a data set such as `radejax.data.kradar.dataset.KRadar`.

    Args:
        frames: Objects with sequence, name, weather, environment, time, is_simulated,
            boxes `[N, 7]` (radar frame) and classes `[N]` (names).
        split: Of the data set, for the frame table: "train", "test", "all" or a split
            file; None where it is not known.

    Returns:
        Ground-truth columns and frame columns; the frame id is the position.
    """
    frames = list(frames)
    counts = [len(frame.boxes) for frame in frames]
    box = [np.asarray(frame.boxes, np.float64).reshape(-1, 7) for frame in frames]
    cls = [str(name) for frame in frames for name in frame.classes]
    ground_truth = {
        "frame": np.repeat(np.arange(len(frames)), counts),
        "box": np.concatenate(box) if box else np.zeros((0, 7)),
        "cls": np.array(cls, dtype=str),
    }
    table = {"frame": np.arange(len(frames))}
    for column in ("sequence", "name", "weather", "environment", "time"):
        table[column] = np.array([getattr(frame, column) for frame in frames])
    table["simulated"] = np.array([frame.is_simulated for frame in frames], bool)
    if split is not None:
        table["split"] = np.full(len(frames), str(split))
    return ground_truth, table
