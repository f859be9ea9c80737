import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.core.errors import DataError, UserError
from radejax.evaluation import PROTOCOLS, EvaluationSet, evaluate, mean_ap
from radejax.evaluation.boxes import columns_of

from . import reference
from .scenes import random_scene

TWO = ("Sedan", "Bus or Truck")
METHODS = {"voc11": "VOC", "recall41": "K-Radar", "coco101": "COCO", "auc": "PR-AUC"}
VARIANTS = {
    "kradar_r40": "revised",
    "kradar_r11": "legacy",
    "kradar_r40_corrected": "revised_yaw_corrected",
}
NAMES_IN_GOLDEN = {"exact": "all_point", "kradar_r40_yaw": "kradar_r40_corrected"}
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


def test_kradar_compares_boxes_with_length_and_width_swapped():
    # Side by side 1.5 m apart: 2 m wide cars hardly overlap, 4 m wide ones do.
    found = found_of(car(y=1.5))
    assert sedan(ONE, found, "kradar_r40", iou_thresholds=0.4).ap > 0
    assert sedan(ONE, found, "kradar_r40_corrected", iou_thresholds=0.4).ap == 0


@pytest.mark.parametrize(("z", "top"), [(0, 1 / 3), (-1.0, 1 / 3), (0.5, 0.5 / 3.5)])
def test_kradar_r11_takes_z_as_the_top(z, top):
    data = EvaluationSet(truth_of(car(h=3.0)), found_of(car(z=z, h=1.0)))
    assert data.overlaps("swapped_lw")["3d"] == pytest.approx(1 / 3)
    assert data.overlaps("swapped_lw_z_top")["3d"] == pytest.approx(top)


def test_kradar_rounds_ground_truth_only():
    data = EvaluationSet(truth_of(car(20.004)), found_of(car(20.004)))
    assert data.overlaps("plain")["bev"] == pytest.approx(1.0, abs=1e-12)
    expected = np.float32((4 - 0.004) / (4 + 0.004))
    (rounded,) = data.overlaps("rounded")["bev"]
    assert rounded == pytest.approx(float(expected), abs=1e-7)
    assert rounded == np.float32(rounded)


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


def test_region_of_interest_is_inclusive_and_filters_both_sides():
    truth, found = (
        truth_of(car(72.0, 6.4), car(72.1)),
        found_of(car(72.0, 6.4), car(20, -6.5)),
    )
    data = EvaluationSet(truth, found, roi="narrow")
    assert (len(data.gt), len(data.pred)) == (1, 1)
    assert data.left_out["ground truth: center outside the region of interest"] == 1
    assert data.left_out["predictions: center outside the region of interest"] == 1
    same = EvaluationSet(truth, found, roi=(0, 72, -6.4, 6.4, -2, 6))
    assert (len(same.gt), same.roi) == (1, "narrow")


def test_metric_names_carry_everything():
    terms = {"score_threshold": 0.3, "roi": "wide", "label_version": "v2.1"}
    assert evaluate(ONE, HIT, **terms)[-1].metric == (
        "ap_3d_iou30/kradar_r40/score>0.3/skip=frame/labels=v2.1/roi=wide"
    )


# Parity ---------------------------------------------------------------------------------


def test_golden_scenes(golden):
    data = np.load(golden / "evaluation_scenes.npz")
    classes = data["classes"].tolist()
    for scene in range(3):
        truth, found = (
            {
                column: data[f"{scene}_{name}_{column}"]
                for column in ("frame", "box", "cls", "score")
                if f"{scene}_{name}_{column}" in data
            }
            for name in ("truth", "found")
        )
        frames = {"frame": np.arange(data[f"{scene}_num_frames"])}
        shared_set = EvaluationSet(truth, found, classes=classes, frames=frames)
        for p, name in enumerate(data["protocols"].tolist()):
            protocol = NAMES_IN_GOLDEN.get(name, name)
            for c, cut in enumerate(data["cuts"].tolist()):
                terms = {
                    "iou_thresholds": data["ious"].tolist(),
                    "score_threshold": cut,
                }
                ap = [result.ap for result in shared_set.results(protocol, **terms)]
                expected = data[f"{scene}_ap"][p, c].reshape(-1)
                np.testing.assert_allclose(ap, expected, atol=1e-9, err_msg=protocol)


@settings(deadline=None, max_examples=12, derandomize=True)
@given(seed=st.integers(0, 10**6), ties=st.booleans(), data=st.data())
def test_equals_the_slow_implementation(seed, ties, data):
    protocol = data.draw(st.sampled_from(list(PROTOCOLS)))
    truth, found, frames = random_scene(seed, num_objects=20, ties=ties)
    terms = {"classes": TWO, "iou_thresholds": (0.2, 0.5), "frames": frames}
    for result in evaluate(truth, found, protocol=protocol, **terms):
        expected = reference.average_precision(
            protocol, truth, found, result.cls, result.space, result.iou, classes=TWO
        )
        np.testing.assert_allclose(result.ap, expected, atol=1e-9)


@pytest.fixture(scope="module")
def expected_of(shared):
    """Function (name) -> content of a JSON file next to the K-Radar evaluation set."""
    folder = shared / "fixtures" / "kradar_eval"
    return lambda name: json.loads((folder / f"{name}.json").read_text())


def test_kradar_fixture(kradar_fixture, expected_of):
    truth, found, frames = kradar_fixture
    expected = expected_of("expected_ap")
    keys = {name: key for key, name in expected["classes"].items()}
    data = EvaluationSet(truth, found, frames=frames)
    checked = 0
    for protocol, variant in VARIANTS.items():
        for cut in (0.0, 0.3):
            listed = expected["variants"][variant][f"conf_{cut}"]
            for condition, numbers in listed.items():
                mask = None if condition == "all" else frames["weather"] == condition
                for result in data.results(
                    protocol,
                    iou_thresholds=expected["iou_thresholds"],
                    score_threshold=cut,
                    weights=mask,
                ):
                    entry = numbers["classes"][keys[result.cls]]
                    assert result.num_frames == numbers["num_frames"]
                    assert result.num_gt == entry["num_gt"]
                    assert result.num_det == entry["num_det"]
                    ap = entry[result.space][str(result.iou)]
                    assert result.ap == pytest.approx(ap, abs=1e-9)
                    checked += 1
    assert checked == 3 * 2 * 8 * 2 * 3 * 5


def test_kradar_fixture_curves(kradar_fixture, expected_of):
    truth, found, frames = kradar_fixture
    expected = expected_of("expected_precision_all")
    names = expected_of("expected_ap")["classes"]
    keys = {name: key for key, name in names.items()}
    data = EvaluationSet(truth, found, frames=frames)
    for protocol, variant in list(VARIANTS.items())[::2]:
        for result in data.results(protocol, iou_thresholds=(0.3, 0.5, 0.7)):
            entry = expected[variant][keys[result.cls]][result.space][str(result.iou)]
            assert result.score.tolist() == entry["score_thresholds"]
            np.testing.assert_allclose(result.precision, entry["precision"], atol=1e-9)


def test_radenet_fixture(kradar_fixture, expected_of):
    truth, found, frames = kradar_fixture
    expected = expected_of("expected_ap_radenet")["results"]
    found = {**found, "score": found["score_unique"]}
    data = EvaluationSet(truth, found, frames=frames, roi="narrow")
    checked = 0
    for setting, conditions in expected.items():
        skip = "class" if "skip_0_gt_frames=True" in setting else "none"
        iou = float(setting.split("iou=")[1])
        for condition, spaces in conditions.items():
            mask = None if condition == "all" else frames["weather"] == condition
            for protocol, method in METHODS.items():
                results = data.results(
                    protocol, iou_thresholds=iou, empty_frames=skip, weights=mask
                )
                for result in results:
                    aps = spaces[result.space][method]["aps"]
                    assert (result.cls in aps) == result.is_defined
                    if result.is_defined:
                        assert result.ap / 100 == pytest.approx(
                            aps[result.cls], abs=1e-9
                        )
                        checked += 1
                for space, numbers in spaces.items():
                    mine = [r for r in results if r.space == space]
                    assert mean_ap(mine) / 100 == pytest.approx(
                        numbers[method]["mAP"], abs=1e-9
                    )
    assert checked > 500


def test_map_fixture(shared):
    """RADE-Net's evaluator on its own fixture; its IoU scales boxes by |(sin, cos)|."""
    data = np.load(shared / "fixtures/map/frames.npz")
    runs = json.loads((shared / "fixtures/map/map_results.json").read_text())["runs"]
    names = np.array(["Sedan", "Bus or Truck", "Pedestrian"])
    pred = data["pred"].astype(np.float64)
    norm = np.hypot(pred[:, 6], pred[:, 7])[:, None]
    yaw = np.arctan2(pred[:, 6], pred[:, 7])[:, None]
    pred_box = np.hstack([pred[:, :3], pred[:, 3:5] * norm, pred[:, 5:6], yaw])
    gt_box = data["gt_values"][:, [0, 1, 2, 4, 5, 6, 3]]
    empty = np.setdiff1d(np.arange(80), data["gt_frame"])[:3]
    selections = {"first9": np.arange(9), "no_gt_frames": empty}
    checked = 0
    for run in runs:
        chosen = selections.get(run["selection"], np.arange(80))
        gt, det = (np.isin(data[f"{n}_frame"], chosen) for n in ("gt", "pred"))
        truth = {
            "frame": data["gt_frame"][gt],
            "box": gt_box[gt],
            "cls": names[data["gt_class"][gt]],
        }
        found = {
            "frame": data["pred_frame"][det],
            "box": pred_box[det],
            "cls": names[pred[det, 9].astype(int)],
            "score": pred[det, 8],
        }
        for protocol, method in METHODS.items():
            results = evaluate(
                truth,
                found,
                classes=run["classes"],
                iou_thresholds=run["iou_threshold"],
                protocol=protocol,
                roi=run["roi"],
                spaces={"2D": "bev", "3D": "3d"}[run["dim"]],
                empty_frames="class" if run["skip_frames_without_gt"] else "none",
            )
            aps = run["results"][method]["aps"]
            assert {r.cls for r in results if r.is_defined} == set(aps)
            for result in results:
                if result.is_defined:
                    assert result.ap / 100 == pytest.approx(aps[result.cls], abs=1e-9)
                    checked += 1
    assert checked > 500


# Laws -----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15, derandomize=True)
@given(seed=st.integers(0, 10**6), protocol=st.sampled_from(list(PROTOCOLS)))
def test_ap_lies_between_0_and_100(seed, protocol):
    truth, found, frames = random_scene(seed)
    for result in evaluate(truth, found, protocol=protocol, frames=frames):
        if result.is_defined:
            assert 0 <= result.ap <= 100


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
    np.testing.assert_allclose(
        aps(truth, found, **terms), aps(*moved, **terms), atol=1e-10
    )


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
        weighted = data.results(protocol, iou_thresholds=(0.2, 0.5), weights=weight)
        repeated = evaluate(
            *copies, classes=TWO, protocol=protocol, iou_thresholds=(0.2, 0.5)
        )
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
        ({"roi": (0, 0, 1, 2, 3, 4)}, "with increasing bounds"),
        ({"classes": "Sedan"}, "expected different class names"),
        ({"classes": ("Sedan", "Sedan")}, "expected different class names"),
        ({"iou_thresholds": 30}, r"expected numbers in \[0, 1\)"),
        ({"frames": {"name": ["a"]}}, r"need a column 'frame', found \['name'\]"),
        ({"frames": {"frame": [7, 9], "weather": ["fog"]}}, "column 'weather' has"),
        ({"frames": {"frame": [7, 9, 9]}}, "frame 9 occurs twice"),
        ({"frames": {"frame": [9]}}, "ground truth: frame 7, row 0: no such frame"),
        ({"ground_truth": truth_of(car(h=-1))}, r"ground truth: .* row 0: h of the.* 0$"),
        ({"frame": None}, "predictions lack the columns.*frame"),
        ({"score": None}, "predictions lack the columns.*score"),
        ({"box": np.zeros((2, 8))}, r"predictions: columns .* boxes \(2, 8\)"),
        ({"cls": np.zeros(2, int)}, "predictions: frame 7, row 0: unknown class '0'"),
        ({"score": np.zeros(3)}, "predictions: columns of boxes differ: .* 3 scores"),
        ({"frame": np.zeros((1, 1), int)}, "column 'frame' is int64 of shape"),
        ({"frame": np.array([7.5, 9])}, "expected integer frame ids"),
        ({"frame": [7, 8]}, "frame 8, row 1: no such frame among the 2 frames"),
        ({"box": [car(), car(z=np.nan)]}, "predictions: frame 9, row 1: z .* is nan"),
        ({"box": [car(yaw=np.inf), car()]}, "frame 7, row 0: yaw of the box is inf"),
        ({"box": [car(), car(w=0)]}, "w of the box is 0 m, .*--invalid-sizes false_pos"),
        ({"score": [0.9, 1.2]}, "frame 9, row 1: score 1.2 is outside"),
        ({"score": [np.nan, 0.8]}, "frame 7, row 0: score nan is outside"),
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


def test_known_classes_that_were_not_asked_for_are_counted():
    truth = truth_of((0, car(), "Sedan"), (0, car(40), "Bicycle Group"))
    found = found_of(car(), cls="Bicycle")
    data = EvaluationSet(truth, found, classes=["Sedan"])
    assert data.left_out["ground truth: class not evaluated"] == 1
    assert data.left_out["predictions: class not evaluated"] == 1
