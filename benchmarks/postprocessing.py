"""Time from detection maps to final boxes: ours against Python loops.

    python benchmarks/postprocessing.py

One frame of 256 x 112 bins and 5 classes with 40, 100 and 400 peaks. The loops follow
the released post-processing step by step: 3x3 local maxima, one box per bin, then NMS
that compares the best remaining box with each other box in Python (polygons clipped by
shapely, in C). Both run in turn in one process, after compilation, and must keep the
same boxes. Best times in milliseconds: the machine may have other work.
"""

import argparse
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from tabulate import tabulate

from radejax.core.structures import DetectionMaps
from radejax.detection.decode import decode
from radejax.geometry.boxes import bev_corners
from radejax.geometry.radar_grid import RadarGrid

GRID = RadarGrid.kradar().padded(8)
SHAPE = (GRID.num_range, GRID.num_azimuth, 5)
THRESHOLD, NMS_IOU = 0.3, 0.3


def make_maps(num_peaks: int, seed: int = 0) -> DetectionMaps:
    """Single-bin peaks of distinct scores, far enough apart not to hide each other."""
    rng = np.random.default_rng(seed)
    logits = rng.uniform(-6, -4, SHAPE).astype(np.float32)
    cells = [(i, j) for i in range(20, 256, 3) for j in range(1, 111, 3)]
    cells = rng.permutation(cells)[:num_peaks]
    classes = rng.integers(0, 5, num_peaks)
    logits[cells[:, 0], cells[:, 1], classes] = np.linspace(4, -0.5, num_peaks)
    params = rng.normal(0, 0.3, (*SHAPE[:2], 8)).astype(np.float32)
    params[..., 3:6] += [4.5, 2.0, 1.6]
    yaw = rng.uniform(-np.pi, np.pi, SHAPE[:2])
    params[..., 6], params[..., 7] = np.sin(yaw), np.cos(yaw)
    return DetectionMaps(jnp.asarray(logits[None]), jnp.asarray(params[None]))


def loop_decode(logits: np.ndarray, params: np.ndarray) -> list[tuple]:
    """(score, class, box) of every peak, bin by bin, then NMS: by descending score."""
    scores = 1 / (1 + np.exp(-logits))
    around = np.pad(scores, [(1, 1), (1, 1), (0, 0)], constant_values=-np.inf)
    around = np.lib.stride_tricks.sliding_window_view(around, (3, 3), (0, 1))
    is_peak = (scores >= around.max((-2, -1))) & (scores > THRESHOLD)
    found = {}
    for i, j, cls in np.argwhere(is_peak):
        if (i, j) not in found or scores[i, j, cls] > found[i, j][0]:
            x, y = GRID.cell_to_ego(int(i), int(j))
            dx, dy, z, length, width, height, sin, cos = params[i, j]
            box = (x + dx, y + dy, z, length, width, height, np.arctan2(sin, cos))
            found[i, j] = (scores[i, j, cls], cls, np.array(box))
    return loop_nms(sorted(found.values(), key=lambda f: -f[0]))


def loop_nms(found: list[tuple]) -> list[tuple]:
    """Keeps the best box, drops what overlaps it, and so on with the rest."""
    kept = []
    while found:
        best, rest = found[0], found[1:]
        kept.append(best)
        found = [f for f in rest if loop_iou(best[2], f[2]) < NMS_IOU]
    return kept


def loop_iou(a: np.ndarray, b: np.ndarray) -> float:
    shape_a, shape_b = (shapely.Polygon(bev_corners(box)) for box in (a, b))
    shared = shape_a.intersection(shape_b).area
    return shared / (shape_a.area + shape_b.area - shared)


def milliseconds(function, *args) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*args))
    return 1000 * (time.perf_counter() - start)


def compare(num_peaks: int, repeats: int) -> list:
    """One row of the table; loops and ours take turns."""
    maps = make_maps(num_peaks)
    host = [np.asarray(x[0]) for x in (maps.heatmap_logits, maps.box_params)]
    ours = {
        pre_nms: jax.jit(
            functools.partial(
                decode,
                grid=GRID,
                max_detections=pre_nms,
                pre_nms=pre_nms,
                score_threshold=THRESHOLD,
                nms_iou=NMS_IOU,
            )
        )
        for pre_nms in (64, 128, 512)
    }
    kept = loop_decode(*host)
    for function in ours.values():
        jax.block_until_ready(function(maps))
    detections = ours[512](maps)
    is_valid = np.asarray(detections.is_valid[0])
    np.testing.assert_allclose(
        np.asarray(detections.boxes[0])[is_valid], [f[2] for f in kept], atol=1e-4
    )
    times = {name: [] for name in ("loops", *ours)}
    for repeat in range(repeats):
        if repeat < (3 if num_peaks <= 100 else 1):
            times["loops"].append(milliseconds(loop_decode, *host))
        for name, function in ours.items():
            times[name] += [milliseconds(function, maps) for _ in range(3)]
    best = [min(t) for t in times.values()]
    return [num_peaks, len(kept), *best, best[0] / best[-1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--peaks", type=int, nargs="+", default=[40, 100, 400])
    parser.add_argument("--repeats", type=int, default=10)
    args = parser.parse_args()
    headers = [
        "peaks",
        "kept",
        "loops [ms]",
        "K = 64",
        "K = 128",
        "K = 512",
        "speed-up",
    ]
    table = [compare(num_peaks, args.repeats) for num_peaks in args.peaks]
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}; one frame, K peaks")
    print("may enter NMS; speed-up is that of K = 512, which keeps what the loops keep")
    print(tabulate(table, headers, floatfmt=".2f"))


if __name__ == "__main__":
    main()
