"""The result tables of the RADE-Net and DinoRADE papers, and a run in their layouts.

The numbers are in `published.csv`, one line per class of a printed row, in the order of
the papers: average precisions in percent, "-" where a paper prints that, nothing where
its table has no such column. Values of 0.99 (1/101, the lower bound of the protocol) are
kept as printed. Two rows of RADE-Net's Table III tick the same columns in the paper.

A difference to a published row is printed only where protocol, labels, region and split
agree. Results of simulated frames are not printed next to published rows.

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

from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation.boxes import roi_name
from radejax.evaluation.protocols import AUTHORS_PROTOCOL, RECOMMENDED
from radejax.evaluation.results import EvaluationOptions
from radejax.evaluation.tables import (
    SPACE_TITLES,
    TITLES,
    Results,
    Table,
    ap_of,
    number,
    numbers,
    settings_text,
)

CONDITIONS = ("all", *WEATHERS)
COPIED = "not stated (copied from earlier work)"

NOTE = (
    "Differences are printed to rows with the same protocol, labels, region and split; "
    "score thresholds, classes and frames may still differ."
)


@dataclasses.dataclass(frozen=True)
class PublishedRow:
    """One row of a published table.

    Attributes:
        paper: "RADE-Net" or "DinoRADE".
        table: Number of the table as printed.
        method: Name of the row; in ablations what the row ticks.
        modality: L lidar, C camera, R radar; "" where the table has no such column.
        label_version: K-Radar label revision.
        protocol: Evaluation protocol as far as known.
        space: "3d" or "bev".
        iou: IoU threshold.
        note: What a reader should know.
        values: AP by (class, condition); the class "mean" is the paper's mAP.
    """

    paper: str
    table: str
    method: str
    modality: str
    label_version: str
    protocol: str
    space: str
    iou: float
    note: str
    values: dict[tuple[str, str], float | None]

    @property
    def source(self) -> str:
        """Paper and table."""
        return f"{self.paper}, Table {self.table}"

    def get(self, cls: str, condition: str = "all") -> float | None:
        """The printed value, None where there is none."""
        return self.values.get((cls, condition))

    def is_comparable(self, options: EvaluationOptions, split: str | None) -> bool:
        """Whether protocol, labels, region and split are those of a run."""
        return (
            options.paper_protocol == self.protocol
            and options.label_version == self.label_version.split()[0]
            and roi_name(options.roi) == "narrow"
            and split == "test"
        )


def _read() -> list[PublishedRow]:
    """The rows of `published.csv`; lines that differ only in the class are one row."""
    names = [field.name for field in dataclasses.fields(PublishedRow)][:-1]
    text = importlib.resources.files(__package__) / "published.csv"
    lines = csv.DictReader(text.read_text(encoding="utf-8").splitlines())
    rows = []
    for key, group in itertools.groupby(lines, lambda line: [line[n] for n in names]):
        values = {
            (line["cls"], condition): None if entry == "-" else float(entry)
            for line in group
            for condition in CONDITIONS
            if (entry := line[condition])
        }
        shared = dict(zip(names, key, strict=True)) | {"iou": float(key[7])}
        rows.append(PublishedRow(**shared, values=values))
    return rows


PUBLISHED = tuple(_read())
"""All rows of all result tables of both papers."""


def published_rows(
    paper: str | None = None, table: str | None = None, **fields: str | float
) -> list[PublishedRow]:
    """The rows that match all given fields (method, space, iou), in the papers' order."""
    wanted = {"paper": paper, "table": table, **fields}
    return [
        row
        for row in PUBLISHED
        if all(value in (None, getattr(row, key)) for key, value in wanted.items())
    ]


# A run in the layouts of the papers ---------------------------------------------------


def paper_tables(
    results: Results, options: EvaluationOptions, run: str, split: str | None
) -> list[Table]:
    """All tables that the results allow, in the order of the papers.

    Args:
        results: By key, of frames that are not simulated.
        options: Of the evaluation.
        run: Name of the run.
        split: Split of the frames, None if it is not known.
    """
    if 0.3 not in options.iou_thresholds:
        return []
    tables = [
        table_2(results, options, run, split),
        table_3_dinorade(results, options, run, split),
    ]
    if "Sedan" in options.classes:
        tables.insert(0, table_1(results, options, run, split))
        tables.append(table_3({run: results}, options.paper_protocol))
    return tables


def _differences(
    ours: Iterable[float | None], theirs: Iterable[float | None]
) -> list[str]:
    """Our values minus theirs where both exist."""
    return [
        number(None if a is None or b is None else a - b, signed=True)
        for a, b in zip(ours, theirs, strict=True)
    ]


def table_1(
    results: Results, options: EvaluationOptions, run: str, split: str | None
) -> Table:
    """Sedan by weather with RADE-Net's Table I and DinoRADE's Table 1, at IoU 0.3."""
    body: list[list[str]] = []
    for space, title in SPACE_TITLES.items():
        ours = {
            protocol: [
                ap_of(results, protocol, name, "Sedan", space, 0.3)
                for name in CONDITIONS
            ]
            for protocol in dict.fromkeys(
                (options.paper_protocol, "kradar_r40", RECOMMENDED)
            )
            if protocol in options.protocols
        }
        gaps, seen = [], set()
        for row in [
            *published_rows("RADE-Net", "I", space=space, iou=0.3),
            *published_rows("DinoRADE", "1", space=space, iou=0.3),
        ]:
            theirs = [row.get("Sedan", name) for name in CONDITIONS]
            entries = numbers(theirs, digits=1)
            if (row.method, *entries) not in seen:  # both papers copy the same rows
                body.append([row.method, row.source, row.modality, title, *entries])
            seen.add((row.method, *entries))
            if row.is_comparable(options, split):
                gap = _differences(ours[row.protocol], theirs)
                gaps.append([f"{run} - {row.method}", row.source, "", title, *gap])
        body += [[run, name, "", title, *numbers(aps)] for name, aps in ours.items()]
        body += gaps
    return Table(
        "Sedan by weather at IoU 0.3 (layout of Table I)"
        f"{settings_text(results, options.paper_protocol)}",
        ["Network", "Source", "Modality", "AP", *(TITLES[name] for name in CONDITIONS)],
        body,
        NOTE,
    )


def table_2(
    results: Results, options: EvaluationOptions, run: str, split: str | None
) -> Table:
    """Class by weather at IoU 0.3 with RADE-Net's and DinoRADE's rows."""
    protocol = options.paper_protocol
    columns = list(itertools.product(CONDITIONS, SPACE_TITLES))
    papers = [("RADE-Net", "II"), ("DinoRADE", "2")]
    listed = [{r.space: r for r in published_rows(*at, iou=0.3)} for at in papers]
    body = []
    for cls in (*options.classes, "mean"):
        ours = [
            ap_of(results, protocol, name, cls, space, 0.3) for name, space in columns
        ]
        body.append([cls, run, *numbers(ours)])
        for row in filter(None, listed):
            theirs = [row[space].get(cls, name) for name, space in columns]
            if any(value is not None for value in theirs):
                body += _with_difference(
                    [cls, row["3d"].source],
                    cls,
                    row["3d"],
                    ours,
                    theirs,
                    options,
                    split,
                )
    titles = [f"{TITLES[name]} {SPACE_TITLES[space]}" for name, space in columns]
    return Table(
        "Classes by weather at IoU 0.3 (layout of Table II), "
        f"{protocol}{settings_text(results, protocol)}",
        ["Class", "Source", *titles],
        body,
        NOTE,
    )


def _with_difference(
    names: list[str],
    cls: str,
    row: PublishedRow,
    ours: Sequence[float | None],
    theirs: Sequence[float | None],
    options: EvaluationOptions,
    split: str | None,
) -> list[list[str]]:
    """A published row and, where it is comparable, the difference to it.

    A mean is comparable only if it is over the same classes.
    """
    rows = [[*names, *numbers(theirs)]]
    printed = {name for name, _ in row.values} - {"mean"}
    is_same = cls != "mean" or printed == set(options.classes)
    if is_same and row.is_comparable(options, split):
        rows.append([names[0], "difference", *_differences(ours, theirs)])
    return rows


def table_3_dinorade(
    results: Results, options: EvaluationOptions, run: str, split: str | None
) -> Table:
    """Classes over all weathers with DinoRADE's Table 3."""
    protocol = options.paper_protocol
    columns = list(itertools.product(("mean", *options.classes), SPACE_TITLES))
    ours = [ap_of(results, protocol, "all", cls, space, 0.3) for cls, space in columns]
    body = []
    listed = published_rows("DinoRADE", "3")
    for method in dict.fromkeys(row.method for row in listed):
        by_space = {row.space: row for row in listed if row.method == method}
        theirs = [by_space[space].get(cls) for cls, space in columns]
        row = by_space["3d"]
        body += _with_difference(
            [method, row.source], "mean", row, ours, theirs, options, split
        )
    body.append([run, protocol, *numbers(ours)])
    titles = [
        f"{'Total' if cls == 'mean' else cls} {SPACE_TITLES[space]}"
        for cls, space in columns
    ]
    return Table(
        "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3), "
        f"{protocol}{settings_text(results, protocol)}",
        ["Method", "Source", *titles],
        body,
        NOTE,
    )


def table_3(
    runs: Mapping[str, Results],
    protocol: str = AUTHORS_PROTOCOL,
    *,
    is_simulated: bool = False,
) -> Table:
    """Sedan AP of several runs at IoU 0.3 and 0.5 with the papers' ablations.

    Args:
        runs: Results by the name of the run.
        protocol: Protocol of our rows.
        is_simulated: Omit the published rows.
    """
    columns = [(space, iou) for iou in (0.3, 0.5) for space in SPACE_TITLES]
    body = []
    sources = ((("RADE-Net", "III"), 4), (("DinoRADE", "4"), 2))
    for source, size in () if is_simulated else sources:
        listed = published_rows(*source)
        for start in range(0, len(listed), size):  # one printed row at a time
            group = listed[start : start + size]
            values = {(row.space, row.iou): row.get("Sedan") for row in group}
            entries = numbers(map(values.get, columns))
            body.append([group[0].method, group[0].source, *entries])
    for name, results in runs.items():
        aps = (ap_of(results, protocol, "all", "Sedan", *column) for column in columns)
        body.append([name, protocol, *numbers(aps)])
    titles = [f"{SPACE_TITLES[space]} IoU={iou:g}" for space, iou in columns]
    return Table(
        f"Ablations, Sedan (layout of Table III), {protocol}",
        ["Configuration", "Source", *titles],
        body,
    )
