"""The report of a run: console table, JSON, CSV, Markdown, LaTeX, curves, pictures."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from radejax.core import files
from radejax.core.structures import MIN_SIZE_M
from radejax.evaluation import protocols
from radejax.evaluation.columns import Columns
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files.predictions import write_table
from radejax.evaluation.report import (
    bootstrap,
    breakdown,
    measure,
    paper_tables,
    plausible,
    plots,
    tables,
)
from radejax.evaluation.report.measure import Measured, Options
from radejax.evaluation.result import SPACES


@dataclasses.dataclass(frozen=True)
class Report:
    """What `write_report` found and wrote.

    Attributes:
        text: The console table.
        metrics: The content of metrics.json.
        rows: All APs.
        files: Paths written.
    """

    text: str
    metrics: dict[str, Any]
    rows: list[Measured]
    files: list[pathlib.Path]


def write_report(
    ground_truth: Columns,
    predictions: Columns,
    frames: Columns,
    out_dir: files.PathLike,
    options: Options | None = None,
    **changes: Any,
) -> Report:
    """Evaluates a run in the protocols asked for, and `all_point`, and writes its report.

    Args:
        ground_truth: Columns as in `average_precision.evaluate`.
        predictions: The same with scores.
        frames: Frame table: frame `[F]` ids, and as far as known name, sequence,
            weather, environment and time.
        out_dir: Folder of the report; made if missing, files in it are replaced when all
            are written.
        options: What to compute.
        **changes: Fields of `Options` given by name.

    Raises:
        UserError: Wrong options or missing columns.
        DataError: A bad row, named by table, frame and row.
    """
    options = dataclasses.replace(options or Options(), **changes)
    if protocols.RECOMMENDED not in options.protocols:
        with_own = (*options.protocols, protocols.RECOMMENDED)
        options = dataclasses.replace(options, protocols=with_own)
    clipped = measure.num_clipped(predictions)
    predictions, repaired = measure.repair_sizes(predictions, options.invalid_sizes)
    data = EvaluationSet(
        ground_truth,
        predictions,
        classes=options.classes,
        frames=frames,
        roi=options.roi,
        label_version=options.label_version,
    )
    rows = measure.measure(data, frames, options)
    intervals = why_no_intervals(frames, options)
    if intervals is None:
        rows = with_intervals(data, frames, rows, options)
    metrics = collect(data, predictions, frames, rows, options)
    metrics["intervals"] = intervals or f"{options.bootstrap} resamples of sequences"
    metrics["left_out"]["predictions: size not positive, kept as false positives"] = (
        repaired
    )
    metrics["left_out"][f"predictions: size clipped to {MIN_SIZE_M} m, kept"] = clipped
    text = console_text(metrics, rows, options)
    inputs = {"predictions.npz": predictions, "ground_truth.npz": ground_truth}
    with files.swapped_in(out_dir) as folder:
        _write(folder, metrics, rows, frames, inputs, text, options)
        _draw(data, frames, metrics, folder, options)
        written = [path for path in folder.rglob("*") if path.is_file()]
        names = [path.relative_to(folder) for path in sorted(written)]
    return Report(text, metrics, rows, [pathlib.Path(out_dir) / name for name in names])


def _write(
    folder: pathlib.Path,
    metrics: Mapping[str, Any],
    rows: list[Measured],
    frames: Columns,
    inputs: Mapping[str, Columns],
    text: str,
    options: Options,
) -> None:
    """The files that are no pictures."""
    built = all_tables(rows, metrics, options)
    # The inputs stay with the report, so that two reports can be compared later.
    columns = {name: np.asarray(column).tolist() for name, column in frames.items()}
    files.write_json(folder / "metrics.json", plain(metrics))
    files.write_json(folder / "frames.json", columns)
    texts = {
        "metrics.csv": csv_text(rows),
        "report.txt": text,
        "tables.md": "\n".join(table.render("markdown") for table in built),
        "tables.tex": "% \\usepackage{booktabs,adjustbox}\n"
        + "\n".join(table.render("latex") for table in built),
    }
    for name, content in texts.items():
        files.write_text(folder / name, content)
    for name, table in inputs.items():
        write_table(folder / name, table, frames if "name" in frames else None)


def why_no_intervals(frames: Columns, options: Options) -> str | None:
    """The reason for not computing intervals, or None."""
    if not options.bootstrap:
        return "none asked for"
    if "sequence" not in frames:
        return "none: the frames do not say their sequence"
    if np.unique(np.asarray(frames["sequence"])).size < 2:
        return "none: all frames are of one sequence"
    return None


def with_intervals(
    data: EvaluationSet, frames: Columns, rows: list[Measured], options: Options
) -> list[Measured]:
    """The rows with 95 % intervals: all over all frames, the main ones per weather."""
    main = (protocols.RECOMMENDED, "kradar_r40", options.paper_protocol)
    weathers = measure.condition_masks(frames, "weather")
    found: dict[tuple, tuple[float, float]] = {}
    none = (None, None)
    for name in options.protocols:
        found |= bootstrap.add_intervals(
            data,
            frames,
            list(itertools.product([name], SPACES, options.iou_thresholds)),
            resamples=options.bootstrap,
            seed=options.seed,
            masks=weathers if name in main else {},
            empty_frames=options.frame_rule(name),
            score_threshold=options.cut(name),
        )
    result = []
    for row in rows:
        low, high = found.get(row.key, none) if row.result.is_defined else none
        result.append(dataclasses.replace(row, low=low, high=high))
    return result


def collect(
    data: EvaluationSet,
    predictions: Columns,
    frames: Columns,
    rows: list[Measured],
    options: Options,
) -> dict[str, Any]:
    """Everything of metrics.json, as plain values (NaN where nothing is defined)."""
    iou, cut = options.iou_thresholds[0], options.operating_score
    slices = {"distance": breakdown.by_distance(data, "3d", iou, operating_score=cut)}
    for kind in ("weather", "environment", "time"):
        if masks := measure.condition_masks(frames, kind):
            slices[kind] = breakdown.by_condition(
                data, masks, "3d", iou, operating_score=cut
            )
    confusion = breakdown.confusion(data, "bev", iou, operating_score=cut)
    worst = breakdown.worst_frames(
        data, "3d", iou, count=options.worst_frames, operating_score=cut
    )
    return {
        "run": options.run,
        "options": options.to_dict(),
        "origin": dataclasses.asdict(measure.Origin.of(frames)),
        "num_frames": int(data.frame.size),
        "num_ground_truth": len(data.gt),
        "num_predictions": len(data.pred),
        "left_out": measure.left_out(data, options),
        "warnings": [*options.warnings, *plausible.warnings(predictions, data)],
        "protocols": {
            name: protocols.PROTOCOLS[name].summary for name in options.protocols
        },
        "ap": [row.to_dict() for row in rows],
        "slices": {
            "protocol": f"{protocols.RECOMMENDED}, 3d, IoU {iou:g}, score > {cut:g}",
            **{
                kind: [
                    {kind: name, "cls": cls, **dataclasses.asdict(values)}
                    for (name, cls), values in found.items()
                ]
                for kind, found in slices.items()
            },
        },
        "calibration": breakdown.calibration(data, "3d", iou),
        "box_errors": breakdown.box_errors(data, "bev", iou),
        "confusion": {
            "labels": [*data.classes, "none"],
            "rows": "true class",
            "columns": "predicted class",
            "counts": confusion.tolist(),
        },
        "worst_frames": [entry | _name(frames, entry["index"]) for entry in worst],
    }


def _name(frames: Columns, index: int) -> dict[str, Any]:
    """Name and sequence of a frame, as far as the frame table has them."""
    known = [column for column in ("name", "sequence") if column in frames]
    return {column: np.asarray(frames[column]).item(index) for column in known}


def all_tables(
    rows: list[Measured], metrics: Mapping[str, Any], options: Options
) -> list[tables.Table]:
    """Beside the published ones, then every protocol and IoU threshold, then details."""
    table = tables.index(rows)
    origin = measure.Origin(**metrics["origin"])
    result = paper_tables.beside_published(table, options, origin)
    for space, iou in itertools.product(tables.SPACE_TITLES, options.iou_thresholds):
        result.append(tables.protocols_at_a_glance(table, options, space, iou))
    for protocol, iou in itertools.product(options.protocols, options.iou_thresholds):
        result.append(tables.class_by_weather(table, options, protocol, iou))
    return _labelled([*result, *tables.detail_tables(metrics)], metrics)


def _labelled(
    built: list[tables.Table], metrics: Mapping[str, Any]
) -> list[tables.Table]:
    """The tables; those of simulated frames say so."""
    if metrics["origin"]["is_simulated"]:
        return [table.of_simulated() for table in built]
    return built


def console_text(
    metrics: Mapping[str, Any], rows: list[Measured], options: Options
) -> str:
    """What a reader needs on one screen."""
    table = tables.index(rows)
    iou = options.iou_thresholds[0]
    # The usual two thresholds for the first protocol; the others stay short.
    first, *others = options.main_protocols
    shown = [(first, level) for level in options.iou_thresholds[:2]]
    shown += [(protocol, iou) for protocol in others]
    built = [tables.class_by_weather(table, options, *terms) for terms in shown]
    built.append(tables.protocols_at_a_glance(table, options, "3d", iou))
    if any(row.low is not None for row in rows):
        built.append(tables.intervals(table, options, iou))
    built += [
        tables.slice_table(metrics["slices"], "distance"),
        tables.error_table(metrics["box_errors"]),
        tables.confusion_table(metrics["confusion"]),
    ]
    kind = "simulated " if metrics["origin"]["is_simulated"] else ""
    parts = [
        f"{options.run}: {metrics['num_frames']} {kind}frames, "
        f"{metrics['num_ground_truth']}"
        f" objects, {metrics['num_predictions']} predictions, score above "
        f"{options.min_score:g}\n",
        *(f"WARNING: {line}\n" for line in metrics["warnings"]),
        *(built_table.render() for built_table in _labelled(built, metrics)),
        f"Intervals: {metrics['intervals']}\n",
        "Left out, or kept with a remark:",
        *(f"  {count:8d}  {what}" for what, count in metrics["left_out"].items()),
    ]
    return "\n".join(parts) + "\n"


def csv_text(rows: list[Measured]) -> str:
    """metrics.csv: one line per AP."""
    buffer = io.StringIO()
    entries = [row.to_dict() for row in rows]
    writer = csv.DictWriter(buffer, list(entries[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(entries)
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


def _draw(
    data: EvaluationSet,
    frames: Columns,
    metrics: Mapping[str, Any],
    folder: pathlib.Path,
    options: Options,
) -> None:
    """Curves, and pictures of the worst frames if somebody can draw them."""
    if options.plots:
        plots.draw(data, frames, options, folder)
    if options.draw_frame is not None:
        (folder / "worst_frames").mkdir()
        for entry in metrics["worst_frames"]:
            name = f"frame_{entry['frame']}"
            if {"name", "sequence"} <= set(entry):
                name = f"{entry['sequence']:02d}_{entry['name']}"
            options.draw_frame(entry["frame"], folder / "worst_frames" / f"{name}.png")
