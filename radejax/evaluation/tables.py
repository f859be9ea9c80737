"""Tables of a report, as text, Markdown and LaTeX.

APs come from results by key (`index`); what lies behind them (subsets, box errors,
worst frames) from the content of metrics.json.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tabulate import tabulate

from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation.bootstrap import Comparison
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


def settings_text(results: Results, protocol: str) -> str:
    """Score threshold, empty-frame rule, label version and region of a protocol."""
    found = next(r for r in results.values() if r.protocol == protocol)
    return "".join(f", {part}" for part in found.metric.split("/")[2:])


def class_by_weather(
    results: Results, options: EvaluationOptions, protocol: str, iou: float
) -> Table:
    """Classes by total and weathers in one protocol, "3D / BEV" in each entry."""
    present = dict.fromkeys(key[1] for key in results)
    conditions = [name for name in TITLES if name in present]
    conditions += [name for name in present if name not in TITLES]
    body = []
    for cls in (*options.classes, "mean"):
        pairs = (
            [ap_of(results, protocol, name, cls, space, iou) for space in SPACE_TITLES]
            for name in conditions
        )
        body.append([cls, *(" / ".join(numbers(pair)) for pair in pairs)])
    return Table(
        f"AP 3D / BEV at IoU {iou:g}, {protocol}{settings_text(results, protocol)}",
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
