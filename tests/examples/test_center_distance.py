"""AP by the distance of centers, and errors of centers along and across the line of sight."""

import json
import pathlib

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.config import load_module
from radejax.evaluation.evaluation_set import EvaluationSet

ROOT = pathlib.Path(__file__).resolve().parents[2]
center_distance = load_module(ROOT / "examples" / "center_distance.py")


def columns(*rows: tuple, scored: bool = False) -> dict[str, np.ndarray]:
    """Columns frame, class, x, y (and score) of boxes with edges of half a meter."""
    found = {
        "frame": np.array([row[0] for row in rows]),
        "cls": np.array([row[1] for row in rows]),
        "box": np.array([[row[2], row[3], 0, 0.5, 0.5, 1.8, 0.3] for row in rows]),
    }
    return found | ({"score": np.array([row[4] for row in rows])} if scored else {})


TRUTH = columns(
    (0, "Pedestrian", 10.0, 0.0), (0, "Pedestrian", 30.0, 0.0), (1, "Sedan", 20.0, 5.0)
)
FOUND = columns(
    (0, "Pedestrian", 10.8, 0.3, 0.9),  # near the first
    (0, "Pedestrian", 10.1, 0.0, 0.5),  # nearer, and too late
    (0, "Sedan", 30.0, 0.0, 0.8),  # of another class
    (1, "Pedestrian", 10.0, 0.0, 0.7),  # in another frame
    (0, "Pedestrian", 30.0, -2.5, 0.6),
    scored=True,
)


@pytest.fixture
def data() -> EvaluationSet:
    return EvaluationSet(TRUTH, FOUND, roi="narrow")


def names(data: EvaluationSet, match: np.ndarray) -> dict[float, float]:
    """x of the object of every matched prediction, by its score."""
    hit = match >= 0
    x = data.gt.box[match[hit], 0]
    return dict(zip(data.pred.score[hit].tolist(), x.tolist(), strict=True))


def test_the_nearest_free_object_of_class_and_frame_is_taken(
    data: EvaluationSet,
) -> None:
    assert names(data, center_distance.matched(data, 0.2)) == {0.5: 10.0}
    assert names(data, center_distance.matched(data, 1.0)) == {0.9: 10.0}
    both = {0.9: 10.0, 0.6: 30.0}
    assert names(data, center_distance.matched(data, 3.0)) == both


@pytest.mark.parametrize(
    ("within_m", "expected"),
    [
        (0.2, 100 * 1 / 2 * 1 / 4),  # one of two, at the fourth of four
        (1.0, 100 * 1 / 2),  # one of two, at the first
        (3.0, 100 * (1 / 2 + 1 / 2 * 2 / 3)),  # both, the second at the third
    ],
)
def test_ap_counts_what_is_near(
    data: EvaluationSet, within_m: float, expected: float
) -> None:
    match = center_distance.matched(data, within_m)
    pedestrian = data.classes.index("Pedestrian")
    ap = center_distance.average_precision(data, match, pedestrian)
    assert ap == pytest.approx(expected)


def test_errors_lie_along_and_across_the_line_of_sight() -> None:
    truth = np.array([[10.0, 0, 0, 1, 1, 1, 0], [0, 10.0, 0, 1, 1, 1, 0]])
    moved = truth + np.array([[0.3, 0.1, 0, 0, 0, 0, 0], [0.3, 0.1, 0, 0, 0, 0, 0]])
    along, across = center_distance.errors(truth, moved)
    np.testing.assert_allclose(along, [[0.3, 0], [0, 0.1]], atol=1e-12)
    np.testing.assert_allclose(across, [[0, 0.1], [0.3, 0]], atol=1e-12)


def test_boxes_overlap_without_the_error_that_keeps_them_apart() -> None:
    truth = np.tile(np.array([10.0, 0, 0, 1, 1, 1, 0.0]), (4, 1))
    found = truth + np.array(
        [
            [0.1, 0.1, 0, 0, 0, 0, 0],  # overlaps
            [0.9, 0.1, 0, 0, 0, 0, 0],  # too far along
            [0.1, 0.9, 0, 0, 0, 0, 0],  # too far across
            [0.1, 0.1, 0, 2, 2, 0, 0],  # too large
        ]
    )
    so, along, across, shape = center_distance.overlapping(truth, found)
    assert so.tolist() == [True, False, False, False]
    assert along.tolist() == [True, True, False, False]
    assert across.tolist() == [True, False, True, False]
    assert shape.tolist() == [True, False, False, True]


def test_a_report_gives_two_tables(tmp_path: pathlib.Path) -> None:
    np.savez(tmp_path / "ground_truth.npz", **TRUTH)
    np.savez(tmp_path / "predictions.npz", **FOUND)
    (tmp_path / "frames.json").write_text(json.dumps({"frame": [0, 1]}))
    arguments = [str(tmp_path), "--within", "1", "--within", "3"]
    result = CliRunner().invoke(center_distance.main, arguments)
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    assert "Pedestrian 2 50.0 83.3" in lines
    none = "0 % 0 % 0 % 0 %"  # 0.5 m wide
    assert f"Pedestrian 0-20 m 1 1 0.80 0.30 {none}" in lines
    assert "Pedestrian 20-40 m 1 1 0.00 2.50 0 % 0 % 100 % 0 %" in lines
