"""Tables of what lies behind the APs: slices, box errors, calibration, confusion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from radejax.evaluation.report.tables import Table, number

ERRORS = (
    ("center_m", "Center m", 2),
    ("z_m", "z m", 2),
    ("length_m", "Length m", 2),
    ("width_m", "Width m", 2),
    ("height_m", "Height m", 2),
    ("heading_deg", "Heading deg", 1),
    ("axis_deg", "Axis deg", 1),
)


def detail_tables(metrics: Mapping[str, Any]) -> list[Table]:
    """Every table of this module from the content of metrics.json."""
    slices = metrics["slices"]
    kinds = [kind for kind in slices if kind != "protocol"]
    return [
        *(slice_table(slices[kind], kind, slices["protocol"]) for kind in kinds),
        error_table(metrics["box_errors"]),
        calibration_table(metrics["calibration"]),
        confusion_table(metrics["confusion"]),
        worst_table(metrics["worst_frames"]),
    ]


def slice_table(entries: list[dict], kind: str, terms: str) -> Table:
    """AP, precision and recall per slice and class; slices without anything are left."""
    return Table(
        f"By {kind}, {terms}",
        [kind.capitalize(), "Class", "AP", "Precision", "Recall", "Objects"],
        [
            [
                entry[kind],
                entry["cls"],
                number(entry["ap"]),
                number(entry["precision"]),
                number(entry["recall"]),
                str(entry["num_gt"]),
            ]
            for entry in entries
            if entry["num_gt"] or entry["num_det"]
        ],
    )


def error_table(errors: Mapping[str, Mapping[str, float]]) -> Table:
    """Median errors of matched boxes, and how many headings are reversed."""
    return Table(
        "Median errors of matched boxes (all scores); reversed: heading off by more"
        " than 90 deg",
        ["Class", "Matches", *(title for _, title, _ in ERRORS), "Reversed"],
        [
            [
                cls,
                str(numbers["count"]),
                *(
                    number(numbers[f"{key}_median"], digits=digits)
                    for key, _, digits in ERRORS
                ),
                number(numbers["reversed"]),
            ]
            for cls, numbers in errors.items()
        ],
    )


def calibration_table(bins: Mapping[str, Mapping[str, Any]]) -> Table:
    """Precision of predictions by score, and the calibration error."""
    first = next(iter(bins.values()))
    edges = zip(first["low"], first["high"], strict=True)
    return Table(
        "Share of predictions that are right, by score",
        ["Class", *(f"{low:g}-{high:g}" for low, high in edges), "Error"],
        [
            [
                cls,
                *(number(value) for value in numbers["precision"]),
                number(numbers["error"], digits=3),
            ]
            for cls, numbers in bins.items()
        ],
    )


def confusion_table(confusion: Mapping[str, Any]) -> Table:
    """True classes by predicted ones."""
    labels = confusion["labels"]
    return Table(
        "Confusion: true class in rows, predicted class in columns; none: missed,"
        " or nothing there",
        ["", *labels],
        [
            [label, *(str(count) for count in row)]
            for label, row in zip(labels, confusion["counts"], strict=True)
        ],
    )


def worst_table(worst: list[dict]) -> Table:
    """Frames with the most mistakes."""
    return Table(
        "Frames with the most mistakes",
        ["Frame", "Name", "Sequence", "Missed", "False", "Found"],
        [
            [
                str(entry["frame"]),
                str(entry.get("name", "")),
                str(entry.get("sequence", "")),
                *(str(entry[key]) for key in ("missed", "false", "found")),
            ]
            for entry in worst
        ],
    )
