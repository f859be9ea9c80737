"""The report of an evaluation: console text, JSON, CSV, Markdown, LaTeX and figures.

`published.csv` contains the result tables of the RADE-Net and DinoRADE papers, in their
order, and then other methods as their own repositories, logs or abstracts print them, with
one line per class, space and IoU threshold of a printed row. The values are average
precisions in percent, "-" if the source prints "-", and empty if it has no such column.
Values of 0.99 (1/101, the lower bound of the protocol) are kept as printed; logs are
rounded to two decimals. A difference to a published row is printed only if protocol, score
threshold, labels, region and split agree. Results of simulated frames are not printed next
to published rows.

References:
    RADE-Net: Leitgeb et al., "RADE-Net: Robust Attention Network for Radar-Only Object
    Detection in Adverse Weather", tables I to III.
    DinoRADE: Leitgeb et al., arXiv:2604.08074, tables 1 to 4.
"""

from __future__ import annotations

import csv
import dataclasses
import datetime
import importlib.resources
import itertools
import json
import logging
import pathlib
import re
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Shaped
from tabulate import LATEX_ESCAPE_RULES, tabulate

from radejax.core import files, manifest
from radejax.core.files import JsonObject, PathLike
from radejax.core.version import __version__, radejax_commit
from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation import analysis, protocols, scores
from radejax.evaluation.boxes import AnyBoxes, Columns, roi_name, write_boxes
from radejax.evaluation.evaluation_set import EvaluationSet, Result
from radejax.evaluation.html import SceneFigure, write_html
from radejax.evaluation.kitti import write_kitti
from radejax.evaluation.results import (
    HOW_TO_CHOOSE,
    ReportOptions,
    compute_results,
    condition_masks,
    exclusion_counts,
    make_set,
    to_row,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)

STALE = ("kitti", "precision_recall_*", "reliability.*", "thresholds.*")
"""Patterns of the names of what only some reports contain."""


@dataclasses.dataclass(frozen=True)
class Report:
    """Result of `write_report`.

    Attributes:
        text: Console text of the report.
        metrics: Content of metrics.json.
        results: All average precisions.
        folder: Folder of the written files.
        data: Matched predictions and objects.
    """

    text: str
    metrics: JsonObject
    results: list[Result]
    folder: pathlib.Path
    data: EvaluationSet


class Origin(NamedTuple):
    """Where evaluated predictions come from, as a report states it.

    Attributes:
        run: Name of the run in tables.
        step: Step of the model; None if it is not known.
        data_name: Name of the data set; None if it is not known.
        left_out: Counts of what was read and skipped when loading, by reason.
        warnings: Warnings of loading, which are printed in the report.
    """

    run: str = "radejax"
    step: int | None = None
    data_name: str | None = None
    left_out: Mapping[str, int] = types.MappingProxyType({})
    warnings: Sequence[str] = ()


UNKNOWN = Origin()


def warn_of_replaced(folder: pathlib.Path, run: str) -> None:
    """Warns if a folder has a report of another run."""
    if (before := folder / "metrics.json").exists():
        other = files.read_object(before).get("run")
        if other != run:
            _log.warning("%s: the results of %s are replaced", folder, other)


def write_report(
    ground_truth: AnyBoxes,
    predictions: AnyBoxes,
    frames: Columns,
    out_dir: PathLike,
    options: ReportOptions,
    origin: Origin = UNKNOWN,
    *,
    choosing: EvaluationSet | None = None,
    draw_scenes: Callable[[EvaluationSet, pathlib.Path], Iterable[SceneFigure]]
    | None = None,
) -> Report:
    """Evaluates predictions in the given protocols and `all_point`, and writes the report.

    Args:
        ground_truth: Boxes or columns as for `evaluation.evaluate`.
        predictions: The same with scores.
        frames: Frame table with the column frame `[F]` (ids) and, as far as known, name,
            sequence, weather, environment, time, simulated and split.
        out_dir: Folder of the report. An earlier report in it is replaced when all files
            are written.
        options: Settings of the evaluation.
        origin: Where the predictions come from.
        choosing: Validation split, on which score thresholds are chosen. If None, they are
            chosen on the evaluated frames, except on those of a test split.
        draw_scenes: Function from the evaluation set and the folder to the figures of frames
            for `report.html`; none if None.

    Raises:
        UserError: An option is invalid, or a column is missing.
        DataError: A row is invalid; the message names the table, frame and row.
    """
    if protocols.RECOMMENDED not in options.protocols:
        names = (*options.protocols, protocols.RECOMMENDED)
        options = options.replace(protocols=names)
    data = make_set(ground_truth, predictions, frames, options)
    results = compute_results(data, frames, options)
    iou = options.iou_thresholds[0]
    subsets = {
        "protocol": f"{protocols.RECOMMENDED}, 3d, IoU {iou:g}, score>"
        f"{options.min_score:g}; precision and recall at score>"
        f"{analysis.OPERATING_SCORE:g}"
    }
    # The split is that of all frames, or None if it is unknown or differs.
    splits = np.unique(np.asarray(frames.get("split", [])).astype(str))
    metrics: JsonObject = {
        "run": origin.run,
        "step": origin.step,
        "data": origin.data_name,
        "radejax": __version__,
        "commit": radejax_commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "options": options.to_dict(),
        "split": splits.item() if splits.size == 1 else None,
        "is_simulated": data.is_simulated,
        "num_frames": int(data.frame.size),
        "num_ground_truth": len(data.gt),
        "num_predictions": len(data.pred),
        "left_out": {**origin.left_out, **exclusion_counts(data, options)},
        "warnings": [*origin.warnings, *analysis.sanity_checks(data)],
        "intervals": f"{options.bootstrap} resamples of sequences"
        if any(result.has_interval for result in results)
        else "none: they need --bootstrap and frames of two sequences or more",
        "ap": [to_row(result) for result in results],
        "subsets": subsets | analysis.subsets(data, frames, iou),
        "thresholds": _thresholds(data, choosing, splits, options),
        "box_errors": analysis.box_errors(data, iou, options.find_metrics()),
        "mistakes": _mistake_counts(data, iou),
        "worst_frames": analysis.worst_frames(data, frames, iou),
    }
    metrics = plain(metrics)
    by_key = {result.key: result for result in results}
    tables = RunTables(origin.run, by_key, options, metrics["split"])
    text = _console_text(metrics, tables)
    built = _all_tables(metrics, tables)
    with files.swapped_in(out_dir, *STALE) as folder:
        # The inputs are stored with the report, so that reports can be compared later.
        columns = {name: np.asarray(column).tolist() for name, column in frames.items()}
        files.write_json(folder / "frames.json", columns)
        files.write_text(folder / "report.txt", text)
        write_tables(folder / "tables", built, is_simulated=data.is_simulated)
        for table in built:
            latex = table.render("latex", is_simulated=data.is_simulated)
            files.write_text(folder / "tables" / f"{table.label}.tex", latex)
        with open(folder / "metrics.csv", "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(metrics["ap"][0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(metrics["ap"])
        # The stored predictions have repaired sizes, so that they can be evaluated again.
        write_boxes(folder / "predictions.npz", data.predictions, frames)
        write_boxes(folder / "ground_truth.npz", data.ground_truth, frames)
        inputs = ("frames.json", "ground_truth.npz", "predictions.npz")
        metrics["sha256"] = manifest.checksums(folder, *inputs)
        files.write_json(folder / "metrics.json", metrics)
        if options.kitti:
            least = options.settings_of("kradar_r40")["score_threshold"]
            write_kitti(
                folder / "kitti", *data.evaluated(), frames, score_threshold=least
            )
        description = f"{origin.run}, {describe(metrics)}"
        curves = {}
        if options.plots:
            from radejax.visualize.style import save_figure

            curves = _draw_curves(data, frames, options)
            curves |= _draw_scores(data, metrics["thresholds"]["chosen"], options)
            for name, figure in curves.items():
                save_figure(figure, folder / f"{name}.{options.figures}", description)
        scenes = () if draw_scenes is None else draw_scenes(data, folder)
        write_html(folder / "report.html", metrics, built, curves, scenes)
    return Report(text, metrics, results, pathlib.Path(out_dir), data)


def _all_tables(metrics: JsonObject, tables: RunTables) -> list[Table]:
    """Builds the tables in the papers' layouts, of all protocols and IoUs, and of details."""
    options = tables.options
    subsets = metrics["subsets"]
    built = []
    if not metrics["is_simulated"] and options.label_version:
        built += tables.papers()
    for space, iou in itertools.product(TABLE_SPACES, options.iou_thresholds):
        built.append(tables.by_protocol(space, iou))
    for protocol, iou in itertools.product(options.protocols, options.iou_thresholds):
        built.append(tables.by_weather(protocol, iou))
    built += [subset_table(subsets, kind) for kind in subsets if kind != "protocol"]
    built += threshold_tables(metrics["thresholds"], options)
    built.append(error_table(metrics["box_errors"]))
    title = f"Mistakes in 3D at IoU {options.iou_thresholds[0]:g} and score>"
    title += f"{analysis.OPERATING_SCORE:g}"
    counts = metrics["mistakes"]
    built.append(_table_of("mistakes", title, counts, list(counts[0])))
    names = ["frame", "name", "sequence", "missed", "false", "found"]
    worst = _table_of(
        "worst-frames", "Frames with the most mistakes", metrics["worst_frames"], names
    )
    return [*built, worst]


def _console_text(metrics: JsonObject, tables: RunTables) -> str:
    """Formats the most important tables for the console."""
    options = tables.options
    iou = options.iou_thresholds[0]
    # The first protocol is shown at two IoU thresholds, the others at one.
    first, *others = options.main_protocols
    built = [tables.by_weather(first, level) for level in options.iou_thresholds[:2]]
    built += [tables.by_weather(protocol, iou) for protocol in others]
    built += [tables.by_protocol(space, iou) for space in TABLE_SPACES]
    built.append(subset_table(metrics["subsets"], "distance"))
    chosen_on = metrics["thresholds"]["chosen_on"]
    if chosen_on:
        built.append(threshold_tables(metrics["thresholds"], options)[0])
    built.append(error_table(metrics["box_errors"]))
    kind = "simulated " if metrics["is_simulated"] else ""
    parts = [
        f"{metrics['run']}: {metrics['num_frames']} {kind}frames, "
        f"{metrics['num_ground_truth']} objects, {metrics['num_predictions']} predictions,"
        f" score above {options.min_score:g}",
        describe(metrics) + "\n",
        *(f"WARNING: {line}\n" for line in metrics["warnings"]),
        rendered(built, is_simulated=metrics["is_simulated"]),
        *([] if chosen_on else [f"No score thresholds were chosen: {HOW_TO_CHOOSE}\n"]),
        f"Intervals: {metrics['intervals']}\n",
        "Not part of the numbers, or kept with a remark:",
        *(f"  {count:8d}  {what}" for what, count in metrics["left_out"].items()),
    ]
    return "\n".join(parts) + "\n"


def describe(metrics: JsonObject) -> str:
    """Describes in one line where the numbers of metrics.json come from."""
    known = [name for name in ("step", "data", "split") if metrics[name] is not None]
    parts = [f"{name} {metrics[name]}" for name in known]
    parts += [f"radejax {metrics['radejax']}", f"commit {metrics['commit']}"]
    return ", ".join([*parts, metrics["date"]])


def _draw_curves(
    data: EvaluationSet, frames: Columns, options: ReportOptions
) -> dict[str, Figure]:
    """Draws precision over recall for each weather, one curve per class with objects.

    Returns:
        The figures by the names of their files.
    """
    # Imported here, as matplotlib takes a second to load and is not always needed.
    from radejax.visualize.curves import Curve, draw_precision_recall

    protocol = protocols.RECOMMENDED
    iou = options.iou_thresholds[0]
    suffix = ", simulated data" if data.is_simulated else ""
    figures = {}
    masks: dict[str, Any] = {"all": None, **condition_masks(frames, "weather")}
    settings: dict[str, Any] = {"iou_thresholds": iou, **options.settings_of(protocol)}
    for space in TABLE_SPACES:
        panels: dict[str, dict[str, Curve]] = {}
        for name, mask in masks.items():
            lines = panels.setdefault(TITLES.get(name, name), {})
            for result in data.results(
                protocol, spaces=space, weights=mask, **settings
            ):
                curve = (result.recall, result.precision) if result.is_defined else None
                terms = f"AP {result.ap:.1f}, {result.num_gt:,} objects"
                lines[f"{result.cls}: {terms}"] = curve
        title = f"{protocol}, {space.upper()}, IoU {iou:g}{suffix}"
        name = f"precision_recall_{space}_iou{100 * iou:.4g}"
        figures[name] = draw_precision_recall(panels, title)
    return figures


def _class_curves(data: EvaluationSet, options: ReportOptions) -> list[Result]:
    """Returns the curves in `all_point` and 3D of the classes that occur."""
    protocol = protocols.RECOMMENDED
    iou = options.iou_thresholds[0]
    settings = options.settings_of(protocol)
    results = data.results(protocol, iou_thresholds=iou, spaces="3d", **settings)
    return [result for result in results if result.is_defined]


def _thresholds(
    data: EvaluationSet,
    choosing: EvaluationSet | None,
    splits: Shaped[np.ndarray, " S"],
    options: ReportOptions,
) -> JsonObject:
    """Chooses score thresholds, and computes the rates at these and others.

    Returns:
        "chosen_on", the frames on which thresholds were chosen, or None; and entries with
        class, threshold, rates, and the numbers of matches ("count") and objects: "chosen"
        ones, with their "rule", and "rates".
    """
    chosen_on = "the validation split"
    if choosing is None and "test" not in splits:
        choosing = data
        chosen_on = "the evaluated frames themselves"
    points: dict[str, dict[str, float]] = {}
    for curve in [] if choosing is None else _class_curves(choosing, options):
        chosen = scores.choose_thresholds(curve, options.wanted_precision)
        points[curve.cls] = chosen
    entries: list[analysis.Entry] = []
    for curve in _class_curves(data, options):
        rules = points.get(curve.cls, {}) | {
            f"{i / 20:g}": i / 20 for i in range(1, 20)
        }
        rates = scores.rates_at(curve, [*rules.values()])
        for i, (rule, threshold) in enumerate(rules.items()):
            entry: analysis.Entry = {"cls": curve.cls, "rule": rule}
            entry |= {"threshold": threshold}
            entry |= {name: float(x[i]) for name, x in rates.items()}
            count = round(rates["recall"][i] * curve.num_gt)
            entries.append({**entry, "count": count, "num_gt": curve.num_gt})
    return {
        "chosen_on": None if choosing is None else chosen_on,
        "chosen": [entry for entry in entries if entry["rule"] in scores.RULES],
        "rates": [entry for entry in entries if entry["rule"] not in scores.RULES],
    }


def _draw_scores(
    data: EvaluationSet,
    chosen: Sequence[analysis.Entry],
    options: ReportOptions,
) -> dict[str, Figure]:
    """Draws the rates over score thresholds, and reliability diagrams, of every class."""
    from radejax.visualize.curves import Curve, draw_precision_recall
    from radejax.visualize.style import halo

    iou = options.iou_thresholds[0]
    over = np.linspace(0, 1, 201)
    is_matched = data.matched_objects("plain", "free", "3d", iou) >= 0
    rates: dict[str, dict[str, Curve]] = {}
    diagrams: dict[str, dict[str, Curve]] = {}
    bins: dict[str, list[scores.Reliability]] = {}
    for curve in _class_curves(data, options):
        columns = scores.rates_at(curve, over).items()
        rates[curve.cls] = {name: (over, column) for name, column in columns}
        for entry in chosen:
            if entry["cls"] == curve.cls:
                at = entry["threshold"]
                rates[curve.cls][f"{entry['rule']}: {at:g}"] = [at, at], [0, 1]
        rows = data.pred.cls == data.classes.index(curve.cls)
        diagrams[curve.cls] = {"calibrated": ([0, 1], [0, 1])}
        for name, x in data.confidences().items():
            found = scores.reliability(x[rows], is_matched[rows])
            label = f"{name}: calibration error {number(found.error, digits=3)}"
            diagrams[curve.cls][label] = found.confidence, found.precision
            bins.setdefault(curve.cls, []).append(found)
    if not rates:
        return {}
    suffix = f", 3D, IoU {iou:g}{', simulated data' if data.is_simulated else ''}"
    labels = "confidence", "precision"
    title = f"Reliability{suffix}, with the number of predictions per bin"
    reliability = draw_precision_recall(diagrams, title, labels)
    for ax, of_class in zip(reliability.axes, bins.values(), strict=False):
        for line, found in zip(ax.lines[1:], of_class, strict=True):
            for count, x, y in zip(*found, strict=True):
                text = ax.text(x, y + 0.03, f"{count:.0f}", size=6, ha="center")
                text.set(color=line.get_color(), path_effects=halo(2, "white"))
    labels = "score threshold", "rate"
    thresholds = draw_precision_recall(rates, f"Score thresholds{suffix}", labels)
    return {"thresholds": thresholds, "reliability": reliability}


def _mistake_counts(data: EvaluationSet, iou: float) -> list[analysis.Entry]:
    """Counts the objects, found objects and mistakes of each class for metrics.json."""
    counts = {kind: x.sum(axis=0) for kind, x in analysis.mistakes(data, iou).items()}
    objects = data.gt_count.sum(axis=0)
    columns = {"num_gt": objects, "found": objects - counts["missed"], **counts}
    return [
        {"cls": cls, **{name: int(column[i]) for name, column in columns.items()}}
        for i, cls in enumerate(data.classes)
    ]


def plain(values: JsonObject) -> JsonObject:
    """Converts values to strict JSON: NaN and infinity become null."""
    strict: JsonObject = json.loads(json.dumps(values), parse_constant=lambda _: None)
    return strict


# Tables -------------------------------------------------------------------------------

TITLES = {"all": "Total"} | {
    name: name.replace("snow", " snow").title() for name in WEATHERS
}
TABLE_SPACES = ("3d", "bev")
"""Box spaces in the order of the papers' tables."""

STYLES = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of a report.

    Attributes:
        title: Title that describes the numbers in one line.
        header: `[K]` column titles.
        rows: Rows of `K` strings or counts.
        name: Short name, from which `label` is made; the title if empty.
        best: Row and column of the values that are bold.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str | int]]
    name: str = ""
    best: Collection[tuple[int, int]] = ()

    @property
    def label(self) -> str:
        """Label in LaTeX and name of the file of the table."""
        return re.sub("[^a-z0-9]+", "-", (self.name or self.title).lower()).strip("-")

    def render(self, style: str = "text", *, is_simulated: bool = False) -> str:
        """Renders the table as "text", "markdown" or "latex" (with caption and label)."""
        align = ["left", *["right"] * (len(self.header) - 1)]
        # The LaTeX command is inserted below, as tabulate escapes it.
        marks = {"markdown": "**", "latex": "\ue000"}
        mark = marks.get(style, "")
        rows = [
            [
                f"{mark}{x}{mark}" if (i, j) in self.best else x
                for j, x in enumerate(row)
            ]
            for i, row in enumerate(self.rows)
        ]
        body = tabulate(
            rows, self.header, STYLES[style], disable_numparse=True, colalign=align
        )
        title = f"Simulated data: {self.title}" if is_simulated else self.title
        if style == "latex":
            body = re.sub("\ue000(.*?)\ue000", r"\\textbf{\1}", body)
            caption = "".join(LATEX_ESCAPE_RULES.get(x, x) for x in title)
            head = f"\\caption{{{caption}}}\n\\label{{tab:{self.label}}}\n"
            return f"\\begin{{table}}\n{head}{body}\n\\end{{table}}\n"
        title = f"**{title}**" if style == "markdown" else title
        return f"{title}\n\n{body}\n"


def rendered(
    tables: Sequence[Table], style: str = "text", *, is_simulated: bool
) -> str:
    """Renders several tables below each other."""
    return "\n".join(table.render(style, is_simulated=is_simulated) for table in tables)


def write_tables(path: pathlib.Path, tables: Sequence[Table], **options: bool) -> None:
    """Writes tables as Markdown and LaTeX to files with these suffixes, see `rendered`."""
    for suffix, style in ((".md", "markdown"), (".tex", "latex")):
        files.write_text(path.with_suffix(suffix), rendered(tables, style, **options))


def number(value: float | None, *, signed: bool = False, digits: int = 2) -> str:
    """Formats a value with fixed decimals, and None or NaN as `-`."""
    if value is None or value != value:
        return "-"
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def best_rows(
    body: Sequence[Sequence[str]], rows: Iterable[int], column: int
) -> set[tuple[int, int]]:
    """Returns the places of the largest of several numbers in a column of a table.

    Examples:
        >>> best_rows([["A", "0.5"], ["B", "-"], ["C", "0.7"]], range(3), 1)
        {(2, 1)}
    """
    values = {i: float(body[i][column]) for i in rows if body[i][column] != "-"}
    largest = max(values.values(), default=0.0)
    return {(i, column) for i, x in values.items() if x == largest and len(values) > 1}


def numbers(values: Iterable[float | None], *, signed: bool = False) -> list[str]:
    """Formats values as table entries (see `number`)."""
    return [number(value, signed=signed) for value in values]


def _with_interval(result: Result) -> str:
    """Formats an AP with its interval, if there is one, such as "61.05 [50.1, 70.2]"."""
    if not (result.is_defined and result.has_interval):
        return number(result.ap_or_none)
    low = number(result.low, digits=1)
    high = number(result.high, digits=1)
    return f"{number(result.ap)} [{low}, {high}]"


# Behind the APs -----------------------------------------------------------------------


def subset_table(subsets: JsonObject, kind: str) -> Table:
    """Builds the table of AP, precision and recall per subset and class with boxes."""
    title = f"By {kind}, {subsets['protocol']}"
    entries = [entry for entry in subsets[kind] if entry["num_gt"] or entry["num_det"]]
    names = [kind, "cls", "ap", "precision", "recall", "num_gt", "score_error"]
    names += ["probability_error"] * ("probability_error" in subsets[kind][0])
    return _table_of(f"by-{kind}", title, entries, names)


def threshold_tables(thresholds: JsonObject, options: ReportOptions) -> list[Table]:
    """Builds the tables of the rates at chosen score thresholds, if any, and at all."""
    terms = f"3D at IoU {options.iou_thresholds[0]:g}"
    title = f"Score thresholds in {terms} for the best F1 and a precision of "
    title += f"{options.wanted_precision:g}, chosen on {thresholds['chosen_on']}"
    names = ["cls", "threshold", "precision", "recall", "f1", "count", "num_gt"]
    chosen = _table_of("thresholds", title, thresholds["chosen"], [*names, "rule"])
    title = f"Rates at score thresholds in {terms}"
    rates = _table_of("rates", title, thresholds["rates"], names[:-2])
    return [chosen, rates] if thresholds["chosen_on"] else [rates]


def error_table(errors: Mapping[str, Mapping[str, float]]) -> Table:
    """Builds the table of median errors of matched boxes and of reversed headings."""
    entries: list[analysis.Entry]
    entries = [{"cls": cls, **found} for cls, found in errors.items()]
    medians = [name for name in entries[0] if name.endswith("_median")]
    title = "Median errors of matched boxes (all scores); reversed: heading off by more"
    title += " than 90 deg"
    return _table_of(
        "box-errors", title, entries, ["cls", "count", *medians, "reversed"]
    )


def _table_of(
    label: str, title: str, entries: Sequence[analysis.Entry], names: Sequence[str]
) -> Table:
    """Builds a table with some values of entries of metrics.json, one entry per row."""
    values = [[entry.get(name, "") for name in names] for entry in entries]
    rows = [
        [value if isinstance(value, str | int) else number(value) for value in row]
        for row in values
    ]
    titles = {"cls": "Class", "ap": "AP", "num gt": "Objects", "count": "Matches"}
    words = [name.removesuffix("_median").replace("_", " ") for name in names]
    header = [titles.get(word, word.capitalize()) for word in words]
    return Table(title, header, rows, label)


# Published rows -----------------------------------------------------------------------

CONDITIONS = ("all", *WEATHERS)

ABLATIONS = ("RADE-Net, Table III", "DinoRADE, Table 4")
"""Ablation tables, with whose rows a run is not compared."""


class Cell(NamedTuple):
    """Place of an AP in the tables of the papers."""

    condition: str = "all"
    cls: str = "Sedan"
    space: str = "3d"
    iou: float = 0.3


@dataclasses.dataclass(frozen=True)
class PublishedRow:
    """One row of a published table.

    Attributes:
        source: Paper and table, such as "DinoRADE, Table 2", or repository and file.
        method: Name of the row; in ablations, the components that the row includes.
        sensors: L for LiDAR, C for camera, R for radar.
        label_version: K-Radar label revision.
        label_origin: "stated" by the source, or where the revision is known from.
        protocol: Evaluation protocol, or "not stated", as also in the next two fields.
        score_threshold: Predictions with a higher score were evaluated.
        region: Region of interest, "narrow" or "wide".
        config: Config that trains the method, or "not trainable here".
        values: APs as printed. The class "mean" is the mAP of the source.
    """

    source: str
    method: str
    sensors: str
    label_version: str
    label_origin: str
    protocol: str
    score_threshold: str
    region: str
    config: str
    values: dict[Cell, str]

    @property
    def terms(self) -> str:
        """Protocol, and what is known of score threshold, labels and region."""
        origin = "" if self.label_origin == "stated" else f" ({self.label_origin})"
        terms = (
            self.protocol.replace("not stated", "protocol not stated"),
            f"score>{self.score_threshold}",
            f"labels={self.label_version}{origin}",
            f"roi={self.region}",
        )
        known = [term for term in terms if not re.search("[>=]not stated", term)]
        return ", ".join(known)

    def is_comparable(self, options: ReportOptions, split: str | None) -> bool:
        """Returns True if protocol, score threshold, labels, region and split are equal."""
        return (
            options.paper_protocol == self.protocol
            and options.settings_of(self.protocol)["score_threshold"]
            == float(self.score_threshold)
            and options.label_version == self.label_version
            and roi_name(options.roi) == self.region
            and split == "test"
            and self.source not in ABLATIONS
        )


def _read() -> tuple[PublishedRow, ...]:
    """Reads the rows of `published.csv`.

    Its columns `code` (repository of the method) and `note` are for readers of the file.
    """
    names = [field.name for field in dataclasses.fields(PublishedRow)][:-1]
    text = importlib.resources.files(__package__) / "published.csv"
    rows: dict[tuple[str, ...], PublishedRow] = {}
    for line in csv.DictReader(text.read_text(encoding="utf-8").splitlines()):
        fields = {name: line[name] for name in names}
        row = rows.setdefault(tuple(fields.values()), PublishedRow(**fields, values={}))
        for condition in filter(line.get, CONDITIONS):
            cell = Cell(condition, line["cls"], line["space"], float(line["iou"]))
            row.values[cell] = line[condition]
    return tuple(rows.values())


PUBLISHED = _read()
"""All rows of all result tables of both papers, and of other sources."""


# Tables of a run ----------------------------------------------------------------------

Place = Mapping[str, Any]
"""Fields of a `Cell` by name."""


@dataclasses.dataclass(frozen=True)
class RunTables:
    """Tables of the average precisions of one run.

    Attributes:
        run: Name of the run.
        results: Results by their `key`.
        options: Options of the evaluation.
        split: Split of the frames, or None if it is not known.
    """

    run: str
    results: Mapping[tuple[str, str, str, str, float], Result]
    options: ReportOptions
    split: str | None = None

    def _aps(self, protocol: str, cells: Iterable[Cell]) -> list[float | None]:
        """Returns APs, which are None if a class does not occur or there is no result."""
        found = [self.results.get((protocol, *cell)) for cell in cells]
        return [None if result is None else result.ap_or_none for result in found]

    def _terms(self, protocol: str) -> str:
        """Returns a protocol with its score threshold, empty-frame rule, labels and region."""
        found = next(r for r in self.results.values() if r.protocol == protocol)
        terms = found.metric.removesuffix("/simulated")  # which titles begin with
        return ", ".join(terms.split("/")[1:])

    def by_weather(self, protocol: str, iou: float) -> Table:
        """Builds the table of classes by weather in one protocol, with "3D / BEV" entries."""
        conditions = dict.fromkeys(key[1] for key in self.results)
        body = []
        for cls in (*self.options.classes, "mean"):
            pairs = [
                [Cell(name, cls, x, iou) for x in TABLE_SPACES] for name in conditions
            ]
            entries = [numbers(self._aps(protocol, pair)) for pair in pairs]
            body.append([cls, *map(" / ".join, entries)])
        title = f"AP 3D / BEV at IoU {iou:g}, {self._terms(protocol)}"
        name = f"weather-{protocol}-iou{100 * iou:.4g}"
        header = ["Class", *(TITLES.get(x, x) for x in conditions)]
        return Table(title, header, body, name)

    def by_protocol(self, space: str, iou: float) -> Table:
        """Builds the table of protocols by classes over all weathers.

        The entries include the intervals over sequences if they were computed.
        """
        classes = (*self.options.classes, "mean")
        body = []
        for name in self.options.protocols:
            found = (self.results[name, "all", cls, space, iou] for cls in classes)
            threshold = self.options.settings_of(name)["score_threshold"]
            body.append([f"{name}, score>{threshold:g}", *map(_with_interval, found)])
        title = f"AP {space.upper()} at IoU {iou:g} in every protocol, all weathers"
        if any(result.has_interval for result in self.results.values()):
            count = self.options.bootstrap
            title += f", 95 % intervals of {count} resamples of sequences"
        name = f"protocols-{space}-iou{100 * iou:.4g}"
        return Table(title, ["Protocol", *classes], body, name)

    def papers(self) -> list[Table]:
        """Builds the tables in the papers' layouts that the classes and IoUs allow.

        The frames must not be simulated.
        """
        if 0.3 not in self.options.iou_thresholds:
            return []
        spaces: list[Place] = [{"space": space} for space in TABLE_SPACES]
        conditions = [{"condition": name} for name in CONDITIONS]
        classes = [{"cls": cls} for cls in (*self.options.classes, "mean")]
        of_others = ("Sedan", "Bus or Truck", "mean")  # classes of most other methods
        common = [place for place in classes if place["cls"] in of_others]
        ious = _crossed([{"iou": 0.3}, {"iou": 0.5}], spaces)
        elsewhere = [row.source for row in PUBLISHED if ", Table" not in row.source]
        tables = [
            self._layout(
                "sedan-by-weather",
                "Sedan by weather at IoU 0.3 (layout of Table I)",
                ["RADE-Net, Table I", "DinoRADE, Table 1"],
                spaces,
                conditions,
            ),
            self._layout(
                "classes-by-weather",
                "Classes by weather at IoU 0.3 (layout of Table II)",
                ["RADE-Net, Table II", "DinoRADE, Table 2"],
                classes,
                _crossed(conditions, spaces),
            ),
            self._layout(
                "classes",
                "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3)",
                ["DinoRADE, Table 3"],
                [{"condition": "all"}],
                _crossed(classes, spaces),
            ),
            self._layout(
                "ablations",
                "Ablations, Sedan (layout of Table III)",
                ABLATIONS,
                [{"cls": "Sedan"}],
                ious,
            ),
            self._layout(
                "other-methods",
                "Other methods, all weathers, as printed elsewhere",
                elsewhere,
                common,
                ious,
            ),
        ]
        # The others show sedans.
        return tables if "Sedan" in self.options.classes else tables[1:3]

    def _layout(
        self,
        name: str,
        title: str,
        sources: Sequence[str],
        groups: Sequence[Place],
        columns: Sequence[Place],
    ) -> Table:
        """Builds a table of published rows, each with our difference to it, and our rows.

        The best value of each column and group is bold.

        Args:
            name: Short name of the table.
            title: Title of the table.
            sources: Papers and tables whose rows are printed.
            groups: Condition, class, space or IoU threshold of each group of rows.
            columns: Condition, class, space or IoU threshold of each column.
        """
        body: list[list[str]] = []
        best = set[tuple[int, int]]()
        for group in groups:
            start = len(body)
            of = _name(group)
            cells = [Cell(**group, **column) for column in columns]
            printed = []
            for row in PUBLISHED:
                values = [row.values.get(cell, "-") for cell in cells]
                # Both papers contain the same rows of other methods.
                is_repeated = [row.method, *values] in printed
                if row.source not in sources or set(values) == {"-"} or is_repeated:
                    continue
                printed.append([row.method, *values])
                method = f"{row.method} ({row.sensors})"
                body.append([method, of, row.source, row.terms, *values])
                gaps = self._differences(row, cells)
                if set(gaps) != {"-"}:
                    same = "same protocol, score, labels, region, split"
                    body.append(["difference", of, row.source, same, *gaps])
            for protocol in self.options.main_protocols:
                aps = numbers(self._aps(protocol, cells))
                body.append([self.run, of, "", self._terms(protocol), *aps])
            rows = [i for i in range(start, len(body)) if body[i][0] != "difference"]
            for column in range(4, 4 + len(cells)):
                best |= best_rows(body, rows, column)
        header = ["Method", "Of", "Source", "Terms", *map(_name, columns)]
        return Table(title, header, body, name, best)

    def _differences(self, row: PublishedRow, cells: Sequence[Cell]) -> list[str]:
        """Formats our APs minus the printed ones, with "-" if they are not comparable.

        A mean is compared only with a mean over the same classes.
        """
        is_comparable = row.is_comparable(self.options, self.split)
        classes = {cell.cls for cell in row.values} - {"mean"}
        gaps: list[float | None] = []
        ours = self._aps(self.options.paper_protocol, cells)
        for cell, ap in zip(cells, ours, strict=True):
            printed = row.values.get(cell, "-")
            is_same = cell.cls != "mean" or classes == set(self.options.classes)
            exists = is_comparable and is_same and printed != "-"
            gaps.append(ap - float(printed) if exists and ap is not None else None)
        return numbers(gaps, signed=True)


def _crossed(outer: Sequence[Place], inner: Sequence[Place]) -> list[Place]:
    return [{**one, **other} for one in outer for other in inner]


def _name(place: Place) -> str:
    """Returns the title of a group or a column, such as "Light Snow BEV"."""
    names = {"3d": "3D", "bev": "BEV", 0.3: "IoU 0.3", 0.5: "IoU 0.5"} | TITLES
    return " ".join(str(names.get(value, value)) for value in place.values())
