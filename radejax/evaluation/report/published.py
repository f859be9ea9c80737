"""Every number in the result tables of the RADE-Net and DinoRADE papers.

They lie in `published.csv`, one line a class of a printed row, in the order of the papers:
average precisions in percent, "-" where a paper prints that, nothing where its table has
no such column. What a paper does not say is marked so; "floor" values (0.99 = 1/101) are
kept as printed. Two rows of RADE-Net's Table III tick the same columns in the paper.

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

from radejax.data.kradar.sequences import WEATHERS

CONDITIONS = ("all", *WEATHERS)

AUTHORS_PROTOCOL = "coco101"
"""RADE-Net's and DinoRADE's own rows: RADE-Net's evaluator, 101 recall levels, frames
without the class left out (the printed 0.99 is its floor 1/101)."""

COPIED = "not stated (copied from earlier work)"


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


def _read() -> list[PublishedRow]:
    """The rows of `published.csv`; lines that differ only in the class are one row."""
    names = [field.name for field in dataclasses.fields(PublishedRow)][:-1]
    text = importlib.resources.files(__package__) / "published.csv"
    lines = csv.DictReader(text.read_text(encoding="utf-8").splitlines())
    rows = []
    for key, group in itertools.groupby(lines, lambda line: [line[n] for n in names]):
        values = {
            (line["cls"], condition): None if cell == "-" else float(cell)
            for line in group
            for condition in CONDITIONS
            if (cell := line[condition])
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
