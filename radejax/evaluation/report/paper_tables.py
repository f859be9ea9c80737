"""Our numbers in the layouts of the papers, beside the published rows.

A difference is printed only where both numbers are of the same terms (`published.Terms`);
else the published row stands and a note says why there is none. Numbers of simulated
frames stand beside no published row.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence

from radejax.evaluation.report.measure import Measured, Options, Origin
from radejax.evaluation.report.published import (
    AUTHORS_PROTOCOL,
    CONDITIONS,
    COPIED,
    PublishedRow,
    Terms,
    published_rows,
)
from radejax.evaluation.report.tables import (
    SPACE_TITLES,
    TITLES,
    Key,
    Table,
    marked,
    number,
    numbers,
    rare_notes,
    shown,
    terms,
)

Rows = Mapping[Key, Measured]


def beside_published(rows: Rows, options: Options, origin: Origin) -> list[Table]:
    """All tables that the measured numbers allow, in the order of the papers.

    Args:
        rows: Measured rows, from `tables.index`.
        options: Of the report.
        origin: Of the frames; there is no table for simulated ones.
    """
    if origin.is_simulated or 0.3 not in options.iou_thresholds:
        return []
    ours = our_terms(rows, options, origin)
    tables = [table_2(rows, options, ours), table_3_dinorade(rows, options, ours)]
    if "Sedan" in options.classes:
        tables.insert(0, table_1(rows, options, ours))
        tables.append(table_3({options.run: rows}, options.paper_protocol))
    return tables


def our_terms(rows: Rows, options: Options, origin: Origin) -> Terms:
    """What our rows depend on that stand beside published ones."""
    protocol = options.paper_protocol
    made = next(row.result for key, row in rows.items() if key[0] == protocol)
    return Terms(
        protocol=protocol,
        labels=made.label_version,
        classes=tuple(sorted(options.classes)),
        score_cut=made.score_threshold,
        skip=made.empty_frames,
        roi=made.roi,
        split=origin.split,
        frames=origin.num_frames,
    )


def why_no_difference(row: PublishedRow, ours: Terms, cls: str = "") -> str:
    """The reason, "" where a difference may be printed.

    Args:
        row: Published row.
        ours: What our number depends on.
        cls: "mean" asks for that of the row, which must be over all classes, too.
    """
    if row.protocol == COPIED:
        return f"evaluation {COPIED}"
    reason = ours.differences(row.terms)
    printed = {name for name, _ in row.values} - {"mean"}
    if cls == "mean" and printed != set(ours.classes):
        reason = "; ".join(filter(None, [reason, f"mean over {len(printed)} classes"]))
    return reason


def _notes(reasons: Iterable[tuple[str, str]]) -> list[str]:
    """A line for every reason, with the rows that it holds for."""
    rows: dict[str, dict[str, None]] = {}
    for name, reason in reasons:
        if reason:
            rows.setdefault(reason, {})[name] = None
    return [
        f"No difference to {', '.join(names)}: {reason}."
        for reason, names in rows.items()
    ]


def _differences(
    ours: Iterable[float | None], theirs: Iterable[float | None]
) -> list[str]:
    """Cells of ours minus theirs where both exist."""
    return [
        number(None if a is None or b is None else a - b, signed=True)
        for a, b in zip(ours, theirs, strict=True)
    ]


def table_1(rows: Rows, options: Options, ours: Terms, iou: float = 0.3) -> Table:
    """Sedan by weather beside RADE-Net's Table I and DinoRADE's Table 1."""
    body, reasons = [], []
    for space, title in SPACE_TITLES.items():
        listed = [
            *published_rows("RADE-Net", "I", space=space, iou=iou),
            *published_rows("DinoRADE", "1", space=space, iou=iou),
        ]
        seen = set()
        for row in listed:
            cells = numbers((row.get("Sedan", name) for name in CONDITIONS), digits=1)
            if (row.method, *cells) not in seen:  # both papers copy the same rows
                body.append([row.method, row.source, row.modality, title, *cells])
            seen.add((row.method, *cells))
        allowed = []
        for row in listed:
            reason = why_no_difference(row, ours)
            reasons.append((f"{row.method} ({row.source})", reason))
            allowed += [] if reason else [row]
        body += _our_table_1_rows(rows, options, space, iou, allowed)
    return Table(
        f"Sedan by weather at IoU {iou:g} (layout of Table I)"
        f"{terms(rows, options.paper_protocol)}",
        ["Network", "Source", "Modality", "AP", *(TITLES[name] for name in CONDITIONS)],
        body,
        _notes(reasons),
    )


def _our_table_1_rows(
    rows: Rows,
    options: Options,
    space: str,
    iou: float,
    comparable: Sequence[PublishedRow],
) -> list[list[str]]:
    """Our row in each protocol that matters, and differences to comparable rows."""
    title = SPACE_TITLES[space]
    wanted = dict.fromkeys((options.paper_protocol, "kradar_r40", "all_point"))
    ours = {
        protocol: [
            shown(rows, (protocol, name, "Sedan", space, iou)) for name in CONDITIONS
        ]
        for protocol in wanted
        if protocol in options.protocols
    }
    body = [
        [options.run, protocol, "", title, *numbers(values)]
        for protocol, values in ours.items()
    ]
    for row in comparable:
        theirs = [row.get("Sedan", name) for name in CONDITIONS]
        cells = _differences(ours[row.protocol], theirs)
        name = f"{options.run} - {row.method}"
        body.append([name, row.source, "", title, *cells])
    return body


def table_2(rows: Rows, options: Options, ours: Terms, iou: float = 0.3) -> Table:
    """Class by weather, 3D and BEV in turn, with RADE-Net's and DinoRADE's rows."""
    protocol = options.paper_protocol
    columns = list(itertools.product(CONDITIONS, SPACE_TITLES))
    papers = [("RADE-Net", "II"), ("DinoRADE", "2")]
    listed = [{r.space: r for r in published_rows(*at, iou=iou)} for at in papers]
    body, reasons = [], []
    for cls in (*options.classes, "mean"):
        values = [
            shown(rows, (protocol, name, cls, space, iou)) for name, space in columns
        ]
        cells = zip(columns, numbers(values), strict=True)
        marks = (marked(options, cls, name, cell) for (name, _), cell in cells)
        body.append([cls, options.run, *marks])
        for row in filter(None, listed):
            theirs = [row[space].get(cls, name) for name, space in columns]
            if all(value is None for value in theirs):
                continue
            source, reason = row["3d"].source, why_no_difference(row["3d"], ours, cls)
            body.append([cls, source, *numbers(theirs)])
            if not reason:
                body.append([cls, "difference", *_differences(values, theirs)])
            name = f"the mean of {source}" if cls == "mean" else source
            reasons.append((name, reason))
    return Table(
        f"Classes by weather at IoU {iou:g} (layout of Table II), "
        f"{protocol}{terms(rows, protocol)}",
        [
            "Class",
            "Source",
            *(f"{TITLES[name]} {SPACE_TITLES[space]}" for name, space in columns),
        ],
        body,
        [*_notes(reasons), *rare_notes(options)],
    )


def table_3_dinorade(rows: Rows, options: Options, ours: Terms) -> Table:
    """Classes over all weathers beside DinoRADE's Table 3."""
    protocol = options.paper_protocol
    columns = list(itertools.product(("mean", *options.classes), SPACE_TITLES))
    values = [shown(rows, (protocol, "all", *column, 0.3)) for column in columns]
    body, reasons = [], []
    listed = published_rows("DinoRADE", "3")
    for method in dict.fromkeys(row.method for row in listed):
        by_space = {row.space: row for row in listed if row.method == method}
        theirs = [by_space[space].get(cls) for cls, space in columns]
        body.append([method, "DinoRADE, Table 3", *numbers(theirs)])
        reason = why_no_difference(by_space["3d"], ours, "mean")
        if not reason:
            name, gaps = f"{options.run} - {method}", _differences(values, theirs)
            body.append([name, "difference", *gaps])
        reasons.append((method, reason))
    body.append([options.run, protocol, *numbers(values)])
    titles = [
        f"{'Total' if cls == 'mean' else cls} {SPACE_TITLES[space]}"
        for cls, space in columns
    ]
    return Table(
        "Classes, all weathers, IoU 0.3 (layout of DinoRADE's Table 3), "
        f"{protocol}{terms(rows, protocol)}",
        ["Method", "Source", *titles],
        body,
        _notes(reasons),
    )


def table_3(
    runs: Mapping[str, Rows],
    protocol: str = AUTHORS_PROTOCOL,
    *,
    is_simulated: bool = False,
) -> Table:
    """Sedan AP of several runs at IoU 0.3 and 0.5 beside the papers' ablations.

    Args:
        runs: Measured rows by the name of the run, from `tables.index`.
        protocol: Protocol of our rows.
        is_simulated: They are of simulated frames: without published rows.
    """
    columns = [(space, iou) for iou in (0.3, 0.5) for space in SPACE_TITLES]
    body = []
    sources = ((("RADE-Net", "III"), 4), (("DinoRADE", "4"), 2))
    for source, size in () if is_simulated else sources:
        listed = published_rows(*source)
        for start in range(0, len(listed), size):  # one printed row at a time
            group = listed[start : start + size]
            values = {(row.space, row.iou): row.get("Sedan") for row in group}
            cells = numbers(map(values.get, columns))
            body.append([group[0].method, group[0].source, *cells])
    for name, rows in runs.items():
        keys = ((protocol, "all", "Sedan", *column) for column in columns)
        body.append([name, protocol, *numbers(shown(rows, key) for key in keys)])
    titles = [f"{SPACE_TITLES[space]} IoU={iou:g}" for space, iou in columns]
    return Table(
        f"Ablations, Sedan (layout of Table III), {protocol}",
        ["Configuration", "Source", *titles],
        body,
    )
