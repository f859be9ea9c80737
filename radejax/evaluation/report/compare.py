"""What `evaluate.py` does with files: evaluate them, and compare several."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.evaluation.columns import Columns
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files.load import Source, load, stored_from
from radejax.evaluation.report import bootstrap, paper_tables, tables
from radejax.evaluation.report.measure import Options, measure, repair_sizes
from radejax.evaluation.report.report import Report, plain, write_report

LOW_SCORE = 0.1
"""Where predictions are stored from here on, AP without a cut is nearly the whole."""


def evaluate_files(
    path: PathLike, out_dir: PathLike, source: Source, options: Options
) -> Report:
    """Evaluates predictions in files and writes the report. See `load` for errors."""
    truth, found, frames, left_out = load(path, source, options.classes)
    warnings, low = options.warnings, stored_from(path)
    if low > max(LOW_SCORE, options.score_threshold):
        warnings += (
            f"{path} has predictions from score {low:g} on only, and every number is of "
            "these; evaluate --workdir again stores lower ones",
        )
    options = dataclasses.replace(
        options,
        left_out_before={**left_out, **options.left_out_before},
        min_score=max(low, options.min_score),
        warnings=warnings,
    )
    return write_report(truth, found, frames, out_dir, options)


def compare_files(
    paths: Sequence[PathLike],
    out_dir: PathLike | None,
    source: Source,
    options: Options,
    *,
    resamples: int = 2000,
) -> tuple[str, list[bootstrap.Comparison]]:
    """Compares runs on the same frames: each with the first, and all in Table III.

    Args:
        paths: Predictions or report folders, at least two; the first is run A.
        out_dir: Where to write comparison.txt and comparison.json, or None.
        source: Ground truth, unless the paths bring their own.
        options: Classes, protocols, IoU thresholds, region, score cut, seed.
        resamples: Number of resamples of sequences.

    Returns:
        The tables as text, and all comparisons (B is the second run first).

    Raises:
        UserError: Fewer than two runs, or runs on different frames or ground truth.
    """
    if len(paths) < 2:
        raise UserError("a comparison needs at least two runs")
    # What one run has not stored must not count for another one.
    cut = max(options.score_threshold, *map(stored_from, paths))
    options = dataclasses.replace(options, score_threshold=cut)
    first, *others = [_load_run(path, source, options) for path in paths]
    named = [p for p in ("all_point", "kradar_r40") if p in options.protocols]
    parts, rows = [], []
    for path, (data, frames) in zip(paths[1:], others, strict=True):
        found = bootstrap.compare(
            first[0],
            data,
            frames["sequence"],
            protocol_names=named or options.protocols[:1],
            iou_thresholds=options.iou_thresholds[:1],
            score_threshold=options.score_threshold,
            resamples=resamples,
            seed=options.seed,
        )
        table = tables.comparison(found, str(paths[0]), str(path))
        is_simulated = data.is_simulated or first[0].is_simulated
        parts.append((table.of_simulated() if is_simulated else table).render())
        rows += found
    runs = dict(zip(map(str, paths), [first, *others], strict=True))
    if "Sedan" in options.classes:
        parts.append(_ablations(runs, options).render())
    text = "\n".join(parts)
    if out_dir is not None:
        content = {
            "runs": list(runs),
            "resamples": resamples,
            "options": options.to_dict(),
            "rows": [dataclasses.asdict(row) for row in rows],
        }
        out_dir = pathlib.Path(out_dir)
        out_dir.mkdir(parents=True, exist_ok=True)
        files.write_text(out_dir / "comparison.txt", text)
        files.write_json(out_dir / "comparison.json", plain(content))
    return text, rows


def _load_run(
    path: PathLike, source: Source, options: Options
) -> tuple[EvaluationSet, Columns]:
    """A run ready to be compared, and its frames."""
    truth, found, frames, _ = load(path, source, options.classes)
    if "sequence" not in frames:
        raise UserError(
            f"{path}: comparing runs resamples sequences, and the frames do not say"
            " theirs: give --data or --labels"
        )
    found, _ = repair_sizes(found, options.invalid_sizes)
    data = EvaluationSet(
        truth, found, classes=options.classes, frames=frames, roi=options.roi
    )
    return data, frames


def _ablations(
    runs: Mapping[str, tuple[EvaluationSet, Columns]], options: Options
) -> tables.Table:
    """Several runs in the layout of Table III."""
    options = dataclasses.replace(
        options, protocols=(options.paper_protocol,), iou_thresholds=(0.3, 0.5)
    )
    measured = {
        name: tables.index(measure(data, frames, options, kinds=()))
        for name, (data, frames) in runs.items()
    }
    is_simulated = any(data.is_simulated for data, _ in runs.values())
    table = paper_tables.table_3(
        measured, options.paper_protocol, is_simulated=is_simulated
    )
    return table.of_simulated() if is_simulated else table
