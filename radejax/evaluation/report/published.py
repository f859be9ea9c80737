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
from typing import NamedTuple

from radejax.core.structures import CLASSES
from radejax.data.kradar.sequences import WEATHERS

CONDITIONS = ("all", *WEATHERS)

AUTHORS_PROTOCOL = "coco101"
"""RADE-Net's and DinoRADE's own rows: RADE-Net's evaluator, 101 recall levels, frames
without the class left out (the printed 0.99 is its floor 1/101)."""

TEST_FRAMES = 17_536
"""Frames of K-Radar's official test split, on which both papers evaluate."""

COPIED = "not stated (copied from earlier work)"


class Terms(NamedTuple):
    """What two average precisions must share to be compared.

    Attributes:
        protocol: Name of the protocol.
        labels: Label revision.
        classes: Those that the detector was made for, in order of their names.
        score_cut: Predictions need a score above this.
        skip: Frames left out: "class", "frame" or None.
        roi: Name of the region of interest.
        split: Of the data set.
        frames: Number of frames of the split.
    """

    protocol: str
    labels: str | None
    classes: tuple[str, ...]
    score_cut: float
    skip: str | None
    roi: str
    split: str | None
    frames: int

    def differences(self, theirs: Terms) -> str:
        """What is not the same: "labels: v1.1, ours v2.1; ..."; "" where nothing is."""
        return "; ".join(
            f"{name.replace('_', ' ')}: {_words(there)}, ours {_words(here)}"
            for name, here, there in zip(self._fields, self, theirs, strict=True)
            if here != there
        )


def _words(value: object) -> str:
    """A value of `Terms` in a sentence."""
    if isinstance(value, tuple):
        return " + ".join(value)
    return "not known" if value is None else str(value)


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

    @property
    def terms(self) -> Terms:
        """What the number depends on; those of copied rows are not known."""
        return Terms(
            protocol=self.protocol,
            labels=self.label_version.split()[0],
            classes=tuple(sorted(_CLASSES_OF_TABLE[self.paper, self.table])),
            score_cut=0.3,
            skip="class",
            roi="narrow",
            split="test",
            frames=TEST_FRAMES,
        )

    def get(self, cls: str, condition: str = "all") -> float | None:
        """The printed value, None where there is none."""
        return self.values.get((cls, condition))


_CLASSES_OF_TABLE = {
    ("RADE-Net", "I"): ("Sedan",),
    ("RADE-Net", "II"): CLASSES,
    ("RADE-Net", "III"): ("Sedan",),
    ("DinoRADE", "1"): ("Sedan",),
    ("DinoRADE", "2"): CLASSES,
    ("DinoRADE", "3"): CLASSES,
    # Its Sedan of R+C+W is that of Table 3 to the last digit.
    ("DinoRADE", "4"): CLASSES,
}
"""Classes of the detectors behind a table, which may print fewer."""


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
