"""Our numbers in the layouts of the papers, beside the published rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from radejax.evaluation.report import published
from radejax.evaluation.report.measure import Measured, Options
from radejax.evaluation.report.tables import (
    SPACE_TITLES,
    TITLES,
    Key,
    Table,
    number,
    shown,
    terms,
)


def beside_published(rows: Mapping[Key, Measured], options: Options) -> list[Table]:
    """All tables that the measured numbers allow, in the order of the papers."""
    if (
        options.paper_protocol not in options.protocols
        or 0.3 not in options.iou_thresholds
    ):
        return []
    tables = [table_2(rows, options), table_3_dinorade(rows, options)]
    if "Sedan" in options.classes:
        tables.insert(0, table_1(rows, options))
        tables.append(table_3({options.run: rows}, options.paper_protocol))
    return tables


def _difference(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or theirs is None else ours - theirs


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
        f"{terms(rows, options.paper_protocol)}",
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
            shown(rows, (protocol, name, "Sedan", space, iou))
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
            shown(rows, (options.paper_protocol, name, cls, space, iou))
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
        f"{options.paper_protocol}{terms(rows, options.paper_protocol)}",
        ["Class", "Source", *header],
        body,
    )


def table_3_dinorade(rows: Mapping[Key, Measured], options: Options) -> Table:
    """Classes over all weathers beside DinoRADE's Table 3."""
    classes = ("mean", *options.classes)
    columns = [(cls, space) for cls in classes for space in ("3d", "bev")]
    ours = [
        shown(rows, (options.paper_protocol, "all", cls, space, 0.3))
        for cls, space in columns
    ]
    body = []
    listed = published.published_rows("DinoRADE", "3")
    for method in dict.fromkeys(row.method for row in listed):
        by_space = {row.space: row for row in listed if row.method == method}
        theirs = [by_space[space].get(cls) for cls, space in columns]
        gaps = [_difference(a, b) for a, b in zip(ours, theirs, strict=True)]
        body.append([method, "DinoRADE, Table 3", *map(number, theirs)])
        body.append(
            [
                f"{options.run} - {method}",
                "difference",
                *(number(gap, signed=True) for gap in gaps),
            ]
        )
    body.append([options.run, options.paper_protocol, *map(number, ours)])
    return Table(
        "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3), "
        f"{options.paper_protocol}{terms(rows, options.paper_protocol)}",
        [
            "Method",
            "Source",
            *(
                f"{'Total' if cls == 'mean' else cls} {SPACE_TITLES[space]}"
                for cls, space in columns
            ),
        ],
        body,
    )


def table_3(
    runs: Mapping[str, Mapping[Key, Measured]],
    protocol: str = published.AUTHORS_PROTOCOL,
) -> Table:
    """Sedan AP of several runs at IoU 0.3 and 0.5 beside the papers' ablations.

    Args:
        runs: Measured rows by the name of the run, from `layouts.index`.
        protocol: Protocol of our rows.
    """
    columns = [(space, iou) for iou in (0.3, 0.5) for space in ("3d", "bev")]
    body = []
    for source, size in ((("RADE-Net", "III"), 4), (("DinoRADE", "4"), 2)):
        listed = published.published_rows(*source)
        for start in range(0, len(listed), size):  # one printed row at a time
            group = listed[start : start + size]
            values = {(row.space, row.iou): row.get("Sedan") for row in group}
            cells = [number(values.get(column)) for column in columns]
            body.append([group[0].method, group[0].source, *cells])
    for name, measured in runs.items():
        cells = [
            number(shown(measured, (protocol, "all", "Sedan", space, iou)))
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
