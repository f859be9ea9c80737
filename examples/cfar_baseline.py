"""Evaluates the CA-CFAR baseline on a dataset.

    python examples/cfar_baseline.py --data DATA --out DATA/cfar

DATA is a K-Radar folder, simulated (`train.py` writes one below data/) or real, with its records
in DATA/records. The RCS limits between classes are fitted to the training split of DATA, or of
another folder with `--fit-data`. The detector runs on the test split of DATA, and OUT contains the
same report as for a network (`report.txt`, `metrics.json`, `tables.md`, ...).
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib

import numpy as np
from cfar import (
    CfarSettings,
    detect,
    fit_rcs_steps,
    object_rcs_db,
)
from tqdm import tqdm

from radejax.cli import entry
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, NARROW_ROI
from radejax.data.kradar import KRadar
from radejax.data.projection import decode
from radejax.data.records import Records, open_projections
from radejax.evaluation.boxes import tables_from_frames
from radejax.evaluation.report import Origin, Report, write_report
from radejax.evaluation.results import ReportOptions
from radejax.simulation.radar.tensor import RadarParameters

# The middle of the ranges of the realistic radar. Another gain would shift all cross-sections and
# the fitted limits by the same amount.
PARAMETERS = RadarParameters(gain_db=202.0, high_pass_m=15.0)


def run_baseline(
    data: str | pathlib.Path,
    out: str | pathlib.Path,
    *,
    protocols: tuple[str, ...] = (
        "all_point",
        "kradar_r40",
        "kradar_r40_corrected",
        "coco101",
    ),
    score_threshold: float = 0.05,
    bootstrap: int = 0,
    balanced: bool = False,
    fit_data: str | pathlib.Path | None = None,
) -> Report:
    """Fits on the training split, detects on the test split and writes the report.

    Args:
        data: K-Radar folder with `records/` in it.
        out: Folder of the report.
        protocols: Names of evaluation protocols.
        score_threshold: Score threshold of the network to compare with.
        bootstrap: Number of resamples of sequences for confidence intervals; 0 for none.
        balanced: Whether rare classes have the same weight as frequent ones in the fit.
        fit_data: Folder of the training split; None for `data`.

    Raises:
        UserError: The training split has no frames.
    """
    data, fit_data = pathlib.Path(data), pathlib.Path(fit_data or data)
    to_fit = KRadar(fit_data, split="train")
    if not len(to_fit):
        raise UserError(
            f"{fit_data}: no training frames to fit on; --fit-data names a folder with some"
        )
    settings = fit(open_projections(fit_data / "records"), to_fit, balanced=balanced)
    for name, least in settings.rcs_steps:
        print(f"{name} from {least:.1f} dBsm")
    records, frames = open_projections(data / "records"), KRadar(data, split="test")
    predictions = predict(records, frames, settings)
    ground_truth, table = tables_from_frames(frames, "test")
    return write_report(
        ground_truth,
        predictions,
        table,
        out,
        ReportOptions(
            classes=CLASSES,
            protocols=tuple(protocols),
            iou_thresholds=(0.3, 0.5),
            roi=NARROW_ROI,
            score_threshold=score_threshold,
            min_score=score_threshold,
            bootstrap=bootstrap,
        ),
        Origin("CFAR", left_out=frames.summary().counts),
    )


def fit(records: Records, frames: KRadar, *, balanced: bool = False) -> CfarSettings:
    """Returns settings with RCS limits that are fitted to the objects of a split."""
    names, values = [], []
    for frame in tqdm(frames, unit="frame", desc="fit"):
        projection = decode(records[frame.key])
        names += list(frame.classes)
        values += [object_rcs_db(projection, frame.boxes, records.grid, PARAMETERS)]
    rcs = np.concatenate([np.zeros(0), *values])
    found = ~np.isnan(rcs)
    names = np.array(names, dtype=np.str_)[found]
    steps = fit_rcs_steps(names, rcs[found], balanced=balanced)
    return dataclasses.replace(CfarSettings(), rcs_steps=steps)


def predict(
    records: Records, frames: KRadar, settings: CfarSettings
) -> dict[str, np.ndarray]:
    """Returns the detections of a split as columns "frame", "box", "cls" and "score"."""
    parts = []
    for index, frame in enumerate(tqdm(frames, unit="frame", desc="detect")):
        projection = decode(records[frame.key])
        found = detect(projection, records.grid, PARAMETERS, settings)
        parts.append({"frame": np.full(len(found["score"]), index), **found})
    return {
        name: np.concatenate([part[name] for part in parts])
        for name in ("frame", "box", "cls", "score")
    }


def main() -> None:
    """Evaluate a CA-CFAR detector on a dataset."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", required=True, help="K-Radar folder with records/")
    parser.add_argument("--fit-data", help="folder to fit on, where not DATA")
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--score-threshold", type=float, default=0.05)
    parser.add_argument("--bootstrap", type=int, default=0)
    parser.add_argument(
        "--balanced", action="store_true", help="rare classes weigh as much as others"
    )
    arguments = parser.parse_args()
    with entry.exit_codes():
        report = run_baseline(
            arguments.data,
            arguments.out,
            score_threshold=arguments.score_threshold,
            bootstrap=arguments.bootstrap,
            balanced=arguments.balanced,
            fit_data=arguments.fit_data,
        )
        print(report.text)


if __name__ == "__main__":
    main()
