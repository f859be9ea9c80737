"""Evaluates detections by the distance between centers instead of IoU.

    python examples/center_distance.py runs/quickstart/evaluation

The first table has AP with the matching of nuScenes: a prediction matches an object of its class
if the distance of their centers on the ground is below a threshold. The second table has the
median errors of the centers along and across the line of sight for the largest threshold, and the
fraction of matched boxes with a BEV IoU above 0.3, as predicted and with one error removed. A
class with a high AP here and a low AP by IoU is detected, but its boxes are inaccurate. A class
with a low AP in both is not detected.
"""

import itertools
import pathlib
from collections.abc import Iterator

import click
import numpy as np

from radejax.cli import entry
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load
from radejax.evaluation.matching import Pairs, match_free, ranges
from radejax.evaluation.protocols import pooled_curve
from radejax.evaluation.report import Table, number
from radejax.geometry.rotated_iou import bev_iou

DISTANCES_M = (
    0.0,
    20.0,
    40.0,
    73.0,
)  # the far corners of the narrow region are 72.3 m away
IOU = 0.3


def matched(data: EvaluationSet, within_m: float) -> np.ndarray:
    """Returns the index `[M]` of the object that each prediction matches, or -1.

    In descending order of score, each prediction takes the nearest unmatched object of its frame
    and class whose distance is below `within_m` meters.
    """
    first = np.searchsorted(data.gt_group, data.pred_group)
    after = np.searchsorted(data.gt_group, data.pred_group, side="right")
    pred, gt = ranges(first, after - first)
    gap = data.pred.box[pred, :2] - data.gt.box[gt, :2]
    # match_free prefers the largest value, so distances are negated to prefer the smallest one.
    pairs = Pairs(pred, gt, -np.hypot(gap[:, 0], gap[:, 1]))
    score, groups = data.pred.score, data.pred_group
    return match_free(pairs, score, groups, len(data.gt), -within_m)


def average_precision(data: EvaluationSet, match: np.ndarray, cls: int) -> float:
    """Returns the all-point AP of one class in percent, or NaN without objects of the class."""
    chosen = np.flatnonzero(data.pred.cls == cls)
    order = chosen[np.argsort(-data.pred.score[chosen], kind="stable")]
    num_gt = int((data.gt.cls == cls).sum())
    score, is_tp = data.pred.score[order], match[order] >= 0
    return pooled_curve(score, is_tp, np.ones(order.size), num_gt, "all_point").ap


def errors(truth: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns error vectors `[N, 2]` in meters along the line of sight to the object and across."""
    gap, to = found[:, :2] - truth[:, :2], truth[:, :2]
    to = to / np.linalg.norm(to, axis=1, keepdims=True)
    along = (gap * to).sum(1, keepdims=True) * to
    return along, gap - along


def overlapping(truth: np.ndarray, found: np.ndarray) -> list[np.ndarray]:
    """Returns four masks `[N]` of the boxes with a BEV IoU above the threshold.

    The boxes are taken as predicted, without the error along the line of sight, without the error
    across it, and with the true size and yaw.
    """
    along, across = errors(truth, found)
    tried = [found.copy() for _ in range(4)]
    tried[1][:, :2] -= along
    tried[2][:, :2] -= across
    tried[3][:, 3:] = truth[:, 3:]
    return [bev_iou(boxes[:, None], truth[:, None])[:, 0, 0] > IOU for boxes in tried]


def ap_table(data: EvaluationSet, within: tuple[float, ...]) -> Table:
    """Returns the table of APs by class and distance threshold."""
    matches = [matched(data, limit) for limit in within]
    rows = [
        [name, int((data.gt.cls == cls).sum())]
        + [number(average_precision(data, m, cls), digits=1) for m in matches]
        for cls, name in enumerate(data.classes)
    ]
    head = ["Class", "Objects", *(f"{limit:g} m" for limit in within)]
    return Table("AP by center distance, narrow region", head, rows)


def error_rows(data: EvaluationSet, match: np.ndarray) -> Iterator[list[str | int]]:
    """Yields counts, errors and fractions of overlaps by class and distance of the object."""
    hit = np.flatnonzero(match >= 0)
    truth, found = data.gt.take(match[hit]), data.pred.box[hit]
    sizes = [np.linalg.norm(e, axis=1) for e in errors(truth.box, found)]
    shares = overlapping(truth.box, found)
    every = np.hypot(data.gt.box[:, 0], data.gt.box[:, 1])
    distance = np.hypot(truth.box[:, 0], truth.box[:, 1])
    for cls, name in enumerate(data.classes):
        for low, high in itertools.pairwise(DISTANCES_M):
            there = (data.gt.cls == cls) & (low <= every) & (every < high)
            at = (truth.cls == cls) & (low <= distance) & (distance < high)
            if at.any():
                medians = [number(np.median(e[at]), digits=2) for e in sizes]
                percent = [f"{100 * np.mean(share[at]):.0f} %" for share in shares]
                counts = int(there.sum()), int(at.sum())
                yield [name, f"{low:g}-{high:g} m", *counts, *medians, *percent]


@click.command()
@click.argument(
    "report", type=click.Path(exists=True, file_okay=False, path_type=pathlib.Path)
)
@click.option(
    "--within",
    multiple=True,
    type=click.FloatRange(0.0, min_open=True),
    default=(0.5, 1.0, 2.0, 3.0),
    show_default=True,
)
def main(report: pathlib.Path, within: tuple[float, ...]) -> None:
    """Print AP by center distance and center errors of REPORT, an evaluation folder."""
    with entry.exit_codes():
        if not (report / "predictions.npz").is_file():
            raise UserError(
                f"{report} is not an evaluation folder: predictions.npz is missing; "
                "evaluate.py writes one, for a run RUN it is RUN/evaluation"
            )
        truth, found, frames, _ = load(report, Source(), CLASSES)
        data = EvaluationSet(truth, found, frames=frames, roi="narrow")
        farthest = max(within)
        head = ["Class", "Distance", "Objects", "Found", "Along m", "Across m"]
        head += [
            f"IoU > {IOU:g}",
            "no error along",
            "no error across",
            "true size, yaw",
        ]
        title = f"centers within {farthest:g} m: median errors, fraction of overlapping boxes"
        rows = list(error_rows(data, matched(data, farthest)))
        for table in (ap_table(data, within), Table(title, head, rows)):
            click.echo(table.render(is_simulated=data.is_simulated))


if __name__ == "__main__":
    main()
