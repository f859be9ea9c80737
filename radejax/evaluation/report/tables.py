"""Tables of a report, as text, Markdown and LaTeX."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from tabulate import tabulate

from radejax.evaluation.report.bootstrap import Comparison
from radejax.evaluation.report.measure import Measured, Options

TITLES = {
    "all": "Total",
    "normal": "Normal",
    "overcast": "Overcast",
    "fog": "Fog",
    "rain": "Rain",
    "sleet": "Sleet",
    "lightsnow": "Light Snow",
    "heavysnow": "Heavy Snow",
}
SPACE_TITLES = {"3d": "3D", "bev": "BEV"}
Key = tuple[str, str, str, str, float]  # protocol, condition, class, space, IoU


@dataclasses.dataclass(frozen=True)
class Table:
    """A table ready to be rendered.

    Attributes:
        title: One line that says what the numbers are.
        header: `[K]` column titles.
        rows: Rows of `K` strings.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def render(self, style: str = "text") -> str:
        """As "text", "markdown" or "latex"."""
        name = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}[
            style
        ]
        align = ["left", *["right"] * (len(self.header) - 1)]
        body = tabulate(
            self.rows, self.header, name, disable_numparse=True, colalign=align
        )
        if style == "latex":
            return f"% {self.title}\n{body}\n"
        title = f"**{self.title}**" if style == "markdown" else self.title
        return f"{title}\n\n{body}\n"


def index(rows: Sequence[Measured]) -> dict[Key, Measured]:
    """Measured rows by (protocol, condition, class, space, IoU)."""
    return {
        (
            row.result.protocol,
            row.condition,
            row.result.cls,
            row.result.space,
            row.result.iou,
        ): row
        for row in rows
        if row.kind in ("all", "weather")
    }


def number(value: float | None, *, signed: bool = False, digits: int = 2) -> str:
    """A value as the papers print it; `-` for one that does not exist."""
    if value is None or value != value:
        return "-"
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def shown(rows: Mapping[Key, Measured], key: Key) -> float | None:
    """AP of a key; None where the class does not occur or nothing was measured."""
    row = rows.get(key)
    return None if row is None else row.shown


def class_by_weather(
    rows: Mapping[Key, Measured], options: Options, protocol: str, iou: float
) -> Table:
    """Classes by total and weathers, "3D / BEV" in each cell: one protocol at a glance."""
    present = dict.fromkeys(key[1] for key in rows)
    conditions = [name for name in TITLES if name in present]
    conditions += [name for name in present if name not in TITLES]
    body = []
    for cls in (*options.classes, "mean"):
        cells = [
            " / ".join(
                number(shown(rows, (protocol, condition, cls, space, iou)))
                for space in ("3d", "bev")
            )
            for condition in conditions
        ]
        body.append([cls, *cells])
    return Table(
        f"AP 3D / BEV at IoU {iou:g}, {protocol}{terms(rows, protocol)}",
        ["Class", *(TITLES.get(name, name) for name in conditions)],
        body,
    )


def terms(rows: Mapping[Key, Measured], protocol: str) -> str:
    """Score cut, frame rule, label version and region, once per table."""
    for key, row in rows.items():
        if key[0] == protocol:
            return ", " + ", ".join(row.result.metric.split("/")[2:])
    return ""


def protocols_at_a_glance(
    rows: Mapping[Key, Measured], options: Options, space: str, iou: float
) -> Table:
    """Protocols by classes, all weathers: how much the protocol matters."""
    body = [
        [
            protocol,
            *(
                number(shown(rows, (protocol, "all", cls, space, iou)))
                for cls in (*options.classes, "mean")
            ),
        ]
        for protocol in options.protocols
    ]
    return Table(
        f"AP {SPACE_TITLES[space]} at IoU {iou:g} in every protocol, all weathers",
        ["Protocol", *options.classes, "mean"],
        body,
    )


def intervals(rows: Mapping[Key, Measured], options: Options, iou: float) -> Table:
    """AP with its 95 % interval over sequences, all weathers."""
    chosen = [p for p in ("exact", "kradar_r40", "coco101") if p in options.protocols]
    body = []
    for protocol in chosen or options.protocols[:1]:
        for space in ("3d", "bev"):
            cells = []
            for cls in (*options.classes, "mean"):
                row = rows.get((protocol, "all", cls, space, iou))
                if row is None or row.shown is None:
                    cells.append("-")
                elif row.low is None:
                    cells.append(number(row.shown))
                else:
                    low, high = number(row.low, digits=1), number(row.high, digits=1)
                    cells.append(f"{number(row.shown, digits=1)} [{low}, {high}]")
            body.append([protocol, SPACE_TITLES[space], *cells])
    return Table(
        f"AP at IoU {iou:g} with 95 % intervals ({options.bootstrap} resamples of"
        " sequences)",
        ["Protocol", "AP", *options.classes, "mean"],
        body,
    )


def comparison(rows: Sequence[Comparison], run_a: str, run_b: str) -> Table:
    """Two runs and which of their differences are real."""
    body = [
        [
            row.cls,
            row.protocol,
            SPACE_TITLES[row.space],
            f"{row.iou:g}",
            number(row.ap_a),
            number(row.ap_b),
            number(row.difference, signed=True),
            f"[{number(row.low, signed=True)}, {number(row.high, signed=True)}]",
            f"{row.p_adjusted:.3f}",
            "real" if row.is_real else "not shown",
        ]
        for row in rows
    ]
    return Table(
        f"B = {run_b} against A = {run_a}: 95 % intervals over sequences, p after Holm",
        [
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
        ],
        body,
    )
