import dataclasses

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.evaluation import results
from radejax.evaluation.boxes import read_boxes, take
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import PROTOCOLS
from radejax.evaluation.results import ReportOptions, make_set, resample

from .scenes import random_scene

CLASSES = ("Sedan", "Bus or Truck")
OPTIONS = ReportOptions(iou_thresholds=(0.3,), roi=None, protocols=("all_point",))
OPTIONS = OPTIONS.replace(classes=CLASSES, bootstrap=20)
TRUTH, FOUND, FRAMES = random_scene(1, num_frames=60, num_objects=200, ties=False)


def results_of(frames=FRAMES, truth=TRUTH, found=FOUND, **changes):
    options = OPTIONS.replace(**changes)
    data = make_set(truth, found, frames, options)
    return results.compute_results(data, frames, options)


def intervals(frames, **changes):
    found = results_of(frames, **changes)
    return {row.key[1:4]: (row.low, row.ap, row.high) for row in found}


def test_weights_draw_whole_sequences():
    sequence = np.array([7, 7, 3, 9, 9, 9])
    weights = results.sequence_weights(sequence, resamples=500, seed=0)
    assert weights.shape == (500, 6)
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3:] == weights[:, 3:4]).all()
    per_sequence = weights[:, [0, 2, 3]]
    assert (per_sequence.sum(axis=1) == 3).all()
    np.testing.assert_allclose(per_sequence.mean(axis=0), 1, atol=0.15)
    again = results.sequence_weights(sequence, resamples=500, seed=0)
    np.testing.assert_array_equal(weights, again)
    with pytest.raises(UserError, match="at least 2 sequences to resample, found 1"):
        results.sequence_weights(np.zeros(4), resamples=10, seed=0)


def test_weights_of_a_condition_give_the_condition():
    data = EvaluationSet(TRUTH, FOUND, classes=CLASSES, frames=FRAMES)
    fog = FRAMES["weather"] == "fog"
    for protocol in PROTOCOLS:
        ap = resample(data, fog[None].astype(int), protocol, "3d", 0.3)[0]
        found = data.results(protocol, iou_thresholds=0.3, spaces="3d", weights=fog)
        expected = [result.ap for result in found]
        np.testing.assert_allclose(ap[:2], expected, rtol=0, atol=1e-12)
        assert ap[2] == pytest.approx(ap[:2].mean())
    # Doubling every frame changes nothing but the rounding of recall steps.
    ap = resample(data, np.stack([fog, 2 * fog]).astype(int), "all_point", "3d", 0.3)
    np.testing.assert_allclose(ap[0], ap[1], atol=1e-9)


def test_interval_covers_the_number():
    low, ap, high = intervals(FRAMES, bootstrap=200)["all", "Sedan", "3d"]
    assert low < ap < high
    samples = np.arange(101.0)
    assert results.interval(samples) == pytest.approx((2.5, 97.5))
    assert np.isnan(results.interval(np.full(5, np.nan))).all()


def test_a_class_in_one_sequence_has_no_interval():
    number = FRAMES["sequence"][TRUTH["frame"]]
    is_kept = (TRUTH["cls"] != "Sedan") | (number == number[0])
    for row in results_of(truth=take(TRUTH, is_kept)):
        if row.condition == "all":
            assert np.isnan([row.low, row.high]).all() == (row.cls == "Sedan")


def test_conditions_of_one_sequence_get_no_interval():
    weather = np.where(FRAMES["sequence"] == 0, "fog", "rain")
    found = intervals({**FRAMES, "weather": weather})
    has_interval = {key[0]: low is not None for key, (low, *_) in found.items()}
    assert has_interval == {"all": True, "fog": False, "rain": True}
    # The intervals of a condition are those of its frames evaluated as a separate dataset.
    rain = np.flatnonzero(weather == "rain")
    part = take({**FRAMES, "weather": weather}, rain)
    truth, seen = (take(x, np.isin(x["frame"], rain)) for x in (TRUTH, FOUND))
    apart = intervals(part, truth=truth, found=seen)
    for key in (k for k in found if k[0] == "rain"):
        assert found[key] == apart["all", *key[1:]]
    whole = intervals({"frame": FRAMES["frame"]})
    assert all(low is None for low, *_ in whole.values())


def test_means_are_over_classes_that_occur(scene):
    truth, found, frames = scene  # of two of the five classes
    classes = ("Sedan", "Bicycle", "Bus or Truck")
    rows = results_of(frames, truth, found, classes=classes)
    for condition in ("all", "fog"):
        of_it = [x for x in rows if (x.condition, x.space) == (condition, "3d")]
        aps = {row.cls: row.ap_or_none for row in of_it}
        assert aps["Bicycle"] is None
        assert aps["mean"] == pytest.approx((aps["Sedan"] + aps["Bus or Truck"]) / 2)


def test_excluded_boxes_and_frames_are_counted(scene):
    truth, found, frames = scene
    data = EvaluationSet(truth, found, frames=frames, roi=(6, 20, -4, 4, -3, 3))
    counts = results.exclusion_counts(data, ReportOptions(score_threshold=0.3))
    kept = len(data.gt) + counts["ground truth: center outside the region of interest"]
    assert kept == len(truth["frame"])
    above, empty = data.pred.score > 0.3, ~np.isin(np.arange(30), data.gt.frame)
    used = data.results("coco101", score_threshold=0.3, spaces="3d")
    assert list(counts.values())[-5:] == [
        (~above).sum(),
        empty.sum(),
        (empty[data.pred.frame] & above).sum(),
        above.sum() - sum(result.num_det for result in used),
        0,
    ]
    assert "predictions: score not above 0.3 (counted by all_point)" in counts


def test_folders_are_named_after_options_that_change_numbers():
    usual = {"roi": "narrow", "split": "test"}
    changes = {"roi": "narrow", "bootstrap": 5, "kitti": True, "figures": "pdf"}
    assert results.name_of_changes(changes, usual) == ""
    changes |= {"roi": None, "classes": ("Sedan", "Bus or Truck"), "sequences": (5,)}
    expected = "_roi_None_classes_Sedan_Bus-or-Truck_sequences_5"
    assert results.name_of_changes(changes, usual) == expected
    found = results.name_of_changes({"split": "/a/b c.txt"}, usual)
    assert found == "_split_-a-b-c.txt"


def test_conditions_are_in_the_papers_order():
    frames = {"frame": [0] * 4, "weather": ["sleet", "martian", "normal", "fog"]}
    masks = results.condition_masks(frames, "weather")
    assert list(masks) == ["normal", "fog", "sleet", "martian"]
    assert masks["fog"].tolist() == [False, False, False, True]
    assert results.condition_masks(frames, "time") == {}


def test_dropped_predictions_and_classes_without_objects_are_counted(scene):
    truth, found, frames = scene
    names = np.where(np.arange(len(found["cls"])) < 3, "Bicycle", found["cls"])
    found = read_boxes({**found, "cls": names}, "predictions", scored=True)
    one = found.take(np.array([0]))
    parts = [dataclasses.replace(one, num_truncated=i) for i in (0, 1, 2)]
    found = Boxes.concatenate([*parts, found])
    options = ReportOptions(roi=None)
    counts = results.exclusion_counts(make_set(truth, found, frames, options), options)
    assert counts["predictions: dropped at max_detections, as far as known"] == 3
    what = "predictions: of classes without ground truth, which have no AP"
    assert counts[what] == 6
