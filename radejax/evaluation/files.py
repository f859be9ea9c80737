"""Evaluation of ground truth, predictions and frames from files (`radejax score`).

Supported formats are .npz (written by reports), .json with a list of records (one file or
a folder of files, as written by `radejax detect`), and folders in K-Radar's KITTI layout
(`evaluation.kitti`). A table has the columns frame, cls, box and, for predictions, score.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from radejax.core import files
from radejax.core.archives import read_npz, wrap_read_errors
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import JsonObject, PathLike
from radejax.core.manifest import FILE, Manifest, read_checked
from radejax.core.options import Options, as_tuples
from radejax.core.structures import BOX_FIELDS, Boxes, frame_key
from radejax.data.kradar import KRadar
from radejax.evaluation import boxes
from radejax.evaluation.boxes import Columns, column_names, columns_of_boxes
from radejax.evaluation.kitti import find_root, read_kitti
from radejax.evaluation.report import Origin, Report, warn_of_replaced, write_report
from radejax.evaluation.results import ReportOptions

LOW_SCORE = 0.1
"""If the lowest stored score is above this and the score threshold, a warning is given."""

# Tables -------------------------------------------------------------------------------


def read_table(
    path: PathLike, frames: Columns | None = None, *, scored: bool = True
) -> Boxes:
    """Reads predictions or ground truth from a file or folder.

    Args:
        path: A .npz or .json file, a folder in KITTI's layout, or a folder of `radejax
            detect`. For folders, boxes of frames that are not in the frame table are
            ignored.
        frames: Frame table in which frame names are looked up, or None if the frames have
            integer ids.
        scored: Whether the file contains predictions with scores; otherwise it contains
            ground truth.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: The kind of file is unknown.
        DataError: A column is missing, a value is not a number, or a frame is unknown;
            the message names the file and the row. Or a folder of `radejax detect` is not
            complete.
    """
    return _read(path, frames, scored)[0]


def _read(
    path: PathLike, frames: Columns | None, scored: bool
) -> tuple[Boxes, dict[int | str, bool] | None]:
    """Reads a table, and for a folder which frames have a file.

    These are frame ids or keys, with False for those in which `radejax detect` failed.
    """
    path = files.as_path(path)
    there: dict[int | str, bool] | None = None
    columns: Columns
    if manifest := Manifest.open(path):
        pattern = "preds/*.txt" if _is_kitti(path) else "*.json"
        failed = manifest.check_whole(pattern, "detect again, or copy the whole folder")
        pairs = zip(manifest.options.get("frames", ()), manifest.names, strict=False)
        there = {key: name not in failed for key, name in pairs}
    if _is_kitti(path):
        columns = columns_of_boxes(read_kitti(path)[scored])
        texts = (find_root(path) / "preds").glob("*.txt")
        keys = np.array([int(text.stem) for text in texts], int)
        if frames is not None and (path / "frames.json").is_file():
            # The frame table that `radejax detect` writes maps file numbers to frames.
            names = _read_frames(path / "frames.json")["name"]
            with wrap_read_errors(
                path / "frames.json", "the names of all files in preds"
            ):
                keys = names[keys]
            columns = {**columns, "frame": names[columns["frame"]]}
        there = there or dict.fromkeys(keys.tolist(), True)
    elif path.is_dir():
        parts = sorted({*path.glob("*.json")} - {path / FILE})
        rows = [row for part in parts for row in _records(part, scored)]
        columns = boxes.columns_of(rows)
        there = there or {part.stem.replace("_", "/", 1): True for part in parts}
    elif path.suffix == ".json":
        columns = boxes.columns_of([*_records(path, scored)])
    elif path.suffix == ".npz":
        columns = read_npz(path)
        if missing := [x for x in column_names(scored) if x not in columns]:
            raise DataError(f"{path}: lacks {missing}; found {sorted(columns)}")
    else:
        raise UserError(
            f"{path} is neither a .npz or .json file nor a folder of `radejax detect` or in "
            "KITTI's layout"
        )
    # Own metrics and calibrated probabilities need further columns.
    shape = columns["frame"].shape
    columns = {
        name: x
        for name, x in columns.items()
        if name in column_names(scored)
        or (x.dtype.kind in "biuf" and x.shape[:1] == shape)
    }
    table = boxes.with_ids(columns, frames, str(path), skip=path.is_dir())
    return boxes.read_boxes(table, str(path), scored=scored), there


def _is_kitti(path: pathlib.Path) -> bool:
    """Returns whether a path is a folder in KITTI's layout, not one of .json files."""
    return path.is_dir() and ((path / "preds").is_dir() or not any(path.glob("*.json")))


def _records(
    path: pathlib.Path, scored: bool
) -> Iterator[tuple[int | str, str, list[float], float]]:
    """Yields the checked frame, class, box and score of every record of a file."""
    content = files.read_json(path)
    for row, record in enumerate(content if isinstance(content, list) else [content]):
        values: JsonObject = record if isinstance(record, dict) else {}
        frame = values.get("frame")
        cls = values.get("cls")
        box = values.get("box", [values.get(name) for name in BOX_FIELDS])
        score = values.get("score") if scored else 0.0
        numbers = [*box, score] if isinstance(box, list) else []
        is_good = (
            type(frame) in (int, str)
            and type(cls) is str
            # The width of a NumPy array of names is that of its longest name, so that one
            # long name could exhaust the memory.
            and max(len(str(frame)), len(cls)) <= 200
            and len(numbers) == 8
            and all(type(number) in (int, float) for number in numbers)
        )
        if not is_good:
            needed = ("frame", "cls", "score")[: 3 if scored else 2]
            lacking = [name for name in needed if name not in values]
            without = f" without {' and '.join(lacking)}" if lacking else ""
            raise DataError(
                f"{path}: row {row}{without} is {record!r:.300}, expected a list of records "
                f"with {', '.join(needed)} and numbers {', '.join(BOX_FIELDS)} (or as box)"
            )
        yield values["frame"], values["cls"], box, values["score"] if scored else 0.0


# Predictions with their ground truth --------------------------------------------------


class Source(Options, section="source"):
    """Source of the ground truth and frames, and corrections of the predictions.

    Attributes:
        data: Root folders of K-Radar, or none.
        labels: Folder or zip file of a label revision, or None.
        label_version: v1.0, v1.1, v2.0 or v2.1.
        split: "train", "test", a split file, or "all" for every frame.
        ground_truth: Ground-truth file to use instead of labels, or the folder of a
            report or a run. `frames.json` in the same folder is its frame table.
        sequences: Sequences of the frames to evaluate; all if empty.
        weather: Weathers of the frames to evaluate; all if empty.
        z_offset_m: Offset that is added to the z of predictions.
        yaw_degrees: Whether the yaws of predictions are in degrees.
    """

    data: tuple[str, ...] = ()
    labels: str | None = None
    label_version: str = "v2.1"
    split: str = "test"
    ground_truth: str | None = None
    sequences: tuple[int, ...] = ()
    weather: tuple[str, ...] = ()
    z_offset_m: float = 0.0
    yaw_degrees: bool = False


def load(
    path: PathLike, source: Source, classes: Sequence[str]
) -> tuple[Boxes, Boxes, Columns, dict[str, int]]:
    """Loads predictions and their ground truth.

    Args:
        path: Predictions: a .npz or .json file, a folder of `radejax detect`, a folder in
            KITTI's layout, or the folder of an earlier report.
        source: Source of the ground truth. A report contains its own; a KITTI folder may.
        classes: Classes to load from labels.

    Returns:
        Ground truth, predictions, frame table, and counts of what was read and skipped.

    Raises:
        UserError: There is no ground truth, no frame of the chosen sequences or
            weathers, or a class is neither K-Radar's nor in the ground truth.
        FileNotFoundError: A file or folder does not exist.
        DataError: A file has malformed content.
    """
    path = files.as_path(path)
    known = known_classes(path, source.ground_truth).union(boxes.KNOWN_CLASSES)
    if (path / "predictions.npz").is_file():
        source = source.replace(ground_truth=str(path / "ground_truth.npz"))
        path = path / "predictions.npz"
    truth, given, left_out = _load_ground_truth(path, source, classes)
    known |= set(truth.cls.tolist())
    expected = f"some of {', '.join(sorted(known))}"
    require(known.issuperset(classes), "classes", classes, expected)
    found, there = _read(path, given, scored=True)
    frames = given or {"frame": np.union1d(truth.frame, found.frame)}
    box = found.box.copy()
    box[:, 2] += source.z_offset_m
    if source.yaw_degrees:
        box[:, 6] = np.deg2rad(box[:, 6])
    found = dataclasses.replace(found, box=box)
    for column, wanted in (("sequence", source.sequences), ("weather", source.weather)):
        if not wanted:
            continue
        if column not in frames:
            raise UserError(
                f"the frame table has no column {column}: give --data or --labels"
            )
        values = np.asarray(frames[column]).astype(str)
        is_chosen = np.isin(values, [str(value) for value in wanted])
        if not is_chosen.any():
            raise UserError(
                f"no frames of {column} {', '.join(map(str, wanted))}; there are "
                f"{', '.join(np.unique(values))}"
            )
        frames = boxes.take(frames, is_chosen)
        truth = truth.take(np.isin(truth.frame, frames["frame"]))
        found = found.take(np.isin(found.frame, frames["frame"]))
    if there is not None:
        # K-Radar's tools write files only for frames with ground truth.
        needed = truth.frame if _is_kitti(path) else frames["frame"]
        ids = boxes.ids_by_name(frames)
        is_made = {ids.get(frame_key(str(x)), x): y for x, y in there.items()}
        is_made |= dict.fromkeys(found.frame.tolist(), True)
        lost = [x for x in np.unique(needed).tolist() if x not in is_made]
        if lost:
            first = boxes.frame_keys(boxes.take(frames, frames["frame"] == lost[0]))[0]
            raise DataError(
                f"{path}: {len(lost)} of {len(frames['frame'])} frames have no file, such as "
                f"{first} (a frame without boxes has an empty one): add them, or choose "
                "other frames by --sequences, --weather or --split"
            )
        failed = [x for x in frames["frame"].tolist() if not is_made.get(x, True)]
        left_out = {**left_out, "frames left out: `radejax detect` failed": len(failed)}
        frames = boxes.take(frames, ~np.isin(frames["frame"], failed))
        truth = truth.take(np.isin(truth.frame, frames["frame"]))
    return truth, found, frames, left_out


def _load_ground_truth(
    path: pathlib.Path, source: Source, classes: Sequence[str]
) -> tuple[Boxes, Columns | None, dict[str, int]]:
    """Returns ground truth, the frame table or None, and counts of labels."""
    if source.ground_truth:
        truth = files.as_path(source.ground_truth)
        of_report = (truth / "ground_truth.npz", truth / "evaluation/ground_truth.npz")
        truth = next((place for place in of_report if place.is_file()), truth)
        if (report := truth.with_name("metrics.json")).is_file():
            read_checked(report)
        table = truth.with_name("frames.json")
        frames = _read_frames(table) if table.is_file() else None
        return read_table(truth, frames, scored=False), frames, {}
    if source.data or source.labels:
        data = KRadar(
            list(source.data) or None,
            source.labels,
            version=source.label_version,
            split=None if source.split == "all" else source.split,
            classes=classes,
        )
        counts = {f"labels: {what}": int(n) for what, n in data.counts.items()}
        return *boxes.tables_from_frames(data, source.split), counts
    if _is_kitti(path):
        objects, _, frames = read_kitti(path)
        return objects, frames, {}
    raise UserError(
        f"{path} has predictions only: give the ground truth with --data, --labels or "
        "--ground-truth"
    )


def report_folders(path: PathLike) -> dict[str, pathlib.Path]:
    """Returns the folders of the reports of a run by the names of its seeds.

    For a folder of `radejax train --seeds`, they are those of the seeds that have one. For
    another path, it is the report of the run or the path itself, named "".
    """
    path = files.as_path(path)
    end = "evaluation/predictions.npz"
    found = {file.parts[-3]: file.parent for file in sorted(path.glob(f"seed*/{end}"))}
    return found or {"": path / "evaluation" if (path / end).is_file() else path}


def stored_options(path: PathLike) -> JsonObject:
    """Returns the options of the first report of a run.

    Without a report, they are the classes of the config in the folder or its parent, or
    none without a config that has them: other programs write files of this name, too.
    """
    place = next(iter(report_folders(path).values())).absolute()
    found: JsonObject = {}
    for config in (place.parent / "config.json", place / "config.json"):
        if config.is_file():
            content = files.read_object(config)
            for values in (content, content.get("config")):  # of a run, of an export
                if isinstance(values, dict) and isinstance(values.get("classes"), list):
                    found = {"classes": values["classes"]}
    if any((place / name).is_file() for name in ("metrics.json", "predictions.npz")):
        found = files.read_object(place / "metrics.json", "options")["options"]
    return {name: as_tuples(value) for name, value in found.items()}


def known_classes(*paths: PathLike | None) -> set[str]:
    """Returns the classes of runs and reports, evaluated or not."""
    stored = [stored_options(path) for path in paths if path]
    fields = ("classes", "known_classes")
    return {cls for one in stored for field in fields for cls in one.get(field, ())}


def options_for(
    paths: Sequence[PathLike], source: Source, options: ReportOptions
) -> ReportOptions:
    """Returns options with the classes of all paths, and the highest of their lowest scores.

    Predictions below the lowest stored score of one path must not count for another one.

    Args:
        paths: Reports or predictions, see `load`.
        source: Source of the ground truth.
        options: Settings of the evaluation.
    """
    stored = [stored_options(path).get("min_score", 0.0) for path in paths]
    known = known_classes(*paths, source.ground_truth).union(options.known_classes)
    return options.replace(
        min_score=max(options.min_score, *stored), known_classes=tuple(sorted(known))
    )


def _read_frames(path: PathLike) -> Columns:
    """Reads a frame table that `report.write_report` wrote."""
    content = files.read_json(path)
    try:
        columns = {name: np.asarray(values) for name, values in dict(content).items()}
        boxes.frame_ids(columns)
        if any(column.dtype.kind == "O" for column in columns.values()):
            raise DataError("a column has values that are neither numbers nor text")
    except (TypeError, ValueError) as error:
        raise DataError(f"{path} is not a table of frames: {error}") from None
    return columns


# The report ---------------------------------------------------------------------------


def evaluate_files(
    path: PathLike,
    out_dir: PathLike,
    source: Source,
    options: ReportOptions,
    *,
    run: str = "radejax",
) -> Report:
    """Evaluates predictions in files and writes the report; see `load` for errors."""
    path, *others = report_folders(path).values()
    if others:
        raise UserError(f"{path.parents[1]} holds several seeds: name one of them")
    truth, found, frames, left_out = load(path, source, options.classes)
    warnings = []
    low = stored_options(path).get("min_score", 0.0)
    if low > max(LOW_SCORE, options.score_threshold):
        warnings.append(
            f"{path} has only predictions from score {low:g} on, and every number is of "
            "these; `radejax evaluate` with --min-score stores lower ones"
        )
    options = options_for([path], source, options)
    origin = Origin(run, left_out=left_out, warnings=warnings)
    warn_of_replaced(files.as_path(out_dir), run)
    return write_report(truth, found, frames, out_dir, options, origin)
