import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.core.errors import DataError, UserError
from radejax.evaluation import PROTOCOLS, EvaluationSet, evaluate, mean_ap
from radejax.evaluation.boxes import columns_of

from .scenes import random_scene

TWO = ("Sedan", "Bus or Truck")
PLAIN = ("voc11", "recall41", "coco101", "auc", "all_point")
LEAST = {"voc11": 100 / 11, "recall41": 100 / 41, "coco101": 100 / 101}
"""AP of RADE-Net's evaluator without any hit."""


def car(x=20.0, y=0.0, **changes):
    box = {"x": x, "y": y, "z": 0.0, "l": 4.0, "w": 2.0, "h": 1.5, "yaw": 0.0}
    return tuple({**box, **changes}.values())


def found_of(*boxes, cls="Sedan", score=0.9):
    """Columns of boxes, or of (frame, box, class, score), of frame 0 and a class."""
    rows = [row if len(row) < 7 else (0, row, cls, score) for row in boxes]
    return columns_of([(frame, cls, box, score) for frame, box, cls, score in rows])


def truth_of(*boxes):
    """Columns of boxes, or of (frame, box, class)."""
    return found_of(*(row if len(row) == 7 else (*row, 1.0) for row in boxes))


def sedan(truth, found, protocol="all_point", **terms):
    """Result of the class Sedan in the bird's-eye view."""
    return evaluate(truth, found, classes=["Sedan"], protocol=protocol, **terms)[0]


def aps(truth, found, **terms):
    """All APs of `evaluate`."""
    return np.array([result.ap for result in evaluate(truth, found, **terms)])


ONE, HIT = truth_of(car()), found_of(car())


# Numbers worked out by hand -------------------------------------------------------------


def test_frames_may_be_named_as_in_the_files_of_a_report():
    names = np.array(["1/00001_00001", "1/00002_00002"])
    by_id = [truth_of((0, car(), "Sedan"), (1, car(30.0), "Sedan")), HIT]
    by_key = [{**table, "frame": names[table["frame"]]} for table in by_id]
    table = {"frame": [0, 1], "name": names}
    expected = aps(*by_id, protocol="all_point")
    np.testing.assert_array_equal(aps(*by_key, protocol="all_point"), expected)
    found = aps(*by_key, protocol="all_point", frames=table)
    np.testing.assert_array_equal(found, expected)
    with pytest.raises(DataError, match=r"predictions: row 0: frame '1/00003'"):
        aps(by_key[0], {**HIT, "frame": np.array(["1/3"])}, frames=table)


def test_perfect_predictions_in_every_protocol():
    truth = truth_of(*((f, car(10 + f), "Sedan") for f in range(10)))
    found = found_of(*((f, car(10 + f), "Sedan", 0.9 - f / 100) for f in range(10)))
    for protocol, expected in {
        "all_point": 100.0,
        "voc11": 1000 / 11,
        "recall41": 4000 / 41,
        "coco101": 10000 / 101,
        "auc": 100.0,
        "kradar_r40": 1000 / 41,  # ten matches fill ten of 41 samples
        "kradar_r40_corrected": 1000 / 41,
        "kradar_r11": 300 / 11,  # samples 0, 4 and 8
    }.items():
        results = evaluate(truth, found, classes=["Sedan"], protocol=protocol)
        for result in results:
            assert result.ap == pytest.approx(expected, abs=1e-8), protocol
            assert (result.num_gt, result.num_det) == (10, 10)


@pytest.mark.parametrize("protocol", list(PROTOCOLS))
def test_detections_without_a_hit_get_the_least_ap(protocol):
    expected = LEAST.get(protocol, 0.0)
    assert sedan(ONE, found_of(car(60)), protocol).ap == pytest.approx(expected)
    # Half of a car has an IoU of exactly 1/2 in every geometry: thresholds are strict.
    half = found_of(car(l=2.0))
    at = sedan(ONE, half, protocol, iou_thresholds=0.5)
    assert at.ap == pytest.approx(expected)
    assert sedan(ONE, half, protocol, iou_thresholds=0.499).ap > expected + 1e-9


def test_exact_by_hand():
    # Hits and misses by falling score: + - + + -, four objects. Recall 1/4, 2/4, 3/4 at
    # precision 1, 2/3, 3/4; made monotone 1, 3/4, 3/4: (1 + 3/4 + 3/4) / 4.
    truth = truth_of(*((f, car(), "Sedan") for f in range(4)))
    found = found_of(
        (0, car(), "Sedan", 0.9),
        (1, car(50), "Sedan", 0.8),
        (1, car(), "Sedan", 0.7),
        (2, car(), "Sedan", 0.6),
        (3, car(50), "Sedan", 0.5),
    )
    result = sedan(truth, found)
    assert result.ap == pytest.approx(62.5, abs=1e-12)
    np.testing.assert_allclose(result.precision, [1, 1 / 2, 2 / 3, 3 / 4, 3 / 5])
    np.testing.assert_allclose(result.recall, [1 / 4, 1 / 4, 2 / 4, 3 / 4, 3 / 4])


def test_equal_scores_are_one_threshold():
    truth = truth_of((0, car(), "Sedan"), (1, car(), "Sedan"))
    hit, miss = (0, car(), "Sedan", 0.5), (1, car(60), "Sedan", 0.5)
    for rows in ((hit, miss), (miss, hit)):
        # Recall 1/2 at precision 1/2.
        assert sedan(truth, found_of(*rows)).ap == pytest.approx(25.0)


def test_frame_rules_differ_as_described():
    # A frame with a car, one with only a bus, one with nothing; a false car in each.
    truth = truth_of((0, car(), "Sedan"), (1, car(40), "Bus or Truck"))
    found = found_of(
        (0, car(), "Sedan", 0.5),
        (0, car(60), "Sedan", 0.9),
        (1, car(60), "Sedan", 0.8),
        (2, car(60), "Sedan", 0.7),
    )
    for skip, false in (("class", 1), ("frame", 2), ("none", 3)):
        terms = {"protocol": "all_point", "empty_frames": skip}
        result = evaluate(truth, found, classes=TWO, **terms)[0]
        assert result.ap == pytest.approx(100 / (1 + false))
        assert result.num_det == 1 + false
        assert result.empty_frames == skip
    # Only the classes that are evaluated decide which frames are empty.
    assert sedan(truth, found, empty_frames="frame").num_det == 2


def test_score_cut_is_strict_and_zero_keeps_all_in_plain_protocols():
    for protocol in ("all_point", "kradar_r40"):
        for score, kept in ((0.3, 0), (0.31, 1)):
            found = found_of(car(), score=score)
            result = sedan(ONE, found, protocol, score_threshold=0.3)
            assert result.num_det == kept
    found = found_of(car(), score=0.0)
    assert sedan(ONE, found).ap == 100
    assert sedan(ONE, found, "kradar_r40").num_det == 0


@pytest.mark.parametrize("protocol", list(PROTOCOLS))
def test_without_objects_or_predictions(protocol):
    results = evaluate(ONE, HIT, classes=TWO, protocol=protocol, spaces="bev")
    absent = results[1]
    assert not absent.is_defined
    assert absent.ap == 0 if protocol.startswith("kradar") else math.isnan(absent.ap)
    assert mean_ap(results) == results[0].ap
    assert math.isnan(mean_ap(results[1:]))
    for result in evaluate(truth_of(), found_of(), protocol=protocol):
        assert result.num_gt == result.num_det == result.num_frames == 0
    result = sedan(ONE, found_of(), protocol)
    assert (result.ap, result.num_gt) == (0, 1)


@pytest.mark.parametrize("roi", ["narrow", (0, 72, -6.4, 6.4, -2, 6)])
def test_region_and_classes_filter_both_sides_and_are_in_the_name(roi):
    group = (0, car(40), "Bicycle Group")
    inside, outside = car(72.0, 6.4), car(72.1)  # the bounds belong to the region
    truth = truth_of((0, inside, "Sedan"), (0, outside, "Sedan"), group)
    found = found_of(inside, car(20, -6.5), (0, car(), "Bicycle", 0.9))
    data = EvaluationSet(truth, found, classes=["Sedan"], roi=roi, label_version="v2.1")
    assert (len(data.gt), len(data.pred)) == (1, 1)
    assert data.left_out == {
        f"{side}: {reason}": 1
        for side in ("ground truth", "predictions")
        for reason in ("class not evaluated", "center outside the region of interest")
    }
    name = "ap_3d_iou30/kradar_r40/score>0.3/skip=frame/labels=v2.1/roi=narrow"
    assert data.results("kradar_r40", score_threshold=0.3)[-1].metric == name


# Laws -----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_perfect_predictions_are_worth_100_in_the_recommended_protocol(seed):
    truth, _, frames = random_scene(seed)
    score = np.random.default_rng(seed).random(len(truth["frame"]))
    found = {**truth, "score": score}
    data = EvaluationSet(truth, found, classes=TWO, frames=frames)
    for protocol in PROTOCOLS:
        caps = {"voc11": 1000 / 11, "recall41": 4000 / 41, "coco101": 10000 / 101}
        for result in data.results(protocol):
            if protocol in ("all_point", "auc") and result.is_defined:
                assert result.ap == pytest.approx(100, abs=1e-6)
            else:
                assert not result.ap > caps.get(protocol, 100) + 1e-9


@settings(deadline=None, max_examples=15, derandomize=True)
@given(seed=st.integers(0, 10**6), protocol=st.sampled_from(list(PROTOCOLS)))
def test_a_lower_scored_false_positive_never_raises_ap(seed, protocol):
    truth, found, frames = random_scene(seed)
    worse = {
        "frame": np.append(found["frame"], 0),
        "box": np.vstack([found["box"], car(100.0)]),
        "cls": np.append(found["cls"], "Sedan"),
        "score": np.append(found["score"], found["score"].min() / 2),
    }
    terms = {"classes": TWO, "protocol": protocol, "frames": frames}
    before, after = aps(truth, found, **terms), aps(truth, worse, **terms)
    assert not np.any(after > before + 1e-12)


@settings(deadline=None, max_examples=10, derandomize=True)
@given(seed=st.integers(0, 10**6), protocol=st.sampled_from(list(PROTOCOLS)))
def test_the_order_of_frames_does_not_matter(seed, protocol):
    truth, found, frames = random_scene(seed, ties=False)
    rng = np.random.default_rng(seed)
    rename = rng.permutation(len(frames["frame"]))
    moved = []
    for columns in (truth, found):
        frame = rename[columns["frame"]]
        order = np.argsort(frame, kind="stable")
        moved.append({k: v[order] for k, v in {**columns, "frame": frame}.items()})
    terms = {"classes": TWO, "protocol": protocol, "frames": frames}
    expected = aps(truth, found, **terms)
    np.testing.assert_allclose(aps(*moved, **terms), expected, atol=1e-10)


@settings(deadline=None, max_examples=10, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    turn=st.floats(-4, 4),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-2, 2)),
    protocol=st.sampled_from(PLAIN),
)
def test_a_common_rigid_motion_does_not_matter(seed, turn, shift, protocol):
    truth, found, frames = random_scene(seed)

    def move(columns):
        box = columns["box"].copy()
        cos, sin = np.cos(turn), np.sin(turn)
        box[:, :2] = box[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        box[:, :3] += shift
        box[:, 6] += turn
        return {**columns, "box": box}

    terms = {"classes": TWO, "protocol": protocol, "frames": frames}
    moved = aps(move(truth), move(found), **terms)
    np.testing.assert_allclose(aps(truth, found, **terms), moved, atol=1e-9)


def test_weights_repeat_frames():
    """A frame of weight 2 counts as two equal frames, in every protocol."""
    truth, found, frames = random_scene(3, ties=False)
    weight = np.random.default_rng(0).integers(0, 3, len(frames["frame"]))
    copies = []
    for columns in (truth, found):
        parts = []
        for copy in range(2):
            rows = np.flatnonzero(weight[columns["frame"]] > copy)
            part = {k: v[rows] for k, v in columns.items()}
            part["frame"] = part["frame"] + 1000 * copy
            parts.append(part)
        copies.append({k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
    data = EvaluationSet(truth, found, classes=TWO, frames=frames)
    for protocol in ("all_point", "kradar_r40", "kradar_r11", "kradar_r40_corrected"):
        terms = {"protocol": protocol, "iou_thresholds": (0.2, 0.5)}
        weighted = data.results(weights=weight, **terms)
        repeated = evaluate(*copies, classes=TWO, **terms)
        for one, other in zip(weighted, repeated, strict=True):
            assert one.num_gt == other.num_gt
            np.testing.assert_allclose(one.ap, other.ap, atol=1e-9)


# Wrong use ------------------------------------------------------------------------------


def found_at(**changes):
    """Two predictions in the frames 7 and 9 of which some columns are changed."""
    found = found_of((7, car(), "Sedan", 0.9), (9, car(), "Sedan", 0.8))
    return {k: v for k, v in {**found, **changes}.items() if v is not None}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protocol": "r40"}, "protocols is 'r40', expected 'kradar_r40' or"),
        ({"spaces": "2d"}, "spaces is .* expected some of"),
        ({"empty_frames": "all"}, "empty_frames is 'all', expected one of"),
        ({"roi": "wider"}, "roi is 'wider', expected one of narrow, wide"),
        ({"roi": (0, 1, 2)}, "expected x0, x1, y0, y1"),
        ({"classes": "Sedan"}, "expected different class names"),
        ({"frames": {"name": ["a"]}}, r"need a column 'frame', found \['name'\]"),
        ({"frames": {"frame": [7, 9], "weather": ["fog"]}}, "column 'weather' has"),
        ({"frames": {"frame": [9]}}, "ground truth: frame 7, row 0: no such frame"),
        ({"ground_truth": truth_of(car(h=-1))}, r"ground truth: .* row 0: h of the.* 0$"),
        ({"frame": None}, "predictions lack the columns.*frame"),
        ({"box": np.zeros((2, 8))}, r"predictions: columns .* boxes \(2, 8\)"),
        ({"box": [car(), car(z=np.nan)]}, "predictions: frame 9, row 1: z .* is nan"),
        ({"box": [car(), car(w=0)]}, "w of the box is 0 m, .*--invalid-sizes false_pos"),
        ({"score": [0.9, 1.2]}, "frame 9, row 1: score 1.2 is outside"),
        ({"cls": ["Sedan", "Tram"]}, "row 1: unknown class 'Tram'; known: Sedan"),
    ],
)  # fmt: skip
def test_wrong_arguments_and_rows_are_named(change, message):
    terms = {
        "ground_truth": truth_of((7, car(), "Sedan"), (9, car(), "Sedan")),
        "frames": {"frame": np.array([7, 9])},
    }
    columns = {k: v for k, v in change.items() if k in HIT}
    terms |= {k: v for k, v in change.items() if k not in HIT}
    with pytest.raises((DataError, UserError), match=message):
        evaluate(predictions=found_at(**columns), **terms)


def test_far_too_many_boxes_of_a_frame_are_rejected_at_once():
    truth, found = truth_of(*[car()] * 2000), found_of(*[car()] * 20000)
    message = "frame 0: predictions and ground truths of Sedan are 40,000,000 pairs"
    with pytest.raises(DataError, match=message):
        evaluate(truth, found)
    half = {name: column[:500] for name, column in found.items()}  # 10**6 pairs are not
    assert EvaluationSet(truth, half).pair_gt.size == 1_000_000
