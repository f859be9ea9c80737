"""Tables of `ablation.py` with APs, differences with intervals, and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ablation_studies import Study

from radejax.core.structures import CLASSES
from radejax.evaluation.report import Table, number


def interval_text(row: Mapping[str, Any]) -> str:
    """Formats a difference as "+1.2 (0.3 to 2.1)", or "-" if the row has none."""
    if "difference" not in row:
        return "-"
    low, high = (number(row[name], digits=1) for name in ("low", "high"))
    return f"{number(row['difference'], signed=True, digits=1)} ({low} to {high})"


def tables(study: Study, rows: list[dict], claims: list[dict]) -> list[Table]:
    """Returns a table of APs, one table of differences per condition, and a table of claims."""
    terms = "AP BEV at IoU 0.3, all_point, mean over seeds"
    by = {(row["condition"], row["cell"], row["cls"]): row for row in rows}
    columns, cells = (
        (*CLASSES, "mean"),
        [c for c in study.cells if ("all", c, "mean") in by],
    )
    body = [
        [c, ", ".join(map(str, by["all", c, "mean"]["seeds"]))]
        + [number(by["all", c, cls]["ap"], digits=1) for cls in columns]
        for c in cells
    ]
    result = [Table(f"{study.title}: {terms}", ["Cell", "Seeds", *columns], body)]
    for condition in dict.fromkeys(row["condition"] for row in rows):
        body = [
            [c, *(interval_text(by[condition, c, cls]) for cls in columns)]
            for c in cells
            if c != study.base
        ]
        title = f"{study.title}: difference to {study.base}, {condition}, 95 %"
        result.append(Table(title, ["Cell", *columns], body))
    body = [
        [
            *(claim[name] for name in ("text", "a", "b", "cls")),
            interval_text(claim),
            ", ".join(map(str, claim["seeds"])),
            claim["verdict"],
        ]
        for claim in claims
    ]
    head = ["Claim", "A", "B", "Class", "A - B", "Seeds", "Verdict"]
    return [*result, Table(f"{study.title}: claims", head, body)]
