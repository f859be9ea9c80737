"""Comparisons of runs on the same frames (`radejax compare`).

Both runs of a comparison are evaluated on the same resampled sequences (see
`evaluation.results`).
"""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.evaluation import protocols
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet
from radejax.evaluation.files import Source, load, stored_from
from radejax.evaluation.report import Table, numbers, plain, rendered
from radejax.evaluation.results import (
    LEVEL,
    EvaluationOptions,
    interval,
    make_set,
    resample,
    sequence_weights,
)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of run B with run A in one metric.

    Attributes:
        cls: Class name or "mean".
        space: "bev" or "3d".
        iou: IoU threshold.
        protocol: Name of the protocol.
        ap_a: AP of run A over all frames.
        ap_b: AP of run B over all frames.
        difference: AP of run B minus AP of run A.
        low: Lower end of the 95 % interval of the difference.
        high: Upper end of this interval.
        p_value: Two-sided p-value from the fraction of resamples in which the difference
            has the less frequent sign.
        p_adjusted: p-value after Holm's correction over all rows compared together.
        is_significant: Whether `p_adjusted` is below 0.05.
    """

    cls: str
    space: str
    iou: float
    protocol: str
    ap_a: float
    ap_b: float
    difference: float
    low: float
    high: float
    p_value: float
    p_adjusted: float = 1.0
    is_significant: bool = False


def compare(
    data_a: EvaluationSet,
    data_b: EvaluationSet,
    sequence: Shaped[np.ndarray, " F"],
    *,
    protocol_names: Sequence[str] = (protocols.RECOMMENDED, "kradar_r40"),
    spaces: Sequence[str] = SPACES,
    iou: float = 0.3,
    score_threshold: float = 0.0,
    resamples: int = 2000,
) -> list[Comparison]:
    """Compares two runs on the same resampled sequences (paired comparison).

    Args:
        data_a: Evaluation set of run A.
        data_b: Evaluation set of run B with the same ground truth and frames.
        sequence: Sequence of every frame.
        protocol_names: Protocols of the compared APs.
        spaces: "bev", "3d" or both.
        iou: IoU threshold.
        score_threshold: Score threshold of both runs.
        resamples: Number of resamples.

    Raises:
        UserError: The runs differ in classes, frames or ground truth, or there are fewer
            than two sequences.
    """
    _check_same_truth(data_a, data_b)
    weights = sequence_weights(sequence, resamples=resamples, seed=0)
    # The first row counts every frame once, which gives the APs over all frames.
    weights = np.concatenate([np.ones_like(weights[:1]), weights])
    rows = []
    for protocol, space in itertools.product(protocol_names, spaces):
        metric = protocol, space, iou
        samples_a, samples_b = (
            resample(data, weights, *metric, score_threshold=score_threshold)
            for data in (data_a, data_b)
        )
        for index, cls in enumerate((*data_a.classes, "mean")):
            if not np.isnan(samples_a[0, index]):
                values = _difference(samples_a[:, index], samples_b[:, index])
                rows.append(Comparison(cls, space, iou, protocol, *values))
    adjusted = _holm(np.array([row.p_value for row in rows])).tolist()
    return [
        dataclasses.replace(row, p_adjusted=p, is_significant=p < 1 - LEVEL)
        for row, p in zip(rows, adjusted, strict=True)
    ]


def _difference(
    samples_a: Float[np.ndarray, " B"], samples_b: Float[np.ndarray, " B"]
) -> tuple[float, float, float, float, float, float]:
    """Returns both APs, their difference, its interval and its p-value.

    The first sample of each run is its AP over all frames; the others are resamples.
    """
    ap_a, ap_b = float(samples_a[0]), float(samples_b[0])
    gaps = samples_b[1:] - samples_a[1:]
    gaps = gaps[~np.isnan(gaps)]
    # One is added so that no finite number of resamples gives a p-value of 0.
    turned = min((gaps <= 0).sum(), (gaps >= 0).sum()) + 1
    p_value = float(min(1.0, 2 * turned / (gaps.size + 1)))
    return ap_a, ap_b, ap_b - ap_a, *interval(gaps), p_value


def _holm(p_values: Float[np.ndarray, " R"]) -> Float[np.ndarray, " R"]:
    """Adjusts p-values for their number with Holm's step-down method."""
    order = np.argsort(p_values, kind="stable")
    scaled = np.minimum(1, np.arange(p_values.size, 0, -1) * p_values[order])
    adjusted = np.empty_like(scaled)
    adjusted[order] = np.maximum.accumulate(scaled)
    return adjusted


def _check_same_truth(data_a: EvaluationSet, data_b: EvaluationSet) -> None:
    """Raises a `UserError` unless both sets have the same classes, frames and objects."""
    for name, one, other in (
        ("classes", data_a.classes, data_b.classes),
        ("frames", data_a.frame, data_b.frame),
        ("objects", data_a.gt.box, data_b.gt.box),
        ("classes of objects", data_a.gt.cls, data_b.gt.cls),
    ):
        if not np.array_equal(one, other):
            counts = f"{len(one)} and {len(other)}"
            raise UserError(
                f"the runs have different {name} ({counts}), expected equal"
            )


def comparison_table(rows: Sequence[Comparison], run_a: str, run_b: str) -> Table:
    """Returns the table of the differences of two runs and their significance."""
    header = ["Class", "Protocol", "AP", "IoU", "A", "B", "B - A", "95 %", "p"]
    body = []
    for row in rows:
        gap, low, high = numbers((row.difference, row.low, row.high), signed=True)
        entries = [row.cls, row.protocol, row.space.upper(), f"{row.iou:g}"]
        entries += [*numbers((row.ap_a, row.ap_b)), gap, f"[{low}, {high}]"]
        verdict = "significant" if row.is_significant else "not significant"
        body.append([*entries, f"{row.p_adjusted:.3f}", verdict])
    title = (
        f"B = {run_b} against A = {run_a}: 95 % intervals over sequences, p after Holm"
    )
    return Table(title, [*header, "Difference"], body)


def compare_files(
    paths: Sequence[PathLike],
    out_dir: PathLike | None,
    source: Source,
    options: EvaluationOptions,
) -> tuple[str, list[dict[str, Any]]]:
    """Compares each run with the first one on the same frames.

    Args:
        paths: Predictions or report folders of at least two runs. The first is run A.
        out_dir: Folder for comparison.txt and comparison.json, or None.
        source: Source of the ground truth for paths that do not contain it.
        options: Classes, protocols, IoU thresholds, region, score threshold and number
            of resamples of sequences (`bootstrap`). The first two main protocols and the
            first IoU threshold are compared.

    Returns:
        The tables as text, and the fields of all comparisons in the order of the runs.

    Raises:
        UserError: There are fewer than two runs or no resamples, the runs have different
            frames or ground truth, or the sequences of the frames are not known.
    """
    if len(paths) < 2:
        raise UserError("a comparison needs at least two runs")
    if options.bootstrap < 1:
        raise UserError("--bootstrap=0: a comparison needs 1 resample or more")
    # Predictions below the lowest stored score of one run must not count for another run.
    threshold = max(options.score_threshold, *map(stored_from, paths))
    options = dataclasses.replace(
        options, score_threshold=threshold, min_score=threshold
    )
    names = [str(path) for path in paths]
    (first, sequence), *others = [_load_run(path, source, options) for path in paths]
    built, rows = [], []
    for name, (data, _) in zip(names[1:], others, strict=True):
        found = compare(
            first,
            data,
            sequence,
            protocol_names=options.main_protocols[:2],
            iou=options.iou_thresholds[0],
            score_threshold=threshold,
            resamples=options.bootstrap,
        )
        built.append(comparison_table(found, names[0], name))
        rows += [plain(dataclasses.asdict(row)) for row in found]
    text = rendered(built, is_simulated=first.is_simulated)
    if out_dir is not None:
        content = {"runs": names, "options": dataclasses.asdict(options), "rows": rows}
        files.write_text(pathlib.Path(out_dir) / "comparison.txt", text)
        files.write_json(pathlib.Path(out_dir) / "comparison.json", content)
    return text, rows


def _load_run(
    path: PathLike, source: Source, options: EvaluationOptions
) -> tuple[EvaluationSet, np.ndarray]:
    """Returns the evaluation set of a run and the sequence of each of its frames."""
    truth, found, frames, _ = load(path, source, options.classes)
    if "sequence" not in frames:
        raise UserError(
            f"{path}: a comparison resamples sequences, and the frame table has no column "
            "sequence: give --data or --labels"
        )
    return make_set(truth, found, frames, options), np.asarray(frames["sequence"])
