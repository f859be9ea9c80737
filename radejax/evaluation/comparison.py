"""Comparisons of runs on the same frames (`radejax compare`).

All trainings of both runs are evaluated on the same resampled sequences (see
`evaluation.results`). With `MIN_SEEDS` seeds or more of both runs, the variance between
trainings is added, as estimated from the seeds. This is the variance of resampling n - 1 of
n seeds. A percentile interval over resampled seeds would be too narrow, because three
differences have the same sign in one of four cases. Therefore intervals and p-values use
critical values of Student's distribution: the mean of those of seeds and of sequences,
weighted by their variances (Cochran).

References:
    Cochran: "Approximate significance levels of the Behrens-Fisher test", Biometrics 1964.
    Rao, Wu: "Resampling inference with complex survey data", JASA 1988.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.files import JsonObject, PathLike
from radejax.core.structures import Boxes
from radejax.evaluation import protocols, report
from radejax.evaluation.analysis import distance_sets
from radejax.evaluation.boxes import (
    Columns,
    frame_ids,
    frame_keys,
    frame_positions,
    take,
)
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet
from radejax.evaluation.files import Source, load, options_for, report_folders
from radejax.evaluation.results import (
    LEVEL,
    ReportOptions,
    condition_masks,
    in_one_sequence,
    interval,
    make_set,
    resample,
    sequence_weights,
)

MIN_SEEDS = 3
"""Number of seeds that both runs need for a test of their difference."""

_VERDICTS = {True: "significant", False: "not significant", None: "not tested"}

Aps = Float[np.ndarray, "_ _"]

Run = Mapping[str, EvaluationSet]
"""Evaluation sets of the trainings of a run by the names of their seeds."""


class Difference(NamedTuple):
    """Fields of `Comparison` that are computed from the APs of two runs."""

    ap_a: float
    ap_b: float
    difference: float
    std: float = math.nan
    low: float = math.nan
    high: float = math.nan
    p_value: float = math.nan


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of run B with run A in one metric.

    Attributes:
        kind: Kind of the condition: "all", "weather" or "distance".
        condition: "all", a weather, or a distance band of the report.
        cls: Class name or "mean".
        space: "bev" or "3d".
        iou: IoU threshold.
        protocol: Name of the protocol.
        score_threshold: Score threshold of the protocol.
        ap_a: AP of run A over all frames of the condition; the mean over its seeds.
        ap_b: AP of run B in the same way.
        difference: AP of run B minus AP of run A.
        std: Standard deviation of the difference over seeds; NaN if it is not tested.
        low: Lower end of the 95 % interval of the difference; NaN if the frames, or those
            with objects of the class, are of a single sequence.
        high: Upper end of this interval.
        p_value: Two-sided p-value. If the difference is not tested, it is computed from
            the fraction of resamples in which the difference has the less frequent sign.
            NaN without an interval.
        p_adjusted: p-value after Holm's correction over all rows of the same kind that
            have a p-value; for weathers and distances not below the smallest one over all
            frames, so that equal runs differ in any row with a probability of at most 5 %.
        is_significant: Whether `p_adjusted` is below 0.05; None if the difference is not
            tested, because a run has fewer than `MIN_SEEDS` seeds or there is no interval.
    """

    kind: str
    condition: str
    cls: str
    space: str
    iou: float
    protocol: str
    score_threshold: float
    ap_a: float
    ap_b: float
    difference: float
    std: float
    low: float
    high: float
    p_value: float
    p_adjusted: float = 1.0
    is_significant: bool | None = None


def compare(
    run_a: Run,
    run_b: Run,
    frames: Columns,
    options: ReportOptions,
    *,
    spaces: Sequence[str] = SPACES,
) -> list[Comparison]:
    """Compares two runs on the same resampled sequences (paired comparison).

    The seeds are paired too if both runs have the same ones.

    Args:
        run_a: Evaluation sets of run A.
        run_b: Evaluation sets of run B with the same ground truth and frames.
        frames: Frame table with the column sequence.
        options: Settings of the evaluation. `all_point` and the protocols of the options
            are compared over all frames, and `all_point` by weather and distance, at the
            first IoU threshold.
        spaces: "bev", "3d" or both.

    Raises:
        UserError: The runs differ in classes, frames or ground truth, or there are fewer
            than two sequences.
    """
    sets = [*run_a.values(), *run_b.values()]
    for other in sets[1:]:
        _check_same_truth(sets[0], other)
    rows = []
    iou = options.iou_thresholds[0]
    for kind, condition, chosen, sequence in _parts(sets, frames, iou):
        others = options.protocols if kind == "all" else ()
        names = dict.fromkeys((protocols.RECOMMENDED, *others))
        num_sequences = np.unique(sequence).size
        # The first row counts every frame once, which gives the APs over all frames.
        weights = np.ones((1, sequence.size), np.int16)
        if kind == "all" or num_sequences > 1:
            drawn = sequence_weights(sequence, resamples=options.bootstrap)
            weights = np.concatenate([weights, drawn])
        is_single = in_one_sequence(chosen[0], sequence)
        for protocol, space in itertools.product(names, spaces):
            terms = options.settings_of(protocol)
            aps = np.stack(
                [resample(x, weights, protocol, space, iou, **terms) for x in chosen]
            )
            aps[:, 1:, is_single] = np.nan
            for index, cls in enumerate((*sets[0].classes, "mean")):
                a, b = np.split(aps[..., index], [len(run_a)])
                # With a single class, the mean would be the same row again.
                if np.isnan(a[0, 0]) or (cls == "mean" and index == 1):
                    continue
                is_paired = list(run_a) == list(run_b)
                gap = difference(a, b, is_paired, num_sequences)
                score = terms["score_threshold"]
                rows.append(
                    Comparison(kind, condition, cls, space, iou, protocol, score, *gap)
                )
    return _adjusted(rows, min(len(run_a), len(run_b)) >= MIN_SEEDS)


def _parts(
    sets: Sequence[EvaluationSet], frames: Columns, iou: float
) -> Iterator[tuple[str, str, list[EvaluationSet], np.ndarray]]:
    """Yields kind, condition, evaluation sets and the sequence of every frame."""
    sequence = np.asarray(frames["sequence"])
    yield "all", "all", list(sets), sequence
    for name, mask in condition_masks(frames, "weather").items():
        yield "weather", name, [x.of_frames(mask) for x in sets], sequence[mask]
    bands = [distance_sets(data, iou) for data in sets]
    for name in bands[0]:
        yield "distance", name, [band[name] for band in bands], sequence


def _adjusted(rows: Iterable[Comparison], is_tested: bool) -> list[Comparison]:
    """Returns the rows with p-values after Holm's correction and, if tested, verdicts."""
    adjusted = list[Comparison]()
    least = 0.0
    for kind, of_kind in itertools.groupby(rows, lambda row: row.kind):
        group = list(of_kind)
        found = np.maximum(_holm([row.p_value for row in group]), least).tolist()
        if kind == "all":
            least = min((p for p in found if not np.isnan(p)), default=1.0)
        for row, p in zip(group, found, strict=True):
            verdict = p < 1 - LEVEL if is_tested and not np.isnan(p) else None
            row = dataclasses.replace(row, p_adjusted=p, is_significant=verdict)
            adjusted.append(row)
    return adjusted


def difference(a: Aps, b: Aps, is_paired: bool, num_sequences: int) -> Difference:
    """Computes both APs, their difference, its deviation, interval and p-value.

    With `MIN_SEEDS` seeds or more of both runs, the interval counts the variance between
    seeds, see the docstring of the module.

    Args:
        a: `[N, 1+B]` APs of the seeds of run A. The first column is over all frames, the others are
            over resamples of sequences.
        b: `[M, 1+B]` APs of run B in the same way.
        is_paired: Whether row i of both runs has the same seed.
        num_sequences: Number of sequences.
    """
    gaps = b.mean(axis=0) - a.mean(axis=0)
    aps = Difference(float(a[:, 0].mean()), float(b[:, 0].mean()), float(gaps[0]))
    gaps = gaps[1:][~np.isnan(gaps[1:])]
    count = min(len(a), len(b))
    if not gaps.size:
        return aps
    if count < MIN_SEEDS:
        low, high = interval(gaps)
        # One is added so that no finite number of resamples gives a p-value of 0.
        turned = min((gaps <= 0).sum(), (gaps >= 0).sum()) + 1
        p_value = float(min(1.0, 2 * turned / (gaps.size + 1)))
        return aps._replace(low=low, high=high, p_value=p_value)
    if is_paired:
        of_seeds = (b - a)[:, 0].var(ddof=1) / count
    else:
        of_seeds = sum(x[:, 0].var(ddof=1) / len(x) for x in (a, b))
    of_sequences = gaps.var() * num_sequences / (num_sequences - 1)
    error = max(np.sqrt(of_seeds + of_sequences), 1e-9)  # 0 for identical runs
    share = of_seeds / error**2
    # Descending p-values, and the quotients of difference and error that give them.
    p_values = np.geomspace(1, 1e-9, 2000)
    quotients = share * stdtrit(count - 1, 1 - p_values / 2)
    quotients += (1 - share) * stdtrit(num_sequences - 1, 1 - p_values / 2)
    half = error * np.interp(1 - LEVEL, p_values[::-1], quotients[::-1])
    p_value = np.interp(abs(aps.difference) / error, quotients, p_values)
    return aps._replace(
        std=float(np.sqrt(count * of_seeds)),
        low=float(aps.difference - half),
        high=float(aps.difference + half),
        p_value=float(p_value),
    )


def _holm(p_values: Sequence[float]) -> list[float]:
    """Adjusts p-values for their number with Holm's step-down method.

    NaN stays NaN and does not count.
    """
    order = np.argsort(p_values, kind="stable")  # NaN is last
    counts = np.count_nonzero(~np.isnan(p_values)) - np.arange(len(p_values))
    scaled = np.minimum(1, counts * np.asarray(p_values)[order])
    adjusted = np.empty_like(scaled)
    adjusted[order] = np.maximum.accumulate(scaled)
    return [float(p_value) for p_value in adjusted]


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
            raise UserError(f"the runs have different {name} ({counts})")


def comparison_tables(
    rows: Sequence[Comparison],
    run_a: str,
    run_b: str,
    seeds: Iterable[int] = (),
    *,
    name: str = "comparison",
) -> list[report.Table]:
    """Returns the tables of differences over all frames, by weather and by distance.

    The higher AP of each row is bold.

    Args:
        rows: Result of `compare`.
        run_a: Name of run A.
        run_b: Name of run B.
        seeds: Numbers of seeds of both runs.
        name: Beginning of the short names of the tables.
    """
    is_tested = any(row.is_significant is not None for row in rows)
    note = "over sequences; the variation between trainings is not counted"
    if is_tested:
        counts = " and ".join(map(str, dict.fromkeys(seeds)))
        note = f"over seeds and sequences, gain ± standard deviation of {counts} seeds"
    note = f"p after Holm, 95 % intervals {note}"
    header = ["Class", "Protocol", "AP", "A", "B", "B - A", "95 %", "p"]
    header += ["Difference"] * is_tested
    built = []
    for kind, group in itertools.groupby(rows, lambda row: row.kind):
        body = []
        for row in group:
            protocol = f"{row.protocol}, score>{row.score_threshold:g}"
            metric = f"{row.space.upper()} {row.iou:g}"
            ends = row.difference, row.low, row.high
            gap, low, high = report.numbers(ends, signed=True)
            verdict = []
            if is_tested:
                gap += f" ± {report.number(row.std)}"
                verdict = [_VERDICTS[row.is_significant]]
            aps = report.numbers((row.ap_a, row.ap_b))
            p_value = "-" if np.isnan(row.p_adjusted) else f"{row.p_adjusted:.3f}"
            values = [*aps, gap, f"[{low}, {high}]", p_value, *verdict]
            body.append([row.condition, row.cls, protocol, metric, *values])
        by = "all frames" if kind == "all" else f"by {kind}"
        title = f"B = {run_b} against A = {run_a}, {by}: {note}"
        best = {
            (i, 5 if float(row[5]) > float(row[4]) else 4)
            for i, row in enumerate(body)
            if row[4] != row[5]
        }
        head = [kind.capitalize(), *header]
        built.append(report.Table(title, head, body, f"{name}-{kind}", best))
    return built


def compare_files(
    paths: Sequence[PathLike],
    out_dir: PathLike | None,
    source: Source,
    options: ReportOptions,
    *,
    figures: str | None = None,
) -> tuple[str, list[JsonObject]]:
    """Compares each run with the first one on the same frames.

    Args:
        paths: At least two runs: folders of runs, folders with the seeds of a run, folders
            of reports, or predictions. The first is run A.
        out_dir: Folder for comparison.txt, .md, .tex and .json, or None.
        source: Source of the ground truth for paths that do not contain it.
        options: Settings of the evaluation, see `compare`.
        figures: Format of figures of the precision-recall curves, such as "pdf"; None draws
            none. They need `out_dir`.

    Returns:
        The tables as text, and the fields of all comparisons in the order of the runs.

    Raises:
        UserError: There are fewer than two runs, neither resamples nor figures, the runs
            have different frames or ground truth, or the sequences of the frames are not
            known.
    """
    if len(paths) < 2:
        raise UserError("a comparison needs at least two runs")
    if options.bootstrap < 1 and not figures:
        raise UserError(
            "--bootstrap=0: a comparison needs 1 resample or more, or only --figures"
        )
    folders = [report_folders(path) for path in paths]
    seeds = [seed for run in folders for seed in run.values()]
    options = options_for(seeds, source, options)
    names = [str(path) for path in paths]
    first, frames = _load_run(folders[0], source, options)
    others = [_load_run(run, source, options, frames) for run in folders[1:]]
    loaded = [(first, frames), *others]
    built = []
    rows = []
    for i, (sets, _) in enumerate(others if options.bootstrap else [], 1):
        found = compare(first, sets, frames, options)
        label = "comparison" if len(others) == 1 else f"comparison-{i}"
        counts = len(first), len(sets)
        built += comparison_tables(found, names[0], names[i], counts, name=label)
        rows += [report.plain(dataclasses.asdict(row)) for row in found]
    is_simulated = next(iter(first.values())).is_simulated
    text = report.rendered(built, is_simulated=is_simulated)
    if not built:
        text = "no table without resamples: --bootstrap is 0\n"
    if out_dir is not None:
        content = {"runs": names, "options": options.to_dict(), "rows": rows}
        place = pathlib.Path(out_dir) / "comparison"
        files.write_text(place.with_suffix(".txt"), text)
        files.write_json(place.with_suffix(".json"), content)
        report.write_tables(place, built, is_simulated=is_simulated)
        if figures:
            runs = dict(zip(short_names(paths), (x for x, _ in loaded), strict=True))
            _draw_curves(runs, options, pathlib.Path(out_dir), figures)
    return text, rows


def short_names(paths: Sequence[PathLike]) -> list[str]:
    """Returns the last parts of the paths, or whole paths where these are not unique.

    Examples:
        >>> short_names(["runs/a", "runs/b"])
        ['a', 'b']
    """
    names = [pathlib.Path(path).name for path in paths]
    return names if len({*names}) == len(names) else [str(path) for path in paths]


def _draw_curves(
    runs: Mapping[str, Run], options: ReportOptions, folder: pathlib.Path, ending: str
) -> None:
    """Draws a panel for each class that occurs with one curve per run, for each space."""
    from radejax.visualize.curves import Curve, draw_precision_recall
    from radejax.visualize.style import save_figure

    protocol = protocols.RECOMMENDED
    iou = options.iou_thresholds[0]
    settings = options.settings_of(protocol)
    is_simulated = next(x for run in runs.values() for x in run.values()).is_simulated
    for space in SPACES:
        panels: dict[str, dict[str, Curve]] = {}
        for name, run in runs.items():
            of_seeds = [
                data.results(protocol, spaces=space, iou_thresholds=iou, **settings)
                for data in run.values()
            ]
            for found in zip(*of_seeds, strict=True):
                if found[0].is_defined:
                    ap = np.mean([result.ap for result in found])
                    title = f"{found[0].cls}, {found[0].num_gt:,} objects"
                    lines = panels.setdefault(title, {})
                    lines[f"{name}: AP {ap:.1f}"] = protocols.mean_curve(found)
        title = f"{protocol}, {space.upper()}, IoU {iou:g}"
        title += ", simulated data" if is_simulated else ""
        figure = draw_precision_recall(panels, title)
        name = f"comparison_{space}_iou{100 * iou:.4g}.{ending}"
        save_figure(figure, folder / name)


def _load_run(
    folders: Mapping[str, pathlib.Path],
    source: Source,
    options: ReportOptions,
    like: Columns | None = None,
) -> tuple[dict[str, EvaluationSet], Columns]:
    """Returns the evaluation sets of the seeds of a run, and its frame table.

    Args:
        folders: Report of each seed.
        source: Source of the ground truth.
        options: Settings of the evaluation.
        like: Frame table whose ids and order of the frames are taken, or None.
    """
    sets: dict[str, EvaluationSet] = {}
    for name, path in folders.items():
        truth, found, frames, _ = load(path, source, options.classes)
        if like is not None:
            truth, found, frames = _renumbered(truth, found, frames, like)
        like = frames
        if "sequence" not in frames:
            raise UserError(
                f"{path}: a comparison resamples sequences, and the frame table has no "
                "column sequence: give --data or --labels"
            )
        sets[name] = make_set(truth, found, frames, options)
    return sets, frames


def _renumbered(
    truth: Boxes, found: Boxes, frames: Columns, like: Columns
) -> tuple[Boxes, Boxes, Columns]:
    """Returns boxes and frame table with the frame ids and the order of another table.

    Frames are identified by their keys: ids differ if a run was evaluated on a part.
    """
    keys = frame_keys(frames)
    ids = dict(zip(frame_keys(like), frame_ids(like), strict=True))
    if other := sorted(set(keys) ^ set(ids)):
        raise UserError(
            f"the runs have different frames ({len(ids)} and {len(keys)}), such as "
            f"{other[0]}: choose common ones by --sequences, --weather or --split"
        )
    new = np.array([ids[key] for key in keys], np.int64)
    truth, found = (
        dataclasses.replace(
            table, frame=new[frame_positions(table.frame, frame_ids(frames), "boxes")]
        )
        for table in (truth, found)
    )
    order = [keys.index(key) for key in ids]
    return truth, found, take({**frames, "frame": new}, np.array(order, np.int64))
