"""Tables of a report, as text, Markdown and LaTeX, and the published rows beside them.

APs come from results by key (`index`); what lies behind them (subsets, box errors,
worst frames) from the content of metrics.json.

The numbers of the result tables of the RADE-Net and DinoRADE papers are in
`published.csv`, one line per class, space and IoU threshold of a printed row, in the
order of the papers: average precisions in percent, "-" where a paper prints that, nothing
where its table has no such column. Values of 0.99 (1/101, the lower bound of the protocol)
are kept as printed. A difference to a published row is printed only where protocol,
labels, region and split agree. Results of simulated frames are not printed next to them.

References:
    RADE-Net: Leitgeb et al., "RADE-Net: Robust Attention Network for Radar-Only Object
    Detection in Adverse Weather", tables I to III.
    DinoRADE: Leitgeb et al., arXiv:2604.08074, tables 1 to 4.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.resources
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tabulate import tabulate

from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation.bootstrap import Comparison
from radejax.evaluation.boxes import roi_name
from radejax.evaluation.evaluation_set import Result
from radejax.evaluation.results import EvaluationOptions

TITLES = {"all": "Total"} | {
    name: name.replace("snow", " snow").title() for name in WEATHERS
}
SPACE_TITLES = {"3d": "3D", "bev": "BEV"}
"""Titles of the spaces, in the order of the papers."""

ERRORS = (
    ("center_m", "Center m", 2),
    ("z_m", "z m", 2),
    ("length_m", "Length m", 2),
    ("width_m", "Width m", 2),
    ("height_m", "Height m", 2),
    ("heading_deg", "Heading deg", 1),
    ("axis_deg", "Axis deg", 1),
)
STYLES = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}
Results = Mapping[tuple[str, str, str, str, float], Result]
"""Results by protocol, condition, class, space and IoU threshold."""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table ready to be rendered.

    Attributes:
        title: One line that says what the numbers are.
        header: `[K]` column titles.
        rows: Rows of `K` strings or counts.
        note: A line below the table, or "".
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str | int]]
    note: str = ""

    def render(self, style: str = "text") -> str:
        """As "text", "markdown" or "latex" (a tabular; title and note are comments)."""
        align = ["left", *["right"] * (len(self.header) - 1)]
        body = tabulate(
            self.rows, self.header, STYLES[style], disable_numparse=True, colalign=align
        )
        title, note = self.title, f"{self.note}\n" if self.note else ""
        if style == "latex":
            return f"% {title}\n{body}\n{note and '% '}{note}"
        title = f"**{title}**" if style == "markdown" else title
        return f"{title}\n\n{body}\n{note and chr(10)}{note}"

    def marked(self, *, is_simulated: bool) -> Table:
        """The same with a title that says whether the data are simulated."""
        prefix = "Simulated data: " if is_simulated else ""
        return dataclasses.replace(self, title=f"{prefix}{self.title}")


def index(results: Sequence[Result]) -> Results:
    """Results by their key."""
    return {result.key: result for result in results}


def number(value: float | None, *, signed: bool = False, digits: int = 2) -> str:
    """A value as the papers print it; `-` for one that does not exist."""
    if value is None or value != value:
        return "-"
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def numbers(values: Iterable[float | None], **options: Any) -> list[str]:
    """Values as entries of a table, see `number`."""
    return [number(value, **options) for value in values]


def ap_of(results: Results, *key: Any) -> float | None:
    """AP of a key; None where the class does not occur or nothing was computed."""
    result = results.get(key)
    return None if result is None else result.ap_or_none


def terms_of(results: Results, protocol: str) -> str:
    """Protocol with its score threshold, empty-frame rule, label version and region."""
    found = next(r for r in results.values() if r.protocol == protocol)
    return ", ".join(found.metric.split("/")[1:])


def class_by_weather(
    results: Results, options: EvaluationOptions, protocol: str, iou: float
) -> Table:
    """Classes by total and weathers in one protocol, "3D / BEV" in each entry."""
    conditions = dict.fromkeys(key[1] for key in results)
    body = []
    for cls in (*options.classes, "mean"):
        pairs = (
            [ap_of(results, protocol, name, cls, space, iou) for space in SPACE_TITLES]
            for name in conditions
        )
        body.append([cls, *(" / ".join(numbers(pair)) for pair in pairs)])
    return Table(
        f"AP 3D / BEV at IoU {iou:g}, {terms_of(results, protocol)}",
        ["Class", *(TITLES.get(name, name) for name in conditions)],
        body,
    )


def by_protocol(
    results: Results, options: EvaluationOptions, space: str, iou: float
) -> Table:
    """Protocols by classes, all weathers, with intervals over sequences if there are."""
    classes = (*options.classes, "mean")
    body = []
    for name in options.protocols:
        found = (results.get((name, "all", cls, space, iou)) for cls in classes)
        body.append([name, *map(_with_interval, found)])
    title = f"AP {SPACE_TITLES[space]} at IoU {iou:g} in every protocol, all weathers"
    if any(result.low is not None for result in results.values()):
        title += f", 95 % intervals of {options.bootstrap} resamples of sequences"
    return Table(title, ["Protocol", *classes], body)


def _with_interval(result: Result | None) -> str:
    """AP, and its interval if there is one, such as "61.05 [50.1, 70.2]"."""
    if result is None or result.ap_or_none is None or result.low is None:
        return number(None if result is None else result.ap_or_none)
    low, high = numbers((result.low, result.high), digits=1)
    return f"{number(result.ap)} [{low}, {high}]"


def comparison(rows: Sequence[Comparison], run_a: str, run_b: str) -> Table:
    """Two runs and which of their differences are significant."""
    header = ["Class", "Protocol", "AP", "IoU", "A", "B", "B - A", "95 %", "p"]
    body = []
    for row in rows:
        gap, low, high = numbers((row.difference, row.low, row.high), signed=True)
        entries = [row.cls, row.protocol, SPACE_TITLES[row.space], f"{row.iou:g}"]
        entries += [*numbers((row.ap_a, row.ap_b)), gap, f"[{low}, {high}]"]
        verdict = "significant" if row.is_significant else "not significant"
        body.append([*entries, f"{row.p_adjusted:.3f}", verdict])
    title = (
        f"B = {run_b} against A = {run_a}: 95 % intervals over sequences, p after Holm"
    )
    return Table(title, [*header, "Difference"], body)


# Behind the APs -----------------------------------------------------------------------


def detail_tables(metrics: Mapping[str, Any]) -> list[Table]:
    """Every table of what lies behind the APs, from the content of metrics.json."""
    kinds = [kind for kind in metrics["subsets"] if kind != "protocol"]
    header = ["Frame", "Name", "Sequence", "Missed", "False", "Found"]
    worst = [
        [entry.get(name.lower(), "") for name in header]
        for entry in metrics["worst_frames"]
    ]
    return [
        *(subset_table(metrics["subsets"], kind) for kind in kinds),
        error_table(metrics["box_errors"]),
        Table("Frames with the most mistakes", header, worst),
    ]


def subset_table(subsets: Mapping[str, Any], kind: str) -> Table:
    """AP, precision and recall per subset and class that has boxes."""
    return Table(
        f"By {kind}, {subsets['protocol']}",
        [kind.capitalize(), "Class", "AP", "Precision", "Recall", "Objects"],
        [
            [
                entry[kind],
                entry["cls"],
                *numbers(entry[name] for name in ("ap", "precision", "recall")),
                entry["num_gt"],
            ]
            for entry in subsets[kind]
            if entry["num_gt"] or entry["num_det"]
        ],
    )


def error_table(errors: Mapping[str, Mapping[str, float]]) -> Table:
    """Median errors of matched boxes, and how many headings are reversed."""
    body: list[list[str | int]] = []
    for cls, found in errors.items():
        medians = (
            number(found[f"{key}_median"], digits=digits) for key, _, digits in ERRORS
        )
        body.append([cls, int(found["count"]), *medians, number(found["reversed"])])
    return Table(
        "Median errors of matched boxes (all scores); reversed: heading off by more"
        " than 90 deg",
        ["Class", "Matches", *(title for _, title, _ in ERRORS), "Reversed"],
        body,
    )


# Published rows -----------------------------------------------------------------------

CONDITIONS = ("all", *WEATHERS)

NOTE = (
    "Differences are printed to rows with the same protocol, labels, region and split; "
    "score thresholds, classes and frames may still differ."
)

Cell = tuple[str, str, str, float]
"""Condition, class, space and IoU threshold."""

Place = dict[str, Any]
"""Some of the four by name, as keywords of a layout; the others are the usual ones."""

SPACES: list[Place] = [{"space": space} for space in SPACE_TITLES]
_USUAL: Place = {"condition": "all", "cls": "Sedan", "space": "3d", "iou": 0.3}


@dataclasses.dataclass(frozen=True)
class PublishedRow:
    """One row of a published table.

    Attributes:
        paper: "RADE-Net" or "DinoRADE".
        table: Number of the table as printed.
        method: Name of the row; in ablations what the row ticks.
        modality: L lidar, C camera, R radar.
        label_version: K-Radar label revision.
        protocol: Evaluation protocol as far as known.
        note: What a reader should know.
        values: APs as printed; the class "mean" is the paper's mAP.
    """

    paper: str
    table: str
    method: str
    modality: str
    label_version: str
    protocol: str
    note: str
    values: dict[Cell, str]

    @property
    def source(self) -> str:
        """Paper and table."""
        return f"{self.paper}, Table {self.table}"

    def differences(
        self,
        cells: Sequence[Cell],
        ours: Sequence[float | None],
        options: EvaluationOptions,
        split: str | None,
    ) -> list[str]:
        """Our APs minus the printed ones; "-" where there is none to compare with.

        A mean is compared only with one over the same classes.
        """
        is_comparable = (
            options.paper_protocol == self.protocol
            and options.label_version == self.label_version
            and roi_name(options.roi) == "narrow"
            and split == "test"
        )
        classes = {cls for _, cls, *_ in self.values} - {"mean"}
        differences = []
        for cell, ap in zip(cells, ours, strict=True):
            printed = self.values.get(cell, "-")
            is_same = cell[1] != "mean" or classes == set(options.classes)
            if not (is_comparable and is_same) or ap is None or printed == "-":
                differences.append("-")
            else:
                differences.append(number(ap - float(printed), signed=True))
        return differences


def _read() -> tuple[PublishedRow, ...]:
    """The rows of `published.csv`."""
    names = [field.name for field in dataclasses.fields(PublishedRow)][:-1]
    text = importlib.resources.files(__package__) / "published.csv"
    rows: dict[tuple[str, ...], PublishedRow] = {}
    for line in csv.DictReader(text.read_text(encoding="utf-8").splitlines()):
        fields = {name: line[name] for name in names}
        row = rows.setdefault(tuple(fields.values()), PublishedRow(**fields, values={}))
        for condition in filter(line.get, CONDITIONS):
            cell = condition, line["cls"], line["space"], float(line["iou"])
            row.values[cell] = line[condition]
    return tuple(rows.values())


PUBLISHED = _read()
"""All rows of all result tables of both papers."""


# A run in the layouts of the papers ---------------------------------------------------


def paper_tables(
    runs: Mapping[str, Results], options: EvaluationOptions, split: str | None
) -> list[Table]:
    """All tables that the results allow, in the order of the papers.

    Args:
        runs: Results by the name of the run, of frames that are not simulated.
        options: Of the evaluation.
        split: Split of the frames, None if it is not known.
    """
    if 0.3 not in options.iou_thresholds:
        return []
    classes = [{"cls": cls} for cls in (*options.classes, "mean")]
    conditions = [{"condition": name} for name in CONDITIONS]
    layouts: list[tuple[str, Sequence[str], list[Place], list[Place]]] = [
        (
            "Classes by weather at IoU 0.3 (layout of Table II)",
            ["RADE-Net, Table II", "DinoRADE, Table 2"],
            classes,
            _crossed(conditions, SPACES),
        ),
        (
            "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3)",
            ["DinoRADE, Table 3"],
            [{"condition": "all"}],
            _crossed(classes, SPACES),
        ),
    ]
    built = [_layout(*layout, runs, options, split) for layout in layouts]
    if "Sedan" not in options.classes:
        return built
    one = _layout(
        "Sedan by weather at IoU 0.3 (layout of Table I)",
        ["RADE-Net, Table I", "DinoRADE, Table 1"],
        SPACES,
        conditions,
        runs,
        options,
        split,
    )
    return [one, *built, ablations(runs, options)]


def ablations(
    runs: Mapping[str, Results],
    options: EvaluationOptions,
    *,
    is_simulated: bool = False,
) -> Table:
    """Sedan AP at IoU 0.3 and 0.5 with the ablations of the papers, no differences.

    Args:
        runs: Results by the name of the run.
        options: Of the evaluations.
        is_simulated: Omit the published rows.
    """
    return _layout(
        "Ablations, Sedan (layout of Table III)",
        [] if is_simulated else ["RADE-Net, Table III", "DinoRADE, Table 4"],
        [{"cls": "Sedan"}],
        _crossed([{"iou": 0.3}, {"iou": 0.5}], SPACES),
        runs,
        options,
        split=None,
    )


def _crossed(outer: Sequence[Place], inner: Sequence[Place]) -> list[Place]:
    return [{**one, **other} for one in outer for other in inner]


def _layout(
    title: str,
    sources: Sequence[str],
    groups: Sequence[Place],
    columns: Sequence[Place],
    runs: Mapping[str, Results],
    options: EvaluationOptions,
    split: str | None,
) -> Table:
    """Published rows, each with the difference to it where there is one, then ours.

    Args:
        title: Of the table.
        sources: Papers and tables whose rows to print.
        groups: What the rows of each group are of.
        columns: What the columns are of.
        runs: Results by the name of the run; differences are those of the first.
        options: Of the evaluation.
        split: Split of the frames; None for no differences.
    """
    body: list[list[str]] = []
    for group in groups:
        places = [{**_USUAL, **group, **column} for column in columns]
        cells = [(p["condition"], p["cls"], p["space"], p["iou"]) for p in places]
        of, printed = _name(group), []
        first, protocol = next(iter(runs.values())), options.paper_protocol
        compared = [ap_of(first, protocol, *cell) for cell in cells]
        for row in PUBLISHED:
            values = [row.values.get(cell, "-") for cell in cells]
            # Both papers copy the same rows.
            is_repeated = [row.method, *values] in printed
            if row.source not in sources or set(values) == {"-"} or is_repeated:
                continue
            printed.append([row.method, *values])
            terms = f"{row.protocol}, labels={row.label_version}"
            name = f"{row.method} ({row.modality})"
            body.append([name, of, row.source, terms, *values])
            gaps = row.differences(cells, compared, options, split)
            if set(gaps) != {"-"}:
                body.append(["difference", of, row.source, "", *gaps])
        for (name, results), protocol in itertools.product(
            runs.items(), options.main_protocols
        ):
            aps = [ap_of(results, protocol, *cell) for cell in cells]
            body.append([name, of, "", terms_of(results, protocol), *numbers(aps)])
    header = ["Method", "Of", "Source", "Terms", *map(_name, columns)]
    return Table(title, header, body, NOTE if split else "")


def _name(place: Place) -> str:
    """Title of what a group or a column is of, such as "Light Snow BEV"."""
    names = {0.3: "IoU 0.3", 0.5: "IoU 0.5"} | TITLES | SPACE_TITLES
    return " ".join(str(names.get(value, value)) for value in place.values())
