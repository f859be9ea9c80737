"""The report of a run: console table, JSON, CSV, Markdown, LaTeX, curves, pictures."""

from __future__ import annotations

import csv
import dataclasses
import io
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from radejax.core import files
from radejax.evaluation import protocols
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import predictions as predictions_io
from radejax.evaluation.report import (
    bootstrap,
    breakdown,
    details,
    measure,
    paper_tables,
)
from radejax.evaluation.report import (
    tables as layouts,
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


def evaluate_predictions(
    ground_truth: Mapping[str, np.ndarray],
    predictions: Mapping[str, np.ndarray],
    frames: Mapping[str, np.ndarray],
    out_dir: str | pathlib.Path,
    options: Options | None = None,
) -> Report:
    """Evaluates a run in every protocol and writes its report.

    Args:
        ground_truth: Columns as in `average_precision.evaluate`.
        predictions: The same with scores.
        frames: Frame table: frame `[F]` ids, and as far as known name, sequence,
            weather, environment and time.
        out_dir: Folder of the report; made if missing, files in it are replaced.
        options: What to compute.

    Raises:
        UserError: Wrong options or missing columns.
        DataError: A bad row, named by table, frame and row.
    """
    return write_report(ground_truth, predictions, frames, out_dir, options)


def write_report(
    ground_truth: Mapping[str, np.ndarray],
    predictions: Mapping[str, np.ndarray],
    frames: Mapping[str, np.ndarray],
    out_dir: str | pathlib.Path,
    options: Options | None = None,
    **changes: Any,
) -> Report:
    """As `evaluate_predictions`; `changes` are fields of `Options` given by name."""
    options = dataclasses.replace(options or Options(), **changes)
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
    metrics = collect(data, frames, rows, options)
    metrics["intervals"] = intervals or f"{options.bootstrap} resamples of sequences"
    metrics["left_out"]["predictions: size not positive, kept as false positives"] = (
        repaired
    )
    text = console_text(metrics, rows, options)
    out_dir = pathlib.Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    written = [
        _write(out_dir / "metrics.json", files.write_json, plain(metrics)),
        _write(out_dir / "metrics.csv", files.write_text, csv_text(rows)),
        _write(out_dir / "report.txt", files.write_text, text),
    ]
    # The inputs stay with the report, so that two reports can be compared later.
    for name, table in (("predictions", predictions), ("ground_truth", ground_truth)):
        keys = frames if "name" in frames else None
        predictions_io.write_table(out_dir / f"{name}.npz", table, keys)
        written.append(out_dir / f"{name}.npz")
    written.append(_write(out_dir / "frames.json", files.write_json, _lists(frames)))
    tables = all_tables(rows, metrics, options)
    for style, name in (("markdown", "tables.md"), ("latex", "tables.tex")):
        content = "\n".join(table.render(style) for table in tables)
        written.append(_write(out_dir / name, files.write_text, content))
    written += _draw(data, frames, metrics, out_dir, options)
    return Report(text, metrics, rows, written)


def _write(path: pathlib.Path, write: Any, content: Any) -> pathlib.Path:
    write(path, content)
    return path


def _lists(frames: Mapping[str, np.ndarray]) -> dict[str, list]:
    return {name: np.asarray(column).tolist() for name, column in frames.items()}


def why_no_intervals(frames: Mapping[str, np.ndarray], options: Options) -> str | None:
    """The reason for not computing intervals, or None."""
    if not options.bootstrap:
        return "none asked for"
    if "sequence" not in frames:
        return "none: the frames do not say their sequence"
    if np.unique(np.asarray(frames["sequence"])).size < 2:
        return "none: all frames are of one sequence"
    return None


def with_intervals(
    data: EvaluationSet,
    frames: Mapping[str, np.ndarray],
    rows: list[Measured],
    options: Options,
) -> list[Measured]:
    """The rows with 95 % intervals: all over all frames, the main ones per weather."""
    main = (protocols.RECOMMENDED, "kradar_r40", options.paper_protocol)
    weathers = measure.condition_masks(frames, "weather")
    found = {}
    for names, masks in (
        ([name for name in options.protocols if name in main], weathers),
        ([name for name in options.protocols if name not in main], {}),
    ):
        found |= bootstrap.add_intervals(
            data,
            frames,
            [
                (name, space, iou)
                for name in names
                for space in SPACES
                for iou in options.iou_thresholds
            ],
            resamples=options.bootstrap,
            seed=options.seed,
            masks=masks,
            skip_empty=options.skip_empty,
            score_threshold=options.score_threshold,
        )
    result = []
    for row in rows:
        made = row.result
        key = (made.protocol, row.condition, made.cls, made.space, made.iou)
        low, high = found.get(key, (None, None)) if made.is_defined else (None, None)
        result.append(dataclasses.replace(row, low=low, high=high))
    return result


def collect(
    data: EvaluationSet,
    frames: Mapping[str, np.ndarray],
    rows: list[Measured],
    options: Options,
) -> dict[str, Any]:
    """Everything of metrics.json, as plain values (NaN where nothing is defined)."""
    iou = options.iou_thresholds[0]
    cut = options.operating_score
    slices = {"distance": breakdown.by_distance(data, "3d", iou, operating_score=cut)}
    for kind in ("weather", "environment", "time"):
        masks = measure.condition_masks(frames, kind)
        if masks:
            slices[kind] = breakdown.by_condition(
                data, masks, "3d", iou, operating_score=cut
            )
    return {
        "run": options.run,
        "options": options.to_dict(),
        "num_frames": int(data.frame.size),
        "num_ground_truth": len(data.gt),
        "num_predictions": len(data.pred),
        "left_out": measure.left_out(data, options),
        "protocols": {
            name: protocols.PROTOCOLS[name].summary for name in options.protocols
        },
        "ap": [row.to_dict() for row in rows],
        "slices": {
            "protocol": f"{protocols.RECOMMENDED}, 3d, IoU {iou:g}, score > {cut:g}",
            **{
                kind: [
                    {kind: key[0], "cls": key[1], **dataclasses.asdict(values)}
                    for key, values in numbers.items()
                ]
                for kind, numbers in slices.items()
            },
        },
        "calibration": breakdown.calibration(data, "3d", iou),
        "box_errors": breakdown.box_errors(data, "bev", iou),
        "confusion": {
            "labels": [*data.classes, "none"],
            "rows": "true class",
            "columns": "predicted class",
            "counts": breakdown.confusion(
                data, "bev", iou, operating_score=cut
            ).tolist(),
        },
        "worst_frames": _name_frames(
            breakdown.worst_frames(
                data, "3d", iou, count=options.worst_frames, operating_score=cut
            ),
            frames,
        ),
    }


def _name_frames(worst: list[dict], frames: Mapping[str, np.ndarray]) -> list[dict]:
    """Adds name and sequence of the frame table."""
    for entry in worst:
        for column in ("name", "sequence"):
            if column in frames:
                value = np.asarray(frames[column])[entry["index"]]
                entry[column] = value.item() if hasattr(value, "item") else str(value)
    return worst


def all_tables(
    rows: list[Measured], metrics: Mapping[str, Any], options: Options
) -> list[layouts.Table]:
    """Beside the published ones, then every protocol and IoU threshold, then details."""
    table = layouts.index(rows)
    result = paper_tables.beside_published(table, options)
    for space in ("3d", "bev"):
        for iou in options.iou_thresholds:
            result.append(layouts.protocols_at_a_glance(table, options, space, iou))
    for protocol in options.protocols:
        for iou in options.iou_thresholds:
            result.append(layouts.class_by_weather(table, options, protocol, iou))
    return [*result, *details.detail_tables(metrics)]


def console_text(
    metrics: Mapping[str, Any], rows: list[Measured], options: Options
) -> str:
    """What a reader needs on one screen."""
    table = layouts.index(rows)
    iou = options.iou_thresholds[0]
    parts = [
        f"{options.run}: {metrics['num_frames']} frames, {metrics['num_ground_truth']}"
        f" objects, {metrics['num_predictions']} predictions\n"
    ]
    shown = [p for p in ("exact", "kradar_r40", "coco101") if p in options.protocols]
    shown = shown or list(options.protocols[:1])
    for protocol in shown:
        # The usual two thresholds for the first protocol; the others stay short.
        for level in options.iou_thresholds[:2] if protocol == shown[0] else (iou,):
            grid = layouts.class_by_weather(table, options, protocol, level)
            parts.append(grid.render())
    parts.append(layouts.protocols_at_a_glance(table, options, "3d", iou).render())
    if any(row.low is not None for row in rows):
        parts.append(layouts.intervals(table, options, iou).render())
    slices = metrics["slices"]
    parts += [
        details.slice_table(
            slices["distance"], "distance", slices["protocol"]
        ).render(),
        details.error_table(metrics["box_errors"]).render(),
        details.confusion_table(metrics["confusion"]).render(),
    ]
    parts.append(f"Intervals: {metrics['intervals']}\n")
    parts.append("Left out, or kept with a remark:")
    parts += [f"  {count:8d}  {what}" for what, count in metrics["left_out"].items()]
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
    frames: Mapping[str, np.ndarray],
    metrics: Mapping[str, Any],
    out_dir: pathlib.Path,
    options: Options,
) -> list[pathlib.Path]:
    """Curves, and pictures of the worst frames if somebody can draw them."""
    written = []
    if options.plots:
        from radejax.evaluation.report import plots  # matplotlib takes a second to load

        masks = measure.condition_masks(frames, "weather")
        iou = options.iou_thresholds[0]
        for space in SPACES:
            path = out_dir / f"precision_recall_{space}_iou{100 * iou:.4g}.png"
            plots.precision_recall(
                data,
                masks,
                path,
                iou=iou,
                space=space,
                score_threshold=options.score_threshold,
            )
            written.append(path)
        plots.calibration(data, out_dir / "calibration.png", iou=iou)
        written.append(out_dir / "calibration.png")
    if options.draw_frame is not None:
        folder = out_dir / "worst_frames"
        folder.mkdir(exist_ok=True)
        for rank, entry in enumerate(metrics["worst_frames"]):
            path = folder / f"{rank:02d}_frame_{entry['frame']}.png"
            options.draw_frame(entry["frame"], path)
            written.append(path)
    return written
