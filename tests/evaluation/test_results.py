import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.evaluation.boxes import take
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.results import (
    ReportOptions,
    compute_results,
    condition_masks,
    exclusion_counts,
    interval,
    make_set,
    name_of_changes,
    resample,
    sequence_weights,
)

CLASSES = ("Sedan", "Bus or Truck")
OPTIONS = ReportOptions(
    classes=CLASSES,
    iou_thresholds=(0.3,),
    roi=None,
    bootstrap=20,
    protocols=("all_point",),
)


@pytest.fixture
def scene(random_scene):
    return random_scene(1, num_frames=60, num_objects=200, ties=False)


@pytest.fixture
def data(scene):
    return EvaluationSet(*scene[:2], classes=CLASSES, frames=scene[2])


def test_weights_draw_whole_sequences():
    sequence = np.array([7, 7, 3, 9, 9, 9])
    weights = sequence_weights(sequence, resamples=500, seed=0)
    assert weights.shape == (500, 6)
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3:] == weights[:, 3:4]).all()
    per_sequence = weights[:, [0, 2, 3]]
    assert (per_sequence.sum(axis=1) == 3).all()
    np.testing.assert_allclose(per_sequence.mean(axis=0), 1, atol=0.15)
    again = sequence_weights(sequence, resamples=500, seed=0)
    np.testing.assert_array_equal(weights, again)
    with pytest.raises(UserError, match="at least 2 sequences to resample, found 1"):
        sequence_weights(np.zeros(4), resamples=10, seed=0)


def test_a_class_in_one_sequence_has_no_interval(scene):
    truth, found, frames = scene
    sequence = dict(zip(frames["frame"], frames["sequence"], strict=True))
    number = np.array([sequence[frame] for frame in truth["frame"]])
    is_kept = (truth["cls"] != "Sedan") | (number == number[0])
    truth = {name: column[is_kept] for name, column in truth.items()}
    data = EvaluationSet(truth, found, classes=CLASSES, frames=frames)
    for row in compute_results(data, frames, OPTIONS):
        if row.condition == "all":
            assert np.isnan([row.low, row.high]).all() == (row.cls == "Sedan")


def test_folders_are_named_after_options_that_change_numbers():
    usual = {"roi": "narrow", "split": "test"}
    changes = {"roi": "narrow", "bootstrap": 5, "kitti": True, "figures": "pdf"}
    assert name_of_changes(changes, usual) == ""
    changes |= {"roi": None, "classes": ("Sedan", "Bus or Truck"), "sequences": (5,)}
    expected = "_roi_None_classes_Sedan_Bus-or-Truck_sequences_5"
    assert name_of_changes(changes, usual) == expected
    assert name_of_changes({"split": "/a/b c.txt"}, usual) == "_split_-a-b-c.txt"


def test_weights_of_a_condition_give_the_condition(scene, data):
    fog = scene[2]["weather"] == "fog"
    for mask in (np.ones(60, bool), fog):
        for protocol in ("all_point", "kradar_r40", "kradar_r11", "voc11", "coco101"):
            ap = resample(data, mask[None].astype(int), protocol, "3d", 0.3)[0]
            results = data.results(
                protocol, iou_thresholds=0.3, spaces="3d", weights=mask
            )
            expected = [result.ap for result in results]
            np.testing.assert_allclose(ap[:2], expected, rtol=0, atol=1e-12)
            assert ap[2] == pytest.approx(ap[:2].mean())
    # Doubling every frame changes nothing but the rounding of recall steps.
    ap = resample(data, np.stack([fog, 2 * fog]).astype(int), "all_point", "3d", 0.3)
    np.testing.assert_allclose(ap[0], ap[1], atol=1e-9)


def intervals(scene, frames, **changes):
    options = OPTIONS.replace(**changes)
    data = make_set(*scene[:2], frames, options)
    results = compute_results(data, frames, options)
    return {r.key[1:4]: (r.low, r.ap, r.high) for r in results}


def test_interval_covers_the_number_and_grows_with_the_level(scene):
    low, ap, high = intervals(scene, scene[2], bootstrap=200)["all", "Sedan", "3d"]
    assert low < ap < high
    samples = np.arange(101.0)
    assert interval(samples) == pytest.approx((2.5, 97.5))
    assert np.isnan(interval(np.full(5, np.nan))).all()


def test_conditions_of_one_sequence_get_no_interval(scene):
    frames = scene[2]
    weather = np.where(frames["sequence"] == 0, "fog", "rain")
    found = intervals(scene, {**frames, "weather": weather})
    has_interval = {key[0]: low is not None for key, (low, *_) in found.items()}
    assert has_interval == {"all": True, "fog": False, "rain": True}
    # The intervals of a condition are those of its frames evaluated as a separate dataset.
    rain = np.flatnonzero(weather == "rain")
    part = take({**frames, "weather": weather}, rain)
    tables = [take(table, np.isin(table["frame"], rain)) for table in scene[:2]]
    apart = intervals(tables, part)
    for key in (k for k in found if k[0] == "rain"):
        assert found[key] == apart["all", *key[1:]]
    whole = intervals(scene, {"frame": frames["frame"]})
    assert all(low is None for low, *_ in whole.values())


def test_excluded_boxes_and_frames_are_counted(random_scene):
    truth, found, frames = random_scene(8, num_frames=30, num_objects=90)
    data = EvaluationSet(truth, found, frames=frames, roi=(6, 20, -4, 4, -3, 3))
    counts = exclusion_counts(data, ReportOptions(score_threshold=0.3))
    kept = len(data.gt) + counts["ground truth: center outside the region of interest"]
    assert kept == len(truth["frame"])
    above, empty = data.pred.score > 0.3, ~np.isin(np.arange(30), data.gt.frame)
    used = data.results("coco101", score_threshold=0.3, spaces="3d")
    assert list(counts.values())[-4:] == [
        (~above).sum(),
        empty.sum(),
        (empty[data.pred.frame] & above).sum(),
        above.sum() - sum(result.num_det for result in used),
    ]
    assert "predictions: score not above 0.3 (counted by all_point)" in counts


def test_conditions_are_in_the_papers_order():
    frames = {"frame": [0] * 4, "weather": ["sleet", "martian", "normal", "fog"]}
    masks = condition_masks(frames, "weather")
    assert list(masks) == ["normal", "fog", "sleet", "martian"]
    assert masks["fog"].tolist() == [False, False, False, True]
    assert condition_masks(frames, "time") == {}
