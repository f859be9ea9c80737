"""Predictions in another unit or frame get a report that says so."""

import re

import numpy as np
import pytest

from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files.load import Source
from radejax.evaluation.report import plausible, report


def _scene(num=60):
    rng = np.random.default_rng(1)
    box = np.column_stack(
        [rng.uniform(10, 60, num), rng.uniform(-6, 6, num), rng.normal(0, 0.3, num)]
        + [np.full(num, size) for size in (4.4, 1.9, 1.6)]
        + [rng.uniform(-3, 3, num)]
    )
    truth = {"frame": np.arange(num), "box": box, "cls": np.full(num, "Sedan")}
    noise = rng.normal(0, [0.3, 0.15, 0.1, 0.2, 0.1, 0.1, 0.05], (num, 7))
    return truth, {**truth, "box": box + noise, "score": rng.uniform(0.3, 1, num)}


def _warnings(found, truth):
    return plausible.warnings(found, EvaluationSet(truth, found))


def _moved(found, column, change):
    box = found["box"].copy()
    box[:, column] = change(box[:, column])
    return {**found, "box": box}


@pytest.mark.parametrize(
    ("column", "change", "expected"),
    [
        (6, np.rad2deg, r"60 predictions have \|yaw\| > 2 pi, up to 1\d\d"),
        (
            2,
            lambda z: z + 0.7,
            r"\(.0.\d\d, .0.\d\d, \+0.7\d\) m .*; --z_offset -0.7\d moves",
        ),
        (0, lambda x: x + 2.54, r"\(\+2.\d\d, .* LiDAR frame \+ \(-2.54, 0.3, 0\)"),
        (0, np.negative, r"60 of 60 predictions lie behind the sensor \(x < 0\)"),
    ],
)
def test_another_unit_or_frame_is_said(column, change, expected):
    truth, found = _scene()
    assert _warnings(found, truth) == []
    lines = _warnings(_moved(found, column, change), truth)
    assert re.search(expected, lines[0]), lines


def test_a_correction_takes_the_warning_away(tmp_path):
    truth, found = _scene()
    wrong = _moved(_moved(found, 6, np.rad2deg), 2, lambda z: z + 0.7)
    frames = {"frame": truth["frame"]}
    made = report.write_report(truth, wrong, frames, tmp_path, plots=False)
    assert len(made.metrics["warnings"]) == made.text.count("WARNING: ") == 2
    right = Source(z_offset_m=-0.7, yaw_degrees=True).corrected(wrong)
    np.testing.assert_allclose(right["box"], found["box"])
    made = report.write_report(truth, right, frames, tmp_path, plots=False)
    assert made.metrics["warnings"] == []


def test_few_or_scattered_predictions_are_no_offset():
    truth, found = _scene()
    few = {
        name: column[:9] for name, column in _moved(found, 2, lambda z: z + 1).items()
    }
    assert _warnings(few, truth) == []
    rng = np.random.default_rng(2)
    wide = _moved(found, 2, lambda z: z + rng.normal(0.3, 1, z.size))
    assert _warnings(wide, truth) == []
