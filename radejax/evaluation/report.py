"""The report of an evaluation: console text, JSON, CSV, Markdown, LaTeX, figures."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.evaluation import analysis, bootstrap, plots, protocols, published, tables
from radejax.evaluation.boxes import Columns
from radejax.evaluation.evaluation_set import EvaluationSet, Result
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
        files: Paths written.
    """

    text: str
    metrics: dict[str, Any]
    results: list[Result]
    files: list[pathlib.Path]


def write_report(
    ground_truth: Columns,
    predictions: Columns,
    frames: Columns,
    out_dir: PathLike,
    options: EvaluationOptions | None = None,
    *,
    run: str = "radejax",
    left_out: Mapping[str, int] | None = None,
    warnings: Sequence[str] = (),
    draw_frame: Callable[[int, pathlib.Path], None] | None = None,
    **changes: Any,
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
        **changes: Fields of `EvaluationOptions` to replace.

    Raises:
        UserError: Wrong options or missing columns.
        DataError: A bad row; names the table, frame and row.
    """
    options = dataclasses.replace(options or EvaluationOptions(), **changes)
    if protocols.RECOMMENDED not in options.protocols:
        names = (*options.protocols, protocols.RECOMMENDED)
        options = dataclasses.replace(options, protocols=names)
    data, results = evaluate_tables(ground_truth, predictions, frames, options)
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
        **_analysis(data, frames, options),
    }
    text = _console_text(metrics, results, options)
    built = _tables(metrics, results, options)
    with files.swapped_in(out_dir) as folder:
        # The inputs stay with the report, so that two reports can be compared later.
        columns = {name: np.asarray(column).tolist() for name, column in frames.items()}
        files.write_json(folder / "metrics.json", plain(metrics))
        files.write_json(folder / "frames.json", columns)
        for name, content in (
            ("metrics.csv", _csv_text(metrics["ap"])),
            ("report.txt", text),
            ("tables.md", "\n".join(table.render("markdown") for table in built)),
            ("tables.tex", "\n".join(table.render("latex") for table in built)),
        ):
            files.write_text(folder / name, content)
        keys = frames if "name" in frames else None
        # With repaired sizes, so that the stored predictions can be evaluated again.
        repaired, _ = repair_sizes(predictions, options.invalid_sizes)
        write_table(folder / "predictions.npz", repaired, keys)
        write_table(folder / "ground_truth.npz", ground_truth, keys)
        if options.plots:
            plots.draw(data, frames, options, folder)
        if draw_frame is not None:
            _draw_worst(metrics["worst_frames"], draw_frame, folder / "worst_frames")
        written = [path for path in folder.rglob("*") if path.is_file()]
        relative = [path.relative_to(folder) for path in sorted(written)]
    paths = [pathlib.Path(out_dir) / path for path in relative]
    return Report(text, metrics, results, paths)


def _split(frames: Columns) -> str | None:
    """The split that all frames are of; None if it is not known, or several."""
    splits = np.unique(np.asarray(frames.get("split", [])).astype(str))
    return str(splits[0]) if splits.size == 1 else None


def _analysis(
    data: EvaluationSet, frames: Columns, options: EvaluationOptions
) -> dict[str, Any]:
    """Subsets, box errors and worst frames, as plain values."""
    iou, score = options.iou_thresholds[0], options.operating_score
    subsets = {"distance": analysis.by_distance(data, "3d", iou, operating_score=score)}
    for kind in ("weather", "environment", "time"):
        if masks := condition_masks(frames, kind):
            subsets[kind] = analysis.by_condition(
                data, masks, "3d", iou, operating_score=score
            )
    worst = analysis.worst_frames(
        data, "3d", iou, count=options.worst_frames, operating_score=score
    )
    known = [column for column in ("name", "sequence") if column in frames]
    return {
        "subsets": {
            "protocol": f"{protocols.RECOMMENDED}, 3d, IoU {iou:g}, score > {score:g}",
            **{
                kind: [
                    {kind: name, "cls": cls, **dataclasses.asdict(values)}
                    for (name, cls), values in found.items()
                ]
                for kind, found in subsets.items()
            },
        },
        "box_errors": analysis.box_errors(data, "bev", iou),
        "worst_frames": [
            {**entry, **{c: np.asarray(frames[c]).item(entry["index"]) for c in known}}
            for entry in worst
        ],
    }


def _tables(
    metrics: Mapping[str, Any], results: list[Result], options: EvaluationOptions
) -> list[tables.Table]:
    """Those of the papers, then every protocol and IoU threshold, then details."""
    table, ious = tables.index(results), options.iou_thresholds
    built = []
    if not metrics["is_simulated"]:
        names = metrics["run"], metrics["split"]
        built = published.paper_tables(table, options, *names)
    for space, iou in itertools.product(tables.SPACE_TITLES, ious):
        built.append(tables.by_protocol(table, options, space, iou))
    for protocol, iou in itertools.product(options.protocols, ious):
        built.append(tables.class_by_weather(table, options, protocol, iou))
    return _labelled([*built, *tables.detail_tables(metrics)], metrics)


def _labelled(
    built: list[tables.Table], metrics: Mapping[str, Any]
) -> list[tables.Table]:
    """The tables; those of simulated frames say so."""
    if metrics["is_simulated"]:
        return [table.of_simulated() for table in built]
    return built


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
    built.append(tables.by_protocol(table, options, "3d", iou))
    if any(result.low is not None for result in results):
        built.append(tables.intervals(table, options, iou))
    built.append(tables.subset_table(metrics["subsets"], "distance"))
    built.append(tables.error_table(metrics["box_errors"]))
    kind = "simulated " if metrics["is_simulated"] else ""
    parts = [
        f"{metrics['run']}: {metrics['num_frames']} {kind}frames, "
        f"{metrics['num_ground_truth']} objects, {metrics['num_predictions']} predictions,"
        f" score above {options.min_score:g}\n",
        *(f"WARNING: {line}\n" for line in metrics["warnings"]),
        *(built_table.render() for built_table in _labelled(built, metrics)),
        f"Intervals: {metrics['intervals']}\n",
        "Not part of the numbers, or kept with a remark:",
        *(f"  {count:8d}  {what}" for what, count in metrics["left_out"].items()),
    ]
    return "\n".join(parts) + "\n"


def _csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """metrics.csv: one line per AP."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def plain(value: Any) -> Any:
    """Values that strict JSON can hold: NaN and infinities become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _draw_worst(
    worst: Sequence[Mapping[str, Any]],
    draw_frame: Callable[[int, pathlib.Path], None],
    folder: pathlib.Path,
) -> None:
    """Figures of the worst frames, named like other figures of frames."""
    folder.mkdir()
    for entry in worst:
        name = f"frame_{entry['frame']}"
        if {"name", "sequence"} <= set(entry):
            name = f"{entry['sequence']:02d}_{entry['name']}"
        draw_frame(entry["frame"], folder / f"{name}.png")


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
) -> tuple[str, list[bootstrap.Comparison]]:
    """Compare runs on the same frames: each with the first, and all in Table III.

    Args:
        paths: Predictions or report folders, at least two; the first is run A.
        out_dir: Where to write comparison.txt and comparison.json, or None.
        source: Ground truth, unless the paths bring their own.
        options: Classes, protocols, IoU thresholds, region, score threshold, number of
            resamples of sequences (`bootstrap`) and seed.

    Returns:
        The tables as text, and all comparisons (B is the second run first).

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
    first, *others = [_load_run(path, source, options) for path in paths]
    usual = (protocols.RECOMMENDED, "kradar_r40")
    named = tuple(p for p in usual if p in options.protocols) or options.protocols[:1]
    parts, rows = [], []
    for path, (data, frames) in zip(paths[1:], others, strict=True):
        found = bootstrap.compare(
            first[0],
            data,
            frames["sequence"],
            protocol_names=named,
            iou_thresholds=options.iou_thresholds[:1],
            score_threshold=threshold,
            resamples=options.bootstrap,
            seed=options.seed,
        )
        table = tables.comparison(found, str(paths[0]), str(path))
        is_simulated = data.is_simulated or first[0].is_simulated
        parts.append((table.of_simulated() if is_simulated else table).render())
        rows += found
    if "Sedan" in options.classes:
        runs = dict(zip(map(str, paths), [first, *others], strict=True))
        parts.append(_ablations(runs, options).render())
    text = "\n".join(parts)
    if out_dir is not None:
        content = {
            "runs": list(map(str, paths)),
            "options": dataclasses.asdict(options),
            "rows": [dataclasses.asdict(row) for row in rows],
        }
        files.write_text(pathlib.Path(out_dir) / "comparison.txt", text)
        files.write_json(pathlib.Path(out_dir) / "comparison.json", plain(content))
    return text, rows


def _load_run(
    path: PathLike, source: Source, options: EvaluationOptions
) -> tuple[EvaluationSet, Columns]:
    """A run ready to be compared, and its frames."""
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
    return data, frames


def _ablations(
    runs: Mapping[str, tuple[EvaluationSet, Columns]], options: EvaluationOptions
) -> tables.Table:
    """Several runs in the layout of Table III."""
    options = dataclasses.replace(
        options, protocols=(options.paper_protocol,), iou_thresholds=(0.3, 0.5)
    )
    results = {
        name: tables.index(compute_results(data, frames, options, kinds=()))
        for name, (data, frames) in runs.items()
    }
    is_simulated = any(data.is_simulated for data, _ in runs.values())
    table = published.table_3(
        results, options.paper_protocol, is_simulated=is_simulated
    )
    return table.of_simulated() if is_simulated else table
