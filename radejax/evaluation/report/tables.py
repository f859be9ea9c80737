"""Tables of a report, as text, Markdown and LaTeX.

APs come from measured rows by key (`index`); what lies behind them (slices, box errors,
calibration, confusion, worst frames) from the content of metrics.json.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tabulate import tabulate

from radejax.data.kradar.sequences import WEATHERS
from radejax.evaluation.report.bootstrap import Comparison
from radejax.evaluation.report.measure import Measured, Options

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
WIDEST_IN_A_COLUMN = (
    7  # columns of a table; more of them stand across the page in LaTeX
)
Key = tuple[str, str, str, str, float]  # protocol, condition, class, space, IoU


@dataclasses.dataclass(frozen=True)
class Table:
    """A table ready to be rendered.

    Attributes:
        title: One line that says what the numbers are.
        header: `[K]` column titles.
        rows: Rows of `K` strings or counts.
        notes: Lines under the table.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str | int]]
    notes: Sequence[str] = ()

    def render(self, style: str = "text") -> str:
        """As "text", "markdown" or "latex"."""
        align = ["left", *["right"] * (len(self.header) - 1)]
        body = tabulate(
            self.rows, self.header, STYLES[style], disable_numparse=True, colalign=align
        )
        if style == "latex":
            kind = "table*" if len(self.header) > WIDEST_IN_A_COLUMN else "table"
            lines = [
                f"\\begin{{{kind}}}[t]",
                f"\\centering\\footnotesize\n\\caption{{{_latex(self.title)}}}",
                f"\\begin{{adjustbox}}{{max width=\\linewidth}}\n{body}",
                "\\end{adjustbox}",
                *(f"\\par {_latex(note)}" for note in self.notes),
                f"\\end{{{kind}}}\n",
            ]
            return "\n".join(lines)
        title = f"**{self.title}**" if style == "markdown" else self.title
        below = "".join(f"\n{note}\n" for note in self.notes)
        return f"{title}\n\n{body}\n{below}"

    def of_simulated(self) -> Table:
        """The same, saying that its numbers are of simulated data."""
        return dataclasses.replace(self, title=f"Simulated data: {self.title}")


def _latex(text: str) -> str:
    """Text with what LaTeX takes for commands, and in its old fonts for other signs."""
    signs = {sign: f"\\{sign}" for sign in "&%$#_{}"}
    signs |= {"\\": "\\textbackslash{}", ">": "$>$", "<": "$<$", "~": "$\\sim$"}
    return "".join(signs.get(sign, sign) for sign in text)


def index(rows: Sequence[Measured]) -> dict[Key, Measured]:
    """Measured rows by (protocol, condition, class, space, IoU)."""
    return {row.key: row for row in rows if row.kind in ("all", "weather")}


def number(value: float | None, *, signed: bool = False, digits: int = 2) -> str:
    """A value as the papers print it; `-` for one that does not exist."""
    if value is None or value != value:
        return "-"
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def numbers(values: Iterable[float | None], digits: int = 2) -> list[str]:
    """Values as cells of a table."""
    return [number(value, digits=digits) for value in values]


def shown(rows: Mapping[Key, Measured], key: Key) -> float | None:
    """AP of a key; None where the class does not occur or nothing was measured."""
    row = rows.get(key)
    return None if row is None else row.shown


RARE_NOTE = "*: under 2 % of the training objects of that weather in the region."


def marked(options: Options, cls: str, condition: str, cell: str) -> str:
    """The cell, with the mark of a class that is hardly trained on in that condition."""
    is_rare = (cls, condition) in options.rare and cell.strip("-/ ") != ""
    return f"*{cell}" if is_rare else cell


def rare_notes(options: Options) -> list[str]:
    """The line below a table with marks."""
    return [RARE_NOTE] if options.rare else []


def terms(rows: Mapping[Key, Measured], protocol: str) -> str:
    """Score cut, frame rule, label version and region, once per table."""
    for key, row in rows.items():
        if key[0] == protocol:
            return ", " + ", ".join(row.result.metric.split("/")[2:])
    return ""


def class_by_weather(
    rows: Mapping[Key, Measured], options: Options, protocol: str, iou: float
) -> Table:
    """Classes by total and weathers, "3D / BEV" in each cell: one protocol at a glance."""
    present = dict.fromkeys(key[1] for key in rows)
    conditions = [name for name in TITLES if name in present]
    conditions += [name for name in present if name not in TITLES]
    body = []
    for cls in (*options.classes, "mean"):
        pairs = (
            [shown(rows, (protocol, name, cls, space, iou)) for space in SPACE_TITLES]
            for name in conditions
        )
        cells = (" / ".join(numbers(pair)) for pair in pairs)
        marks = zip(conditions, cells, strict=True)
        body.append([cls, *(marked(options, cls, name, cell) for name, cell in marks)])
    return Table(
        f"AP 3D / BEV at IoU {iou:g}, {protocol}{terms(rows, protocol)}",
        ["Class", *(TITLES.get(name, name) for name in conditions)],
        body,
        rare_notes(options),
    )


def protocols_at_a_glance(
    rows: Mapping[Key, Measured], options: Options, space: str, iou: float
) -> Table:
    """Protocols by classes, all weathers: how much the protocol matters."""
    classes = (*options.classes, "mean")
    body = []
    for protocol in options.protocols:
        values = (shown(rows, (protocol, "all", cls, space, iou)) for cls in classes)
        body.append([protocol, *numbers(values)])
    return Table(
        f"AP {SPACE_TITLES[space]} at IoU {iou:g} in every protocol, all weathers",
        ["Protocol", *classes],
        body,
    )


def intervals(rows: Mapping[Key, Measured], options: Options, iou: float) -> Table:
    """AP with its 95 % interval over sequences, all weathers."""
    classes = (*options.classes, "mean")
    body = []
    for protocol, space in itertools.product(options.main_protocols, SPACE_TITLES):
        keys = ((protocol, "all", cls, space, iou) for cls in classes)
        cells = (_with_interval(rows.get(key)) for key in keys)
        body.append([protocol, SPACE_TITLES[space], *cells])
    return Table(
        f"AP at IoU {iou:g} with 95 % intervals ({options.bootstrap} resamples of"
        " sequences)",
        ["Protocol", "AP", *classes],
        body,
    )


def _with_interval(row: Measured | None) -> str:
    if row is None or row.shown is None or row.low is None:
        return number(None if row is None else row.shown)
    ap, low, high = numbers((row.shown, row.low, row.high), digits=1)
    return f"{ap} [{low}, {high}]"


def comparison(rows: Sequence[Comparison], run_a: str, run_b: str) -> Table:
    """Two runs and which of their differences are real."""
    header = [
        "Class",
        "Protocol",
        "AP",
        "IoU",
        "A",
        "B",
        "B - A",
        "95 %",
        "p",
        "Difference",
    ]
    body = []
    for row in rows:
        gap, low, high = (
            number(value, signed=True) for value in (row.difference, row.low, row.high)
        )
        cells = [row.cls, row.protocol, SPACE_TITLES[row.space], f"{row.iou:g}"]
        cells += [*numbers((row.ap_a, row.ap_b)), gap, f"[{low}, {high}]"]
        cells += [f"{row.p_adjusted:.3f}", "real" if row.is_real else "not shown"]
        body.append(cells)
    title = (
        f"B = {run_b} against A = {run_a}: 95 % intervals over sequences, p after Holm"
    )
    return Table(title, header, body)


# Behind the APs -----------------------------------------------------------------------


def detail_tables(metrics: Mapping[str, Any]) -> list[Table]:
    """Every table of what lies behind the APs, from the content of metrics.json."""
    kinds = [kind for kind in metrics["slices"] if kind != "protocol"]
    return [
        *(slice_table(metrics["slices"], kind) for kind in kinds),
        error_table(metrics["box_errors"]),
        calibration_table(metrics["calibration"]),
        confusion_table(metrics["confusion"]),
        worst_table(metrics["worst_frames"]),
    ]


def slice_table(slices: Mapping[str, Any], kind: str) -> Table:
    """AP, precision and recall per slice and class; slices without anything are left."""
    return Table(
        f"By {kind}, {slices['protocol']}",
        [kind.capitalize(), "Class", "AP", "Precision", "Recall", "Objects"],
        [
            [
                entry[kind],
                entry["cls"],
                *numbers(entry[name] for name in ("ap", "precision", "recall")),
                entry["num_gt"],
            ]
            for entry in slices[kind]
            if entry["num_gt"] or entry["num_det"]
        ],
    )


def error_table(errors: Mapping[str, Mapping[str, float]]) -> Table:
    """Median errors of matched boxes, and how many headings are reversed."""
    body = []
    for cls, found in errors.items():
        medians = (
            number(found[f"{key}_median"], digits=digits) for key, _, digits in ERRORS
        )
        body.append([cls, found["count"], *medians, number(found["reversed"])])
    return Table(
        "Median errors of matched boxes (all scores); reversed: heading off by more"
        " than 90 deg",
        ["Class", "Matches", *(title for _, title, _ in ERRORS), "Reversed"],
        body,
    )


def calibration_table(bins: Mapping[str, Mapping[str, Any]]) -> Table:
    """Precision of predictions by score, and the calibration error."""
    first = next(iter(bins.values()))
    edges = zip(first["low"], first["high"], strict=True)
    return Table(
        "Share of predictions that are right, by score",
        ["Class", *(f"{low:g}-{high:g}" for low, high in edges), "Error"],
        [
            [cls, *numbers(found["precision"]), number(found["error"], digits=3)]
            for cls, found in bins.items()
        ],
    )


def confusion_table(confusion: Mapping[str, Any]) -> Table:
    """True classes by predicted ones."""
    labels = confusion["labels"]
    return Table(
        "Confusion: true class in rows, predicted class in columns; none: missed,"
        " or nothing there",
        ["", *labels],
        [[label, *row] for label, row in zip(labels, confusion["counts"], strict=True)],
    )


def worst_table(worst: list[dict]) -> Table:
    """Frames with the most mistakes."""
    header = ["Frame", "Name", "Sequence", "Missed", "False", "Found"]
    rows = [[entry.get(name.lower(), "") for name in header] for entry in worst]
    return Table("Frames with the most mistakes", header, rows)
