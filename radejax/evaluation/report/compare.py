"""What `evaluate.py` does with files: find frames and ground truth, evaluate, compare."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from radejax.core import files
from radejax.core.errors import UserError
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import kitti, predictions
from radejax.evaluation.files.predictions import Columns
from radejax.evaluation.report import bootstrap, paper_tables, tables
from radejax.evaluation.report.measure import Options, measure, repair_sizes
from radejax.evaluation.report.report import Report, evaluate_predictions, plain

PathLike = str | os.PathLike


@dataclasses.dataclass(frozen=True)
class Source:
    """Where ground truth and frames come from.

    Attributes:
        data: Root folders of K-Radar, or none.
        labels: Folder or zip of a label revision.
        label_version: v1.0, v1.1, v2.0 or v2.1.
        split: "train", "test", a split file, or None for every frame.
        ground_truth: File of ground truth instead, with `frames`.
        frames: JSON file of the frame table (columns) for `ground_truth`.
    """

    data: tuple[str, ...] = ()
    labels: str | None = None
    label_version: str = "v2.1"
    split: str | None = "test"
    ground_truth: str | None = None
    frames: str | None = None


def load(
    path: PathLike, source: Source, classes: Sequence[str]
) -> tuple[Columns, Columns, Columns, dict[str, int]]:
    """Ground truth, predictions, frame table and counts of what loading left out.

    Args:
        path: Predictions: a .npz, .json or .csv file, a folder in KITTI's layout, or the
            folder of an earlier report.
        source: Ground truth; a KITTI folder and a report bring their own.
        classes: Classes to load from labels.

    Raises:
        UserError: No ground truth anywhere.
        FileNotFoundError: Names what is missing.
        DataError: Malformed content.
    """
    path = pathlib.Path(path)
    if (path / "predictions.npz").is_file():
        frames = _read_frames(path / "frames.json")
        truth = predictions.read_table(path / "ground_truth.npz", frames, scored=False)
        found = predictions.read_table(path / "predictions.npz", frames)
        return truth, found, frames, {}
    left_out: dict[str, int] = {}
    if source.ground_truth:
        frames = _read_frames(pathlib.Path(source.frames)) if source.frames else None
        truth = predictions.read_table(source.ground_truth, frames, scored=False)
    elif source.data or source.labels:
        truth, frames, left_out = _from_kradar(source, classes)
    elif path.is_dir():
        return (*kitti.read_kitti(path), left_out)
    else:
        raise UserError(
            f"{path} holds predictions only: say where the ground truth is, with --data,"
            " --labels or --ground_truth"
        )
    is_folder = path.is_dir()
    found = (
        kitti.read_kitti(path)[1] if is_folder else predictions.read_table(path, frames)
    )
    if frames is None:
        both = np.concatenate([truth["frame"], found["frame"]])
        frames = {"frame": np.unique(both)}
    return truth, found, frames, left_out


def _read_frames(path: pathlib.Path) -> Columns:
    """A frame table written by `report.write_report`."""
    content = files.read_json(path)
    if not isinstance(content, dict) or "frame" not in content:
        raise UserError(f"{path}: expected an object of columns with 'frame'")
    return {name: np.asarray(column) for name, column in content.items()}


def _from_kradar(
    source: Source, classes: Sequence[str]
) -> tuple[Columns, Columns, dict[str, int]]:
    """Ground truth and frames of K-Radar's labels, and what reading them left out."""
    from radejax.data.kradar import KRadar

    data = KRadar(
        list(source.data) or None,
        source.labels,
        version=source.label_version,
        split=source.split,
        classes=classes,
    )
    truth, frames = predictions.tables_from_frames(data)
    left_out = {f"labels: {what}": int(count) for what, count in data.counts.items()}
    return truth, frames, left_out


def evaluate_files(
    path: PathLike, out_dir: PathLike, source: Source, options: Options
) -> Report:
    """Evaluates predictions in files and writes the report. See `load` for errors."""
    truth, found, frames, left_out = load(path, source, options.classes)
    options = dataclasses.replace(
        options, left_out_before={**left_out, **options.left_out_before}
    )
    return evaluate_predictions(truth, found, frames, out_dir, options)


def compare_files(
    paths: Sequence[PathLike],
    out_dir: PathLike | None,
    source: Source,
    options: Options,
    *,
    resamples: int = 2000,
) -> tuple[str, list[bootstrap.Comparison]]:
    """Compares runs on the same frames: each with the first, and all in Table III.

    Args:
        paths: Predictions or report folders, at least two; the first is run A.
        out_dir: Where to write comparison.txt and comparison.json, or None.
        source: Ground truth, unless the paths bring their own.
        options: Classes, protocols, IoU thresholds, region, score cut, seed.
        resamples: Number of resamples of sequences.

    Returns:
        The tables as text, and all comparisons (B is the second run first).

    Raises:
        UserError: Fewer than two runs, or runs on different frames or ground truth.
    """
    if len(paths) < 2:
        raise UserError("a comparison needs at least two runs")
    first, *others = [_load_run(path, source, options) for path in paths]
    named = [p for p in ("exact", "kradar_r40") if p in options.protocols]
    parts, rows = [], []
    for path, (data, frames) in zip(paths[1:], others, strict=True):
        found = bootstrap.compare(
            first[0],
            data,
            frames["sequence"],
            protocol_names=named or options.protocols[:1],
            iou_thresholds=options.iou_thresholds[:1],
            score_threshold=options.score_threshold,
            resamples=resamples,
            seed=options.seed,
        )
        parts.append(tables.comparison(found, str(paths[0]), str(path)).render())
        rows += found
    runs = dict(zip(map(str, paths), [first, *others], strict=True))
    if "Sedan" in options.classes:
        parts.append(_ablations(runs, options).render())
    text = "\n".join(parts)
    if out_dir is not None:
        content = {
            "runs": list(runs),
            "resamples": resamples,
            "options": options.to_dict(),
            "rows": [row.to_dict() for row in rows],
        }
        out_dir = pathlib.Path(out_dir)
        out_dir.mkdir(parents=True, exist_ok=True)
        files.write_text(out_dir / "comparison.txt", text)
        files.write_json(out_dir / "comparison.json", plain(content))
    return text, rows


def _load_run(
    path: PathLike, source: Source, options: Options
) -> tuple[EvaluationSet, Columns]:
    """A run ready to be compared, and its frames."""
    truth, found, frames, _ = load(path, source, options.classes)
    if "sequence" not in frames:
        raise UserError(
            f"{path}: comparing runs resamples sequences, and the frames do not say"
            " theirs: give --data or --labels"
        )
    found, _ = repair_sizes(found, options.invalid_sizes)
    data = EvaluationSet(
        truth, found, classes=options.classes, frames=frames, roi=options.roi
    )
    return data, frames


def _ablations(
    runs: Mapping[str, tuple[EvaluationSet, Columns]], options: Options
) -> tables.Table:
    """Several runs in the layout of Table III."""
    options = dataclasses.replace(
        options, protocols=(options.paper_protocol,), iou_thresholds=(0.3, 0.5)
    )
    measured = {
        name: tables.index(measure(data, frames, options, kinds=()))
        for name, (data, frames) in runs.items()
    }
    return paper_tables.table_3(measured, options.paper_protocol)
