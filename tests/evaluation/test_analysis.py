import re

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.evaluation import analysis
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions

CLASSES = ("Sedan", "Bus or Truck")
FRAMES = {"frame": np.arange(4) + 100, "time": np.repeat(["day", "night"], 2)}


def make(truth_rows, found_rows):
    def table(rows):
        boxes = [[x, 0.0, 0.0, 4.0, 2.0, 1.5, yaw] for _, _, x, yaw, *_ in rows]
        return {
            "frame": np.array([row[0] for row in rows], int) + 100,
            "box": np.array(boxes).reshape(-1, 7),
            "cls": np.array([row[1] for row in rows], str),
            "score": np.array([row[-1] for row in rows]),
        }

    truth, found = table(truth_rows), table(found_rows)
    return EvaluationSet(truth, found, classes=CLASSES, frames=FRAMES)


@pytest.fixture
def data():
    return make(
        [
            (0, "Sedan", 19.9, 0),
            (0, "Sedan", 30.0, 0),
            (1, "Bus or Truck", 50.0, 0),
            (2, "Sedan", 10.0, 0),
        ],
        [
            (0, "Sedan", 20.2, 0, 0.9),  # counted with the object before 20 m
            (0, "Sedan", 70.0, 0, 0.8),  # nothing there
            (1, "Sedan", 50.0, 0, 0.7),  # a bus taken for a car
            (2, "Sedan", 10.0, np.pi, 0.2),  # right, reversed, low score
            (3, "Sedan", 10.0, 0, 0.6),  # nothing there
        ],
    )


def _numbers(data, kind, frames=FRAMES):
    """Function (subset, class) -> its entry."""
    entries = analysis.subsets(data, frames, 0.3)[kind]
    return {(entry[kind], entry["cls"]): entry for entry in entries}


def test_every_kind_of_mistake_is_counted():
    data = make(
        [(0, "Sedan", 20.0, 0), (0, "Sedan", 40.0, 0), (1, "Bus or Truck", 50.0, 0)],
        [
            (0, "Sedan", 20.0, 0, 0.9),
            (0, "Sedan", 20.5, 0, 0.8),  # the same object again
            (0, "Sedan", 43.0, 0, 0.7),  # IoU 1 / 7
            (0, "Sedan", 60.0, 0, 0.6),
            (0, "Sedan", 80.0, 0, 0.2),  # below the operating score
            (1, "Sedan", 50.0, 0, 0.5),
        ],
    )
    counts = analysis.mistakes(data, 0.3)
    assert {kind: x.tolist()[:2] for kind, x in counts.items()} == {
        "missed": [[1, 0], [0, 1]],
        "duplicate": [[1, 0], [0, 0]],
        "wrong class": [[0, 0], [1, 0]],
        "poor box": [[1, 0], [0, 0]],
        "background": [[1, 0], [0, 0]],
    }


def test_by_distance_by_hand(data):
    numbers = _numbers(data, "distance")
    near = numbers["0-20 m", "Sedan"]
    # Hits at 0.9 and 0.2, the false one of frame 3 between them.
    assert (near["num_gt"], near["num_det"]) == (2, 2)
    assert near["ap"] == pytest.approx(100 * (1 / 2 + 1 / 2 * 2 / 3))
    assert (near["precision"], near["recall"]) == (0.5, 0.5)
    middle = numbers["20-40 m", "Sedan"]
    assert (middle["ap"], middle["recall"], middle["num_det"]) == (0.0, 0.0, 0)
    assert np.isnan(middle["precision"])
    far = numbers["60-80 m", "Sedan"]
    assert np.isnan(far["ap"])
    assert (far["num_gt"], far["num_det"], far["precision"]) == (0, 1, 0.0)
    assert numbers["40-60 m", "Bus or Truck"]["recall"] == 0


def test_box_errors_by_hand(data):
    errors = analysis.box_errors(data, 0.3)["Sedan"]
    assert errors["count"] == 2
    assert errors["center_m_mean"] == pytest.approx(0.15)
    assert errors["heading_deg_mean"] == pytest.approx(90)
    assert errors["axis_deg_mean"] == pytest.approx(0, abs=1e-9)
    assert errors["reversed"] == 0.5
    assert errors["length_m_median"] == 0
    assert np.isnan(analysis.box_errors(data, 0.3)["Bus or Truck"]["z_m_mean"])


def test_own_metrics_of_matched_boxes():
    boxes = np.array([[x, 0.0, 0, 4, 2, 1.5, 0] for x in (10.0, 30.0, 50.0)])
    table = {"frame": np.zeros(3, int), "cls": np.array(["Sedan"] * 3)}
    truth = {**table, "box": boxes, "speed": np.array([1.0, 2.0, np.nan])}
    order = [2, 0, 1]  # the predictions are in another order than their objects
    score = np.array([0.9, 0.8, 0.7])
    found = {**table, "box": boxes[order], "score": score}
    found["speed"] = np.array([9.0, 1.5, 4.0])
    data = EvaluationSet(truth, found, classes=("Sedan",))
    gap = lambda a, b: abs(a.extras["speed"] - b.extras["speed"])  # noqa: E731
    errors = analysis.box_errors(data, 0.3, {"gap": gap})["Sedan"]
    assert (errors["count"], errors["gap_mean"]) == (3, (0.5 + 2.0) / 2)
    with pytest.raises(UserError, match=r"gap returned is \(1,\), expected an array"):
        analysis.box_errors(data, 0.3, {"gap": lambda a, b: np.zeros(1)})


def test_worst_frames_by_hand(data):
    worst = analysis.worst_frames(data, {"sequence": np.array([5, 5, 5, 6])}, 0.3)
    assert [(w["frame"], w["missed"], w["false"], w["found"]) for w in worst] == [
        (100, 1, 1, 1),
        (101, 1, 1, 0),
        (102, 1, 0, 0),
        (103, 0, 1, 0),
    ]
    assert [entry["sequence"] for entry in worst] == [5, 5, 5, 6]


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
        (2, lambda z: z + 0.7, r", \+0.7\d\) m .*; --z-offset -0.7\d of `radejax"),
        (0, lambda x: x + 2.54, r"\(\+2.\d\d, .* LiDAR frame \+ \(-2.54, 0.3, 0\)"),
        (0, np.negative, r"60 of 60 predictions lie behind the sensor \(x < 0\)"),
        ([3, 4, 5], lambda size: size / 2, r"have 0.5\d, 0.5\d, 0.5\d times"),
        ([3, 4], lambda size: size[:, ::-1], r"have 0.4\d, 2.\d\d, 1.0\d times"),
    ],
)
def test_another_unit_or_frame_is_reported(column, change, expected):
    truth, found = _scene()
    assert _warnings(found, truth) == []
    lines = _warnings(_moved(found, column, change), truth)
    assert re.search(expected, lines[0]), lines


def test_a_correction_removes_the_warning(tmp_path):
    truth, found = _scene()
    wrong = _moved(_moved(found, 6, np.rad2deg), 2, lambda z: z + 0.7)
    frames, options = {"frame": truth["frame"]}, ReportOptions(plots=False)
    made = write_report(truth, wrong, frames, tmp_path, options)
    assert len(made.metrics["warnings"]) == made.text.count("WARNING: ") == 2
    right = load(tmp_path, Source(z_offset_m=-0.7, yaw_degrees=True), CLASSES)[1]
    np.testing.assert_allclose(right.box, found["box"])
    made = write_report(truth, right, frames, tmp_path, options)
    assert made.metrics["warnings"] == []


def test_missing_and_copied_boxes_are_reported():
    truth, found = _scene()
    twice = {name: np.concatenate([x, x[:3]]) for name, x in found.items()}
    (line,) = _warnings(twice, truth)
    assert line.startswith("3 of 63 predictions are copies of others in their frame")
    of_truth = {name: x for name, x in twice.items() if name != "score"}
    (line,) = _warnings(found, of_truth)
    assert line.startswith("3 of 63 objects are copies of others in their frame")
    # The same box of another class is no copy.
    assert _warnings(twice | {"cls": ["Sedan"] * 60 + ["Bicycle"] * 3}, truth) == []
    none = {name: x[:0] for name, x in truth.items()}
    expected = "there are no objects of the evaluated classes in the region"
    assert _warnings(found, none)[0] == expected
    (line,) = _warnings({name: x[:0] for name, x in found.items()}, truth)
    assert line == expected.replace("objects", "predictions")


def test_few_or_scattered_predictions_are_no_offset():
    truth, found = _scene()
    moved = _moved(found, 2, lambda z: z + 1)
    few = {name: column[:9] for name, column in moved.items()}
    assert _warnings(few, truth) == []
    rng = np.random.default_rng(2)
    wide = _moved(found, 2, lambda z: z + rng.normal(0.3, 1, z.size))
    assert _warnings(wide, truth) == []
