"""How well probabilities that are fitted to scores fit other scenes.

    python examples/calibration.py --out docs/reports/calibration.json

It simulates scenes, detects objects with the model of `radejax demo`, fits temperature and offset
of every class on half of the scenes, and computes calibration errors on the others, with 95 %
intervals over resamples of the scenes. It takes a quarter of an hour on two cores.
"""

import dataclasses
import pathlib

import click
import numpy as np
import tqdm

import radejax
from radejax.cli import entry
from radejax.cli.figures import MODEL
from radejax.core import files
from radejax.core.structures import Boxes
from radejax.core.version import radejax_commit
from radejax.evaluation.boxes import tables_from_frames
from radejax.evaluation.evaluation_set import EvaluationSet, mean_ap
from radejax.evaluation.results import interval, sequence_weights
from radejax.evaluation.scores import fit_calibrations, reliability
from radejax.inference.saved import load_model
from radejax.simulation.config import SimulationOptions

IOU = 0.3
MIN_SCORES = 0.05, 0.3
"""Errors are those of all predictions, and of those that `radejax detect` writes by default."""


def scenes(folder: pathlib.Path, seed: int, count: int) -> radejax.KRadar:
    """Simulates scenes of one frame each."""
    simulation = SimulationOptions(
        seed=seed,
        train_sequences=0,
        test_sequences=count,
        frames_per_sequence=1,
        image_width=0,
        output="projection",
    )
    return radejax.KRadar([radejax.simulate(simulation, folder)])


def detect(detector: radejax.Detector, frames: radejax.KRadar) -> EvaluationSet:
    """Detects objects in all frames, and matches them in the narrow region."""
    found = []
    for i, frame in enumerate(tqdm.tqdm(frames, unit="frame", desc="detect")):
        boxes = detector(frame.read_projection(frames.grid)).to_boxes()
        found.append(dataclasses.replace(boxes, frame=boxes.frame + i))
    truth, table = tables_from_frames(frames, "test")
    return EvaluationSet(
        truth,
        Boxes.concatenate(found),
        classes=detector.classes,
        frames=table,
        roi="narrow",
    )


def errors(
    data: EvaluationSet, weights: np.ndarray, min_score: float
) -> dict[str, np.ndarray]:
    """Calibration errors `[C + 1]` of scores and probabilities, by class and their mean.

    Args:
        data: Matched predictions.
        weights: Number of times that each frame counts.
        min_score: Smallest score of the predictions that count.
    """
    is_matched = data.matched_objects("plain", "free", "3d", IOU) >= 0
    count = weights[data.pred.frame] * (data.score >= min_score)
    found = {}
    for name, values in data.confidences().items():
        of_classes = []
        for cls in range(len(data.classes)):
            rows = np.repeat(np.arange(count.size), count * (data.pred.cls == cls))
            of_classes.append(reliability(values[rows], is_matched[rows]).error)
        found[name] = np.array([*of_classes, np.mean(of_classes)])
    return found


def measure(folder: pathlib.Path, count: int, resamples: int) -> dict[str, object]:
    """Fits on scenes, and returns errors on other scenes and their ratio."""
    saved = load_model(MODEL)
    detector = radejax.Detector(saved, score_threshold=MIN_SCORES[0])
    fits = fit_calibrations(detect(detector, scenes(folder / "fit", 2001, count)), IOU)
    decode = {"calibration": [*fits.values()]}
    saved = dataclasses.replace(saved, config=saved.config.replace(decode=decode))
    calibrated = radejax.Detector(saved, score_threshold=MIN_SCORES[0])
    held_out = scenes(folder / "held_out", 2002, count)
    data = detect(calibrated, held_out)
    drawn = sequence_weights(np.arange(data.frame.size), resamples=resamples)
    rows = []
    for min_score in MIN_SCORES:
        whole = errors(data, np.ones(data.frame.size, int), min_score)
        samples = [errors(data, weights, min_score) for weights in drawn]
        ratios = np.stack([x["probability"] / x["score"] for x in samples])
        for i, cls in enumerate([*data.classes, "mean"]):
            row = {"cls": cls, "min_score": min_score}
            for name, values in whole.items():
                ends = interval(np.array([x[name][i] for x in samples]))
                row |= {name: float(values[i]), f"{name}_interval": ends}
            row["ratio"] = float(whole["probability"][i] / whole["score"][i])
            rows.append({**row, "ratio_interval": interval(ratios[:, i])})
    before = detect(detector, held_out)
    aps = [mean_ap(x.results("all_point", spaces="3d")) for x in (before, data)]
    return {
        "command": "python examples/calibration.py",
        "commit": radejax_commit(),
        "model": "radejax demo",
        "scenes": {"fit": count, "held_out": count},
        "resamples": resamples,
        "iou": IOU,
        "calibration": fits,
        "mean_ap_before_and_after": aps,
        "calibration_errors": rows,
    }


@click.command()
@click.option(
    "--folder",
    default="runs/calibration",
    type=click.Path(path_type=pathlib.Path),
    help="Folder of the simulated scenes.",
)
@click.option("--out", default="calibration.json", help="File of the result.")
@click.option(
    "--scenes", "count", default=768, help="Scenes to fit, and others to test."
)
@click.option("--resamples", default=1000, help="Resamples for the intervals.")
def main(folder: pathlib.Path, out: str, count: int, resamples: int) -> None:
    """Measure the calibration error of scores and probabilities on held-out scenes."""
    entry.set_up_jax()
    with entry.exit_codes():
        found = measure(folder, count, resamples)
        files.write_json(pathlib.Path(out), found)
        for row in found["calibration_errors"]:
            numbers = f"{row['score']:.3f} to {row['probability']:.3f}"
            low, high = row["ratio_interval"]
            of = f"{row['cls']}, score at least {row['min_score']:g}"
            print(f"{of}: {numbers}, ratio {row['ratio']:.2f} [{low:.2f}, {high:.2f}]")


if __name__ == "__main__":
    main()
