"""The report of an evaluation: console text, JSON, CSV, Markdown, LaTeX, figures."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.evaluation import analysis, bootstrap, protocols, tables
from radejax.evaluation.boxes import Columns
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet, Result
from radejax.evaluation.files import Source, load, stored_from, write_table
from radejax.evaluation.results import (
    EvaluationOptions,
    compute_results,
    condition_masks,
    evaluate_tables,
    exclusion_counts,
    repair_sizes,
    to_row,
    why_no_intervals,
)

LOW_SCORE = 0.1
"""Predictions stored from a higher score on are too few for AP without a threshold."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What `write_report` computed and wrote.

    Attributes:
        text: The console text.
        metrics: The content of metrics.json.
        results: All APs.
        folder: Where the files are.
    """

    text: str
    metrics: dict[str, Any]
    results: list[Result]
    folder: pathlib.Path


def write_report(
    ground_truth: Columns,
    predictions: Columns,
    frames: Columns,
    out_dir: PathLike,
    options: EvaluationOptions,
    *,
    run: str = "radejax",
    left_out: Mapping[str, int] | None = None,
    warnings: Sequence[str] = (),
    draw_frame: Callable[[int, pathlib.Path], None] | None = None,
) -> Report:
    """Evaluate predictions in the given protocols and `all_point`, and write the report.

    Args:
        ground_truth: Columns as in `evaluation.evaluate`.
        predictions: The same with scores.
        frames: Frame table: frame `[F]` ids, and as far as known name, sequence,
            weather, environment, time, simulated and split.
        out_dir: Folder of the report; files in it are replaced when all are written.
        options: What to compute.
        run: Name of the run in tables.
        left_out: Counts of what loading skipped, by reason.
        warnings: Of loading, to be printed.
        draw_frame: Called with (frame id, path of a figure to write) for each of the
            worst frames, or None.

    Raises:
        UserError: Missing columns.
        DataError: A bad row; names the table, frame and row.
    """
    if protocols.RECOMMENDED not in options.protocols:
        names = (*options.protocols, protocols.RECOMMENDED)
        options = dataclasses.replace(options, protocols=names)
    data, results = evaluate_tables(ground_truth, predictions, frames, options)
    iou = options.iou_thresholds[0]
    settings = f"3d, IoU {iou:g}, score > {analysis.OPERATING_SCORE:g}"
    metrics = {
        "run": run,
        "options": dataclasses.asdict(options),
        "split": _split(frames),
        "is_simulated": data.is_simulated,
        "num_frames": int(data.frame.size),
        "num_ground_truth": len(data.gt),
        "num_predictions": len(data.pred),
        "left_out": {**(left_out or {}), **exclusion_counts(data, options)},
        "warnings": [*warnings, *analysis.sanity_checks(data)],
        "protocols": {p: protocols.PROTOCOLS[p].summary for p in options.protocols},
        "intervals": why_no_intervals(frames, options)
        or f"{options.bootstrap} resamples of sequences",
        "ap": [to_row(result) for result in results],
        "subsets": {
            "protocol": f"{protocols.RECOMMENDED}, {settings}",
            **analysis.subsets(data, frames, iou),
        },
        "box_errors": analysis.box_errors(data, iou),
        "worst_frames": analysis.worst_frames(data, frames, iou),
    }
    metrics = _plain(metrics)
    text = _console_text(metrics, results, options)
    built = _tables(metrics, results, options)
    with files.swapped_in(out_dir) as folder:
        # The inputs stay with the report, so that two reports can be compared later.
        columns = {name: np.asarray(column).tolist() for name, column in frames.items()}
        files.write_json(folder / "metrics.json", metrics)
        files.write_json(folder / "frames.json", columns)
        files.write_text(folder / "report.txt", text)
        for name, style in (("tables.md", "markdown"), ("tables.tex", "latex")):
            content = "\n".join(table.render(style) for table in built)
            files.write_text(folder / name, content)
        with open(folder / "metrics.csv", "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(metrics["ap"][0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(metrics["ap"])
        keys = frames if "name" in frames else None
        # With repaired sizes, so that the stored predictions can be evaluated again.
        repaired, _ = repair_sizes(predictions, options.invalid_sizes)
        write_table(folder / "predictions.npz", repaired, keys)
        write_table(folder / "ground_truth.npz", ground_truth, keys)
        if options.plots:
            _draw_curves(data, frames, options, folder)
        if draw_frame is not None:
            (folder / "worst_frames").mkdir()
            for entry in metrics["worst_frames"]:
                name = f"frame_{entry['frame']}"
                if {"name", "sequence"} <= set(entry):  # as other figures of frames
                    name = f"{entry['sequence']:02d}_{entry['name']}"
                draw_frame(entry["frame"], folder / "worst_frames" / f"{name}.png")
    return Report(text, metrics, results, pathlib.Path(out_dir))


def _split(frames: Columns) -> str | None:
    """The split that all frames are of; None if it is not known, or several."""
    splits = np.unique(np.asarray(frames.get("split", [])).astype(str))
    return str(splits[0]) if splits.size == 1 else None


def _tables(
    metrics: Mapping[str, Any], results: list[Result], options: EvaluationOptions
) -> list[tables.Table]:
    """Those of the papers, then every protocol and IoU threshold, then details."""
    table, ious = tables.index(results), options.iou_thresholds
    built = []
    if not metrics["is_simulated"]:
        runs = {metrics["run"]: table}
        built = tables.paper_tables(runs, options, metrics["split"])
    for space, iou in itertools.product(tables.SPACE_TITLES, ious):
        built.append(tables.by_protocol(table, options, space, iou))
    for protocol, iou in itertools.product(options.protocols, ious):
        built.append(tables.class_by_weather(table, options, protocol, iou))
    built += tables.detail_tables(metrics)
    return [each.marked(is_simulated=metrics["is_simulated"]) for each in built]


def _console_text(
    metrics: Mapping[str, Any], results: list[Result], options: EvaluationOptions
) -> str:
    """The most important tables, on one screen."""
    table, iou = tables.index(results), options.iou_thresholds[0]
    # Two thresholds of the first protocol, one of the others.
    first, *others = options.main_protocols
    shown = [(first, level) for level in options.iou_thresholds[:2]]
    shown += [(protocol, iou) for protocol in others]
    built = [tables.class_by_weather(table, options, *terms) for terms in shown]
    built += [tables.by_protocol(table, options, space, iou) for space in ("3d", "bev")]
    built.append(tables.subset_table(metrics["subsets"], "distance"))
    built.append(tables.error_table(metrics["box_errors"]))
    kind = "simulated " if metrics["is_simulated"] else ""
    parts = [
        f"{metrics['run']}: {metrics['num_frames']} {kind}frames, "
        f"{metrics['num_ground_truth']} objects, {metrics['num_predictions']} predictions,"
        f" score above {options.min_score:g}\n",
        *(f"WARNING: {line}\n" for line in metrics["warnings"]),
        *(each.marked(is_simulated=metrics["is_simulated"]).render() for each in built),
        f"Intervals: {metrics['intervals']}\n",
        "Not part of the numbers, or kept with a remark:",
        *(f"  {count:8d}  {what}" for what, count in metrics["left_out"].items()),
    ]
    return "\n".join(parts) + "\n"


def _draw_curves(
    data: EvaluationSet,
    frames: Columns,
    options: EvaluationOptions,
    folder: pathlib.Path,
) -> None:
    """Draw precision over recall per class that has objects, a curve per weather."""
    # Imported here, as matplotlib takes a second to load and may not be needed.
    from radejax.visualize.curves import draw_precision_recall
    from radejax.visualize.style import save_figure

    protocol, iou = protocols.RECOMMENDED, options.iou_thresholds[0]
    suffix = ", simulated data" if data.is_simulated else ""
    masks: dict[str, Any] = {"all": None, **condition_masks(frames, "weather")}
    for space in SPACES:
        panels: dict[str, dict[str, Any]] = {}
        for name, mask in masks.items():
            for result in data.results(
                protocol,
                iou_thresholds=iou,
                spaces=space,
                weights=mask,
                **options.settings_of(protocol),
            ):
                title = f"{result.cls}, {protocol}, {space}, IoU {iou:g}{suffix}"
                curve = (result.recall, result.precision) if result.is_defined else None
                label = f"{name}, AP {result.ap:.1f}"
                panels.setdefault(title, {})[label] = curve
        seen = {title: lines for title, lines in panels.items() if any(lines.values())}
        figure = draw_precision_recall(seen or dict([*panels.items()][:1]))
        path = folder / f"precision_recall_{space}_iou{100 * iou:.4g}.png"
        save_figure(figure, path)


def _plain(value: Any) -> Any:
    """Values that strict JSON can hold: NaN becomes null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    is_number = not isinstance(value, float) or np.isfinite(value)
    return value if is_number else None


# Predictions in files -----------------------------------------------------------------


def evaluate_files(
    path: PathLike,
    out_dir: PathLike,
    source: Source,
    options: EvaluationOptions,
    *,
    run: str = "radejax",
) -> Report:
    """Evaluate predictions in files and write the report; see `load` for errors."""
    truth, found, frames, left_out = load(path, source, options.classes)
    warnings, low = [], stored_from(path)
    if low > max(LOW_SCORE, options.score_threshold):
        warnings.append(
            f"{path} has predictions from score {low:g} on only, and every number is of "
            "these; `radejax evaluate` with --min-score stores lower ones"
        )
    options = dataclasses.replace(options, min_score=max(low, options.min_score))
    return write_report(
        truth,
        found,
        frames,
        out_dir,
        options,
        run=run,
        left_out=left_out,
        warnings=warnings,
    )


def compare_files(
    paths: Sequence[PathLike],
    out_dir: PathLike | None,
    source: Source,
    options: EvaluationOptions,
) -> tuple[str, list[dict[str, Any]]]:
    """Compare runs on the same frames: each with the first, and all in Table III.

    Args:
        paths: Predictions or report folders, at least two; the first is run A.
        out_dir: Where to write comparison.txt and comparison.json, or None.
        source: Ground truth, unless the paths bring their own.
        options: Classes, protocols, IoU thresholds, region, score threshold and number
            of resamples of sequences (`bootstrap`).

    Returns:
        The tables as text, and the fields of all comparisons (B is the second run first).

    Raises:
        UserError: Fewer than two runs, or runs on different frames or ground truth.
    """
    if len(paths) < 2:
        raise UserError("a comparison needs at least two runs")
    if options.bootstrap < 1:
        raise UserError("--bootstrap=0: a comparison needs 1 resample or more")
    # What one run has not stored must not count for another one.
    threshold = max(options.score_threshold, *map(stored_from, paths))
    options = dataclasses.replace(
        options, score_threshold=threshold, min_score=threshold
    )
    usual = (protocols.RECOMMENDED, "kradar_r40")
    names = [str(path) for path in paths]
    (first, _), *others = loaded = [_load_run(path, source, options) for path in paths]
    is_simulated = any(data.is_simulated for data, _ in loaded)
    built, rows = [], []
    for name, (data, sequence) in zip(names[1:], others, strict=True):
        found = bootstrap.compare(
            first,
            data,
            sequence,
            protocol_names=[p for p in usual if p in options.protocols]
            or options.protocols[:1],
            iou_thresholds=options.iou_thresholds[:1],
            score_threshold=threshold,
            resamples=options.bootstrap,
        )
        built.append(tables.comparison(found, names[0], name))
        rows += [_plain(dataclasses.asdict(row)) for row in found]
    if "Sedan" in options.classes:
        shown = dataclasses.replace(
            options, protocols=(options.paper_protocol,), iou_thresholds=(0.3, 0.5)
        )
        results = {
            name: tables.index(compute_results(data, shown, {}))
            for name, (data, _) in zip(names, loaded, strict=True)
        }
        built.append(tables.ablations(results, shown, is_simulated=is_simulated))
    text = "\n".join(
        table.marked(is_simulated=is_simulated).render() for table in built
    )
    if out_dir is not None:
        content = {"runs": names, "options": dataclasses.asdict(options), "rows": rows}
        files.write_text(pathlib.Path(out_dir) / "comparison.txt", text)
        files.write_json(pathlib.Path(out_dir) / "comparison.json", content)
    return text, rows


def _load_run(
    path: PathLike, source: Source, options: EvaluationOptions
) -> tuple[EvaluationSet, np.ndarray]:
    """A run ready to be compared, and the sequence of each of its frames."""
    truth, found, frames, _ = load(path, source, options.classes)
    if "sequence" not in frames:
        raise UserError(
            f"{path}: a comparison resamples sequences, and the frame table has no column "
            "sequence: give --data or --labels"
        )
    found, _ = repair_sizes(found, options.invalid_sizes)
    data = EvaluationSet(
        truth, found, classes=options.classes, frames=frames, roi=options.roi
    )
    return data, np.asarray(frames["sequence"])
