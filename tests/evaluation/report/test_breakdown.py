import numpy as np
import pytest

from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.report import breakdown

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
    numbers = breakdown.by_distance(data, "bev", 0.3)
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
    numbers = breakdown.by_condition(data, masks, "bev", 0.3)
    assert numbers["day", "Sedan"].num_gt == 2
    assert numbers["day", "Sedan"].precision == pytest.approx(1 / 3)
    assert numbers["night", "Sedan"].ap == pytest.approx(50.0)
    assert np.isnan(numbers["night", "Bus or Truck"].ap)


def test_distance_bands_sum_to_everything(random_scene):
    truth, found, frames = random_scene(5)
    data = EvaluationSet(truth, found, classes=CLASSES, frames=frames)
    numbers = breakdown.by_distance(data, "3d", 0.3, edges_m=(0, 8, 12, 1000))
    assert sum(n.num_gt for n in numbers.values()) == len(data.gt)
    assert sum(n.num_det for n in numbers.values()) == (data.pred.score > 0.3).sum()
    whole = breakdown.by_distance(data, "3d", 0.3, edges_m=(0, 1000))
    for cls, result in zip(
        CLASSES, data.results("all_point", iou_thresholds=0.3, spaces="3d"), strict=True
    ):
        assert whole["0-1000 m", cls].ap == pytest.approx(result.ap)


def test_calibration_by_hand(data):
    bins = breakdown.calibration(data, "bev", 0.3, num_bins=2)["all"]
    assert bins["count"] == [1, 4]
    assert bins["score"] == pytest.approx([0.2, (0.9 + 0.8 + 0.7 + 0.6) / 4])
    assert bins["precision"] == pytest.approx([1.0, 0.25])
    assert bins["error"] == pytest.approx((0.8 * 1 + 0.5 * 4) / 5)
    none = breakdown.calibration(data, "bev", 0.3)["Bus or Truck"]
    assert np.isnan(none["error"])
    assert np.isnan(none["precision"]).all()


def test_box_errors_by_hand(data):
    errors = breakdown.box_errors(data, "bev", 0.3)["Sedan"]
    assert errors["count"] == 2
    assert errors["center_m_mean"] == pytest.approx(0.15)
    assert errors["heading_deg_mean"] == pytest.approx(90)
    assert errors["axis_deg_mean"] == pytest.approx(0, abs=1e-9)
    assert errors["reversed"] == 0.5
    assert errors["length_m_median"] == 0
    above = breakdown.box_errors(data, "bev", 0.3, operating_score=0.3)["Sedan"]
    assert above["count"] == 1
    assert np.isnan(breakdown.box_errors(data, "bev", 0.3)["Bus or Truck"]["z_m_mean"])


def test_confusion_by_hand(data):
    table = breakdown.confusion(data, "bev", 0.3)
    # true Sedan: one found, two not (one only below the score); the bus was called Sedan.
    assert table.tolist() == [[1, 0, 2], [1, 0, 0], [2, 0, 0]]
    everything = breakdown.confusion(data, "bev", 0.3, operating_score=0.0)
    assert everything.sum(axis=1).tolist()[:2] == [3, 1]
    assert everything.sum(axis=0).tolist()[:2] == [5, 0]


def test_worst_frames_by_hand(data):
    worst = breakdown.worst_frames(data, "bev", 0.3)
    assert [(w["frame"], w["missed"], w["false"], w["found"]) for w in worst] == [
        (100, 1, 1, 1),
        (101, 1, 1, 0),
        (102, 1, 0, 0),
        (103, 0, 1, 0),
    ]
    assert len(breakdown.worst_frames(data, "bev", 0.3, count=2)) == 2


def test_nothing_at_all():
    data = make([], [])
    assert breakdown.worst_frames(data, "bev", 0.3) == []
    assert breakdown.confusion(data, "bev", 0.3).sum() == 0
    assert breakdown.box_errors(data, "bev", 0.3)["Sedan"]["count"] == 0
    assert all(n.num_gt == 0 for n in breakdown.by_distance(data, "3d", 0.5).values())
    assert breakdown.calibration(data, "3d", 0.5)["all"]["count"] == [0] * 10
