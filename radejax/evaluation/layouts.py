"""Tables in the layouts of the papers, as text, Markdown and LaTeX."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from tabulate import tabulate

from radejax.evaluation import published
from radejax.evaluation.bootstrap import Comparison
from radejax.evaluation.measure import Measured, Options

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


def _shown(rows: Mapping[Key, Measured], key: Key) -> float | None:
    row = rows.get(key)
    return None if row is None else row.shown


def _difference(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or theirs is None else ours - theirs


def class_by_weather(
    rows: Mapping[Key, Measured], options: Options, protocol: str, iou: float
) -> Table:
    """Classes by total and weathers, "3D / BEV" in each cell: one protocol at a glance."""
    conditions = [name for name in TITLES if any(key[1] == name for key in rows)]
    body = []
    for cls in (*options.classes, "mean"):
        cells = [
            " / ".join(
                number(_shown(rows, (protocol, condition, cls, space, iou)))
                for space in ("3d", "bev")
            )
            for condition in conditions
        ]
        body.append([cls, *cells])
    return Table(
        f"AP 3D / BEV at IoU {iou:g}, {protocol}{_terms(rows, protocol)}",
        ["Class", *(TITLES[name] for name in conditions)],
        body,
    )


def _terms(rows: Mapping[Key, Measured], protocol: str) -> str:
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
                number(_shown(rows, (protocol, "all", cls, space, iou)))
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
    shown = [p for p in ("exact", "kradar_r40", "coco101") if p in options.protocols]
    body = []
    for protocol in shown or options.protocols[:1]:
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


def table_1(rows: Mapping[Key, Measured], options: Options, iou: float = 0.3) -> Table:
    """Sedan by weather beside RADE-Net's Table I and DinoRADE's Table 1."""
    conditions = published.CONDITIONS
    body = []
    for space in ("3d", "bev"):
        listed = [
            *published.published_rows("RADE-Net", "I", space=space, iou=iou),
            *published.published_rows("DinoRADE", "1", space=space, iou=iou),
        ]
        seen = set()
        for row in listed:
            cells = [number(row.get("Sedan", name), digits=1) for name in conditions]
            if (row.method, *cells) in seen:
                continue  # both papers copy the same earlier rows
            seen.add((row.method, *cells))
            body.append(
                [row.method, row.source, row.modality, SPACE_TITLES[space], *cells]
            )
        body += _our_table_1_rows(rows, options, space, iou, listed)
    return Table(
        f"Sedan by weather at IoU {iou:g} (layout of Table I)"
        f"{_terms(rows, options.paper_protocol)}",
        ["Network", "Source", "Modality", "AP", *(TITLES[name] for name in conditions)],
        body,
    )


def _our_table_1_rows(
    rows: Mapping[Key, Measured],
    options: Options,
    space: str,
    iou: float,
    listed: Sequence[published.PublishedRow],
) -> list[list[str]]:
    """Our row in each protocol that matters, and differences to the papers' own rows."""
    body = []
    title = SPACE_TITLES[space]
    ours = {}
    for protocol in dict.fromkeys((options.paper_protocol, "kradar_r40", "exact")):
        if protocol not in options.protocols:
            continue
        ours[protocol] = [
            _shown(rows, (protocol, name, "Sedan", space, iou))
            for name in published.CONDITIONS
        ]
        cells = [number(value) for value in ours[protocol]]
        body.append([options.run, protocol, "", title, *cells])
    for row in listed:
        if row.protocol == options.paper_protocol and row.protocol in ours:
            cells = [
                number(_difference(value, row.get("Sedan", name)), signed=True)
                for value, name in zip(
                    ours[row.protocol], published.CONDITIONS, strict=True
                )
            ]
            body.append(
                [f"{options.run} - {row.method}", row.source, "", title, *cells]
            )
    return body


def table_2(rows: Mapping[Key, Measured], options: Options, iou: float = 0.3) -> Table:
    """Class by weather, 3D and BEV in turn, with RADE-Net's and DinoRADE's rows."""
    conditions = published.CONDITIONS
    body = []
    papers = {
        "RADE-Net, Table II": ("RADE-Net", "II"),
        "DinoRADE, Table 2": ("DinoRADE", "2"),
    }
    for cls in (*options.classes, "mean"):
        ours = [
            _shown(rows, (options.paper_protocol, name, cls, space, iou))
            for name in conditions
            for space in ("3d", "bev")
        ]
        body.append([cls, options.run, *map(number, ours)])
        for source, where in papers.items():
            by_space = {
                row.space: row for row in published.published_rows(*where, iou=iou)
            }
            theirs = [
                by_space[space].get(cls, name) if by_space else None
                for name in conditions
                for space in ("3d", "bev")
            ]
            if all(value is None for value in theirs):
                continue
            gaps = [_difference(a, b) for a, b in zip(ours, theirs, strict=True)]
            body.append([cls, source, *map(number, theirs)])
            body.append(
                [cls, "difference", *(number(value, signed=True) for value in gaps)]
            )
    header = [
        f"{TITLES[name]} {SPACE_TITLES[space]}"
        for name in conditions
        for space in ("3d", "bev")
    ]
    return Table(
        f"Classes by weather at IoU {iou:g} (layout of Table II), "
        f"{options.paper_protocol}{_terms(rows, options.paper_protocol)}",
        ["Class", "Source", *header],
        body,
    )


def table_3(
    runs: Mapping[str, Mapping[Key, Measured]],
    protocol: str = published.AUTHORS_PROTOCOL,
) -> Table:
    """Sedan AP of several runs at IoU 0.3 and 0.5 beside RADE-Net's Table III."""
    columns = [(space, iou) for iou in (0.3, 0.5) for space in ("3d", "bev")]
    body: list[list[str]] = []
    listed: dict[int, list[published.PublishedRow]] = {}
    rows = published.published_rows("RADE-Net", "III")
    for position, row in enumerate(rows):
        listed.setdefault(position // len(columns), []).append(row)
    for group in listed.values():
        values = {(row.space, row.iou): row.get("Sedan") for row in group}
        cells = [number(values[column]) for column in columns]
        body.append([group[0].method, group[0].source, *cells])
    for name, measured in runs.items():
        cells = [
            number(_shown(measured, (protocol, "all", "Sedan", space, iou)))
            for space, iou in columns
        ]
        body.append([name, protocol, *cells])
    return Table(
        f"Ablations, Sedan (layout of Table III), {protocol}",
        [
            "Configuration",
            "Source",
            *(f"{SPACE_TITLES[space]} IoU={iou:g}" for space, iou in columns),
        ],
        body,
    )
