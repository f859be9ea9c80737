"""The result tables of the RADE-Net and DinoRADE papers, and a run in their layouts.

The numbers are in `published.csv`, one line per class, space and IoU threshold of a
printed row, in the order of the papers: average precisions in percent, "-" where a paper
prints that, nothing where its table has no such column. Values of 0.99 (1/101, the lower
bound of the protocol) are kept as printed.

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
from collections.abc import Mapping, Sequence
from typing import Any

from radejax.data.kradar.conditions import WEATHERS
from radejax.evaluation.boxes import roi_name
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
        label_version: K-Radar label revision, and how it is known.
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

    @property
    def labels(self) -> str:
        """The label revision alone."""
        return self.label_version.split()[0]

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
            and options.label_version == self.labels
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
    protocol = options.paper_protocol
    settings = settings_text(results, protocol)
    ours = [(run, protocol, results)]
    classes = [{"cls": cls} for cls in (*options.classes, "mean")]
    conditions = [{"condition": name} for name in CONDITIONS]
    tables = [
        _layout(
            f"Classes by weather at IoU 0.3 (layout of Table II), {protocol}{settings}",
            ["RADE-Net, Table II", "DinoRADE, Table 2"],
            classes,
            _crossed(conditions, SPACES),
            ours,
            options,
            split,
        ),
        _layout(
            "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3), "
            f"{protocol}{settings}",
            ["DinoRADE, Table 3"],
            [{"condition": "all"}],
            _crossed(classes, SPACES),
            ours,
            options,
            split,
        ),
    ]
    if "Sedan" not in options.classes:
        return tables
    one = _layout(
        f"Sedan by weather at IoU 0.3 (layout of Table I){settings}",
        ["RADE-Net, Table I", "DinoRADE, Table 1"],
        SPACES,
        conditions,
        [(run, name, results) for name in options.main_protocols],
        options,
        split,
    )
    return [one, *tables, table_3({run: results}, options)]


def table_3(
    runs: Mapping[str, Results],
    options: EvaluationOptions,
    *,
    is_simulated: bool = False,
) -> Table:
    """Sedan AP of several runs at IoU 0.3 and 0.5 with the papers' ablations.

    Args:
        runs: Results by the name of the run.
        options: Of the evaluations.
        is_simulated: Omit the published rows.
    """
    protocol = options.paper_protocol
    return _layout(
        f"Ablations, Sedan (layout of Table III), {protocol}",
        [] if is_simulated else ["RADE-Net, Table III", "DinoRADE, Table 4"],
        [{"cls": "Sedan"}],
        _crossed([{"iou": 0.3}, {"iou": 0.5}], SPACES),
        [(name, protocol, results) for name, results in runs.items()],
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
    ours: Sequence[tuple[str, str, Results]],
    options: EvaluationOptions,
    split: str | None,
) -> Table:
    """Published rows, each with the difference to it where there is one, then ours.

    Args:
        title: Of the table.
        sources: Papers and tables whose rows to print.
        groups: What the rows of each group are of.
        columns: What the columns are of.
        ours: Name, protocol and results of our rows.
        options: Of the evaluation.
        split: Split of the frames; None for no differences.
    """
    body: list[list[str]] = []
    listed = [row for row in PUBLISHED if row.source in sources]
    for group in groups:
        places = [{**_USUAL, **group, **column} for column in columns]
        cells = [(p["condition"], p["cls"], p["space"], p["iou"]) for p in places]
        of, printed = _name(group), set()
        _, _, results = ours[0]
        compared = [ap_of(results, options.paper_protocol, *cell) for cell in cells]
        for row in listed:
            values = [row.values.get(cell, "-") for cell in cells]
            is_repeated = (
                row.method,
                *values,
            ) in printed  # copied from the other paper
            if set(values) == {"-"} or is_repeated:
                continue
            printed.add((row.method, *values))
            terms = [row.source, row.protocol, row.labels]
            body.append([f"{row.method} ({row.modality})", of, *terms, *values])
            gaps = row.differences(cells, compared, options, split)
            if set(gaps) != {"-"}:
                body.append(["difference", of, row.source, "", "", *gaps])
        for name, protocol, results in ours:
            aps = [ap_of(results, protocol, *cell) for cell in cells]
            body.append([name, of, "", protocol, "", *numbers(aps)])
    header = ["Method", "Of", "Source", "Protocol", "Labels", *map(_name, columns)]
    return Table(title, header, body, NOTE if split else "")


def _name(place: Place) -> str:
    """Title of what a group or a column is of, such as "Light Snow BEV"."""
    names = {0.3: "IoU 0.3", 0.5: "IoU 0.5"} | TITLES | SPACE_TITLES
    return " ".join(str(names.get(value, value)) for value in place.values())
