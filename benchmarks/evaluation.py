"""Time and memory of the whole evaluation on a synthetic set of the test split's size.

    python benchmarks/evaluation.py

17,536 frames of 58 sequences, five classes with about the counts of K-Radar's test split
in the narrow region, simulated predictions (jittered copies, reversed headings,
duplicates, misses, confusions, random false positives). Measured: everything from column
arrays to results (checks, pairs, rotated overlaps, matching, curves) for BEV and 3D, IoU
0.3, 0.5 and 0.7, all frames and seven weathers, in every protocol.
"""

import argparse
import resource
import time

import numpy as np

from radejax.core.structures import CLASSES
from radejax.data.kradar.sequences import WEATHERS
from radejax.evaluation.average_precision import EvaluationSet
from radejax.evaluation.protocols import PROTOCOLS
from radejax.evaluation.report.measure import Options, measure

COUNTS = (20000, 4200, 1800, 160, 570)
SIZES = ((4.4, 1.9, 1.6), (9, 2.6, 3), (0.7, 0.7, 1.7), (2, 0.8, 1.5), (1.8, 0.7, 1.6))


def synthetic_set(
    num_frames: int = 17536, false_per_frame: float = 2.0, seed: int = 0
) -> tuple[dict, dict, dict]:
    """Ground truth, predictions and frames with the counts of the real split."""
    rng = np.random.default_rng(seed)
    counts = [int(n * num_frames / 17536) for n in COUNTS]
    cls = np.repeat(np.arange(5), counts)
    num = cls.size
    # Objects gather in some frames, as in traffic.
    weight = rng.gamma(0.7, size=num_frames)
    frame = np.sort(rng.choice(num_frames, num, p=weight / weight.sum()))
    rng.shuffle(cls)
    box = np.column_stack(
        [
            rng.uniform(2, 72, num),
            rng.uniform(-6.4, 6.4, num),
            rng.normal(0.5, 0.4, num),
            np.array(SIZES)[cls] * rng.uniform(0.85, 1.15, (num, 3)),
            rng.choice([0, np.pi / 2, np.pi], num) + rng.normal(0, 0.2, num),
        ]
    )
    copies = rng.choice([0, 1, 2, 3], num, p=[0.2, 0.6, 0.15, 0.05])
    source = np.repeat(np.arange(num), copies)
    noise = rng.normal(0, [0.4, 0.25, 0.15, 0.4, 0.15, 0.12, 0.1], (source.size, 7))
    found = box[source] + noise * rng.choice([0.3, 1, 2], (source.size, 1))
    found[:, 6] += np.pi * (rng.random(source.size) < 0.1)
    found[:, 3:6] = np.maximum(np.abs(found[:, 3:6]), 0.1)
    found_cls = np.where(
        rng.random(source.size) < 0.08, rng.integers(0, 5, source.size), cls[source]
    )
    num_false = int(false_per_frame * num_frames)
    false = box[rng.integers(0, num, num_false)] + rng.normal(0, 4, (num_false, 7))
    false[:, 3:6] = np.maximum(np.abs(false[:, 3:6]), 0.3)
    frame_all = np.concatenate([frame[source], rng.integers(0, num_frames, num_false)])
    score = np.concatenate([rng.beta(4, 2, source.size), rng.beta(1.2, 4, num_false)])
    names = np.array(CLASSES)
    sequence = np.arange(num_frames) * 58 // num_frames + 1
    frames = {
        "frame": np.arange(num_frames),
        "sequence": sequence,
        "weather": np.array(WEATHERS)[sequence % 7],
    }
    predictions = {
        "frame": frame_all,
        "box": np.concatenate([found, false]),
        "cls": names[np.concatenate([found_cls, rng.integers(0, 5, num_false)])],
        "score": np.round(score, 4),
    }
    return {"frame": frame, "box": box, "cls": names[cls]}, predictions, frames


def main() -> None:
    """Runs and prints; the numbers of docs/evaluation.md are from here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=17536)
    parser.add_argument("--false_per_frame", type=float, default=2.0)
    arguments = parser.parse_args()
    truth, found, frames = synthetic_set(arguments.frames, arguments.false_per_frame)
    print(
        f"{arguments.frames} frames, {len(truth['frame'])} objects,"
        f" {len(found['frame'])} predictions"
    )
    start = time.perf_counter()
    data = EvaluationSet(truth, found, frames=frames)
    print(f"{'check, sort, pair':24s}{time.perf_counter() - start:8.2f} s")
    total = time.perf_counter() - start
    for name in PROTOCOLS:
        start = time.perf_counter()
        rows = measure(data, frames, Options(protocols=(name,)))
        took = time.perf_counter() - start
        total += took
        print(f"{name:24s}{took:8.2f} s   {len(rows)} numbers")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{'all protocols':24s}{total:8.2f} s, at most {memory:.2f} GiB of memory")


if __name__ == "__main__":
    main()
