import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.evaluation import bootstrap
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.results import EvaluationOptions, evaluate_tables

CLASSES = ("Sedan", "Bus or Truck")


@pytest.fixture
def scene(random_scene):
    return random_scene(1, num_frames=60, num_objects=200, ties=False)


def make(truth, found, frames, **changes):
    return EvaluationSet(truth, found, classes=CLASSES, frames=frames, **changes)


def thin(found, keep, seed=0):
    rows = np.random.default_rng(seed).random(len(found["score"])) < keep
    return {k: v[rows] for k, v in found.items()}


def test_weights_draw_whole_sequences():
    sequence = np.array([7, 7, 3, 9, 9, 9])
    weights = bootstrap.sequence_weights(sequence, resamples=500, seed=0)
    assert weights.shape == (500, 6)
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3:] == weights[:, 3:4]).all()
    per_sequence = weights[:, [0, 2, 3]]
    assert (per_sequence.sum(axis=1) == 3).all()
    np.testing.assert_allclose(per_sequence.mean(axis=0), 1, atol=0.15)
    again = bootstrap.sequence_weights(sequence, resamples=500, seed=0)
    np.testing.assert_array_equal(weights, again)
    with pytest.raises(UserError, match="at least 2 sequences to resample, found 1"):
        bootstrap.sequence_weights(np.zeros(4), resamples=10, seed=0)


def test_weight_one_is_the_result_itself(scene):
    data = make(*scene)
    ones = np.ones((1, 60), int)
    for protocol in ("all_point", "kradar_r40", "coco101"):
        ap = bootstrap.resample(data, ones, protocol, "3d", 0.3)[0]
        results = data.results(protocol, iou_thresholds=0.3, spaces="3d")
        np.testing.assert_allclose(ap[:2], [r.ap for r in results])
        assert ap[2] == pytest.approx(ap[:2].mean())


def test_weights_of_a_condition_give_the_condition(scene):
    data, mask = make(*scene), scene[2]["weather"] == "fog"
    weights = np.stack([mask, 2 * mask]).astype(int)
    for protocol in ("all_point", "kradar_r40", "kradar_r11", "voc11"):
        ap = bootstrap.resample(data, weights[:1], protocol, "3d", 0.3)[0]
        results = data.results(protocol, iou_thresholds=0.3, spaces="3d", weights=mask)
        np.testing.assert_allclose(ap[:2], [r.ap for r in results], rtol=0, atol=1e-12)
    # Doubling every frame changes nothing but the rounding of recall steps.
    ap = bootstrap.resample(data, weights, "all_point", "3d", 0.3)
    np.testing.assert_allclose(ap[0], ap[1], atol=1e-9)


def intervals(scene, frames, **changes):
    settings = {"bootstrap": 200, "protocols": ("all_point",), **changes}
    options = EvaluationOptions(
        classes=CLASSES, iou_thresholds=(0.3,), roi=None, **settings
    )
    _, results = evaluate_tables(*scene[:2], frames, options)
    return {r.key[1:4]: (r.low, r.ap, r.high) for r in results}


def test_interval_covers_the_number_and_grows_with_the_level(scene):
    low, ap, high = intervals(scene, scene[2])["all", "Sedan", "3d"]
    assert low < ap < high
    samples = np.arange(101.0)
    assert bootstrap.interval(samples) == pytest.approx((2.5, 97.5))
    assert np.isnan(bootstrap.interval(np.full(5, np.nan))).all()


def test_conditions_of_one_sequence_get_no_interval(scene):
    frames = scene[2]
    weather = np.where(frames["sequence"] == 0, "fog", "rain")
    found = intervals(scene, {**frames, "weather": weather}, bootstrap=20)
    has_interval = {key[0]: low is not None for key, (low, *_) in found.items()}
    assert has_interval == {"all": True, "fog": False, "rain": True}
    # The intervals of a condition are those of its frames as a dataset of their own.
    rain = np.flatnonzero(weather == "rain")
    part = {name: column[rain] for name, column in frames.items()} | {
        "weather": weather[rain]
    }
    tables = [
        {k: v[np.isin(t["frame"], rain)] for k, v in t.items()} for t in scene[:2]
    ]
    apart = intervals(tables, part, bootstrap=20)
    for key in (k for k in found if k[0] == "rain"):
        assert found[key] == apart["all", *key[1:]]
    whole = intervals(scene, {"frame": frames["frame"]})
    assert all(low is None for low, *_ in whole.values())


def test_a_run_does_not_differ_from_itself(scene):
    data = make(*scene)
    rows = bootstrap.compare(data, data, scene[2]["sequence"], resamples=100)
    assert {row.cls for row in rows} == {"Sedan", "Bus or Truck", "mean"}
    for row in rows:
        assert (row.difference, row.low, row.high) == (0, 0, 0)
        assert row.p_value == 1
        assert not row.is_significant


def test_a_large_difference_is_significant_and_antisymmetric(scene):
    truth, found, frames = scene
    good, bad = make(truth, found, frames), make(truth, thin(found, 0.3), frames)
    terms = {
        "resamples": 1000,
        "iou_thresholds": (0.2,),
        "protocol_names": ("all_point",),
    }
    forward = bootstrap.compare(bad, good, frames["sequence"], **terms)
    backward = bootstrap.compare(good, bad, frames["sequence"], **terms)
    for one, other in zip(forward, backward, strict=True):
        assert one.difference == pytest.approx(-other.difference)
        assert (one.low, one.high) == pytest.approx((-other.high, -other.low))
        assert one.p_value == pytest.approx(other.p_value)
    sedan = next(row for row in forward if row.cls == "Sedan")
    assert sedan.difference > 10
    assert sedan.low > 0
    assert sedan.is_significant


def test_the_comparison_is_paired(scene):
    """The interval of the difference is narrower than unpaired resampling gives."""
    truth, found, frames = scene
    one, other = make(truth, found, frames), make(truth, thin(found, 0.95), frames)
    row = bootstrap.compare(
        one, other, frames["sequence"], resamples=300, protocol_names=("all_point",)
    )[0]
    weights = bootstrap.sequence_weights(frames["sequence"], resamples=300, seed=0)
    apart = bootstrap.sequence_weights(frames["sequence"], resamples=300, seed=1)
    gap = (
        bootstrap.resample(other, weights, "all_point", "bev", 0.3)
        - bootstrap.resample(one, apart, "all_point", "bev", 0.3)
    )[:, 0]
    low, high = bootstrap.interval(gap)
    assert row.high - row.low < 0.7 * (high - low)


def test_holm():
    p = [0.01, 0.04, 0.03, 0.005]
    rows = [
        bootstrap.Comparison("a", "3d", 0.3, "all_point", 0, 0, 0, 0, 0, value, value)
        for value in p
    ]
    rows = bootstrap._holm(rows)
    adjusted = [row.p_adjusted for row in rows]
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert [row.is_significant for row in rows] == [True, False, False, True]


def test_runs_on_different_data_cannot_be_compared(scene):
    truth, found, frames = scene
    data = make(truth, found, frames)
    other = {k: v[1:] for k, v in truth.items()}
    with pytest.raises(UserError, match=r"different objects \(200 and 199\)"):
        bootstrap.compare(data, make(other, found, frames), frames["sequence"])
    moved = {**truth, "box": truth["box"] + 0.1}
    with pytest.raises(UserError, match="different objects"):
        bootstrap.compare(data, make(moved, found, frames), frames["sequence"])
    three = EvaluationSet(truth, found, classes=(*CLASSES, "Bicycle"), frames=frames)
    with pytest.raises(UserError, match="different classes"):
        bootstrap.compare(data, three, frames["sequence"])
