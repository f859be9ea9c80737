"""The table of calibration errors on held-out scenes."""

import json
import pathlib
from typing import Any

import calibration
import numpy as np
import pytest
from click.testing import CliRunner

from radejax.core.structures import CLASSES
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.scores import calibrated

FIT = 0.4, -1.0


def test_errors_are_those_of_known_scenes(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matches are drawn with the probability of a known temperature and offset."""

    def detect(detector: Any, seed: int) -> EvaluationSet:
        rng = np.random.default_rng(seed)
        count = 2000
        box = np.tile([20.0, 0, 0, 4, 2, 1.5, 0], (count, 1))
        cls = np.resize(CLASSES, count)
        truth = {"frame": np.arange(count), "box": box, "cls": cls}
        score = rng.uniform(0.05, 0.95, count)
        is_far = rng.random(count) > calibrated(score, *FIT)
        away = np.array([0, 30.0, 0, 0, 0, 0, 0])
        found = {**truth, "box": box + is_far[:, None] * away, "score": score}
        if (fits := detector.decode_options.calibration) is not None:
            pairs = np.array(fits)[np.arange(count) % len(CLASSES)]
            found["probability"] = calibrated(score, *pairs.T)
        return EvaluationSet(truth, found, classes=CLASSES, roi=None)

    monkeypatch.setattr(calibration, "scenes", lambda folder, seed, count: seed)
    monkeypatch.setattr(calibration, "detect", detect)
    out = tmp_path / "found.json"
    command = ["--out", str(out), "--scenes", "5", "--resamples", "20"]
    done = CliRunner().invoke(calibration.main, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    assert found["mean_ap_before_and_after"][0] == found["mean_ap_before_and_after"][1]
    rows = {row["cls"]: row for row in found["calibration_errors"][:6]}
    assert [*rows] == [*CLASSES, "mean"]
    assert [row["min_score"] for row in found["calibration_errors"][5:7]] == [0.05, 0.3]
    mean = rows["mean"]
    assert mean["score"] > 0.14 > 0.05 > mean["probability"]
    assert mean["ratio"] == mean["probability"] / mean["score"]
    low, high = mean["ratio_interval"]
    assert low < mean["ratio"] * 1.2
    assert 0.1 < high < 0.6
    assert "mean, score at least 0.3: 0." in done.output
