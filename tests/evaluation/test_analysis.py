import re

import numpy as np
import pytest

from radejax.evaluation import analysis, report
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load, write_table

CLASSES = ("Sedan", "Bus or Truck")


def make(truth_rows, found_rows, num_frames=4):
    def box(x, y=0.0, yaw=0.0, length=4.0):
        return [x, y, 0.0, length, 2.0, 1.5, yaw]

    truth = {
        "frame": [r[0] for r in truth_rows],
        "box": np.array([box(*r[2]) for r in truth_rows]).reshape(-1, 7),
        "cls": np.array([r[1] for r in truth_rows], str),
    }
    found = {
        "frame": [r[0] for r in found_rows],
        "box": np.array([box(*r[2]) for r in found_rows]).reshape(-1, 7),
        "cls": np.array([r[1] for r in found_rows], str),
        "score": [r[3] for r in found_rows],
    }
    frames = {"frame": np.arange(num_frames) + 100}
    truth["frame"] = np.array(truth["frame"], int) + 100
    found["frame"] = np.array(found["frame"], int) + 100
    return EvaluationSet(truth, found, classes=CLASSES, frames=frames)


@pytest.fixture
def data():
    return make(
        [
            (0, "Sedan", (19.9,)),
            (0, "Sedan", (30.0,)),
            (1, "Bus or Truck", (50.0,)),
            (2, "Sedan", (10.0,)),
        ],
        [
            (0, "Sedan", (20.2,), 0.9),  # belongs to the object before 20 m
            (0, "Sedan", (70.0,), 0.8),  # nothing there
            (1, "Sedan", (50.0,), 0.7),  # a bus taken for a car
            (2, "Sedan", (10.0, 0.0, np.pi), 0.2),  # right, reversed, low score
            (3, "Sedan", (10.0,), 0.6),  # nothing there
        ],
    )


def test_by_distance_by_hand(data):
    numbers = analysis.by_distance(data, "bev", 0.3)
    near = numbers["0-20 m", "Sedan"]
    # Hits at 0.9 and 0.2, the false one of frame 3 between them.
    assert (near.num_gt, near.num_det) == (2, 2)
    assert near.ap == pytest.approx(100 * (1 / 2 + 1 / 2 * 2 / 3))
    assert (near.precision, near.recall) == (0.5, 0.5)
    middle = numbers["20-40 m", "Sedan"]
    assert (middle.ap, middle.recall, middle.num_det) == (0.0, 0.0, 0)
    assert np.isnan(middle.precision)
    far = numbers["60-80 m", "Sedan"]
    assert np.isnan(far.ap)
    assert (far.num_gt, far.num_det, far.precision) == (0, 1, 0.0)
    assert numbers["40-60 m", "Bus or Truck"].recall == 0


def test_by_condition_by_hand(data):
    masks = {"day": np.array([True, True, False, False]), "night": np.arange(4) > 1}
    numbers = analysis.by_condition(data, masks, "bev", 0.3)
    assert numbers["day", "Sedan"].num_gt == 2
    assert numbers["day", "Sedan"].precision == pytest.approx(1 / 3)
    assert numbers["night", "Sedan"].ap == pytest.approx(50.0)
    assert np.isnan(numbers["night", "Bus or Truck"].ap)


def test_distance_bands_sum_to_everything(random_scene):
    truth, found, frames = random_scene(5)
    data = EvaluationSet(truth, found, classes=CLASSES, frames=frames)
    numbers = analysis.by_distance(data, "3d", 0.3, edges_m=(0, 8, 12, 1000))
    assert sum(n.num_gt for n in numbers.values()) == len(data.gt)
    assert sum(n.num_det for n in numbers.values()) == (data.pred.score > 0.3).sum()
    whole = analysis.by_distance(data, "3d", 0.3, edges_m=(0, 1000))
    for cls, result in zip(
        CLASSES, data.results("all_point", iou_thresholds=0.3, spaces="3d"), strict=True
    ):
        assert whole["0-1000 m", cls].ap == pytest.approx(result.ap)


def test_box_errors_by_hand(data):
    errors = analysis.box_errors(data, "bev", 0.3)["Sedan"]
    assert errors["count"] == 2
    assert errors["center_m_mean"] == pytest.approx(0.15)
    assert errors["heading_deg_mean"] == pytest.approx(90)
    assert errors["axis_deg_mean"] == pytest.approx(0, abs=1e-9)
    assert errors["reversed"] == 0.5
    assert errors["length_m_median"] == 0
    above = analysis.box_errors(data, "bev", 0.3, operating_score=0.3)["Sedan"]
    assert above["count"] == 1
    assert np.isnan(analysis.box_errors(data, "bev", 0.3)["Bus or Truck"]["z_m_mean"])


def test_worst_frames_by_hand(data):
    worst = analysis.worst_frames(data, "bev", 0.3)
    assert [(w["frame"], w["missed"], w["false"], w["found"]) for w in worst] == [
        (100, 1, 1, 1),
        (101, 1, 1, 0),
        (102, 1, 0, 0),
        (103, 0, 1, 0),
    ]
    assert len(analysis.worst_frames(data, "bev", 0.3, count=2)) == 2


def test_nothing_at_all():
    data = make([], [])
    assert analysis.worst_frames(data, "bev", 0.3) == []
    assert analysis.box_errors(data, "bev", 0.3)["Sedan"]["count"] == 0
    assert all(n.num_gt == 0 for n in analysis.by_distance(data, "3d", 0.5).values())


# Sanity checks ------------------------------------------------------------------------


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
    return analysis.sanity_checks(EvaluationSet(truth, found))


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
            r"\(.0.\d\d, .0.\d\d, \+0.7\d\) m .*; --z-offset -0.7\d moves",
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
    write_table(tmp_path / "found.npz", wrong)
    write_table(tmp_path / "truth.npz", truth)
    source = Source(
        ground_truth=str(tmp_path / "truth.npz"), z_offset_m=-0.7, yaw_degrees=True
    )
    right = load(tmp_path / "found.npz", source, CLASSES)[1]
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
