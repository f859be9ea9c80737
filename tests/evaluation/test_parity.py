"""AP that other code found: K-Radar's own, RADE-Net's own and a slow implementation."""

import json

import numpy as np
import pytest

from radejax.evaluation import EvaluationSet, matching
from radejax.evaluation.boxes import take

from .scenes import kradar_scene, random_scene

VARIANTS = {
    "kradar_r40": "revised",
    "kradar_r11": "legacy",
    "kradar_r40_corrected": "revised_yaw_corrected",
}
"""K-Radar's names of our protocols, in the order of the golden file."""
METHODS = ("voc11", "recall41", "coco101", "auc")
"""RADE-Net's protocols, in the order of the golden file."""


def aps(results):
    return np.array([result.ap for result in results])


def test_k_radars_own_code_on_a_scene(golden):
    """By tests/golden/kradar_make.py of commit a8ba2f18; with ties, crowds and empty frames."""
    expected = np.load(golden / "kradar_official.npz")
    truth, found, frames = kradar_scene()
    data = EvaluationSet(truth, found, frames=frames)
    for v, protocol in enumerate(VARIANTS):
        for c, cut in enumerate(expected["cuts"].tolist()):
            for k, condition in enumerate(expected["conditions"].tolist()):
                is_used = frames["weather"] == condition
                results = data.results(
                    protocol,
                    iou_thresholds=expected["ious"].tolist(),
                    score_threshold=cut,
                    weights=None if condition == "all" else is_used,
                )
                ap = expected["ap"][v, c, k].ravel()
                assert (ap > 0).any()
                name = f"{protocol} {condition} {cut}"
                np.testing.assert_allclose(aps(results), ap, atol=1e-9, err_msg=name)
        of_all = data.results(protocol, iou_thresholds=expected["ious"].tolist())
        curves = (expected[name][v].reshape(-1, 41) for name in ("scores", "precision"))
        for one, score, precision in zip(of_all, *curves, strict=True):
            count = one.score.size
            np.testing.assert_allclose(one.score, score[:count], rtol=1e-6)
            np.testing.assert_allclose(one.precision, precision[:count], rtol=1e-6)
            assert not precision[count:].any()


def test_radenets_own_code_on_a_scene(golden):
    """Its IoU scales boxes by |(sin, cos)|."""
    data = np.load(golden / "radenet_map.npz")
    names = np.array(["Sedan", "Bus or Truck", "Pedestrian"])
    pred = data["pred"].astype(np.float64)
    norm = np.hypot(pred[:, 6], pred[:, 7])[:, None]
    yaw = np.arctan2(pred[:, 6], pred[:, 7])[:, None]
    box = np.hstack([pred[:, :3], pred[:, 3:5] * norm, pred[:, 5:6], yaw])
    found = {"frame": data["pred_frame"], "box": box, "score": pred[:, 8]}
    found["cls"] = names[pred[:, 9].astype(int)]
    box = data["gt_values"][:, [0, 1, 2, 4, 5, 6, 3]]
    truth = {"frame": data["gt_frame"], "box": box, "cls": names[data["gt_class"]]}
    empty = np.setdiff1d(np.arange(80), truth["frame"])[:3]
    selections = np.arange(80), np.arange(9), empty
    for chosen, of_selection in zip(selections, data["ap"], strict=True):
        part = [take(x, np.isin(x["frame"], chosen)) for x in (truth, found)]
        for r, roi in enumerate(("narrow", "wide")):
            shared_set = EvaluationSet(*part, classes=names.tolist(), roi=roi)
            for s, empty_frames in enumerate(("class", "none")):
                for m, protocol in enumerate(METHODS):
                    terms = {"iou_thresholds": (0.3, 0.5), "empty_frames": empty_frames}
                    results = shared_set.results(protocol, **terms)
                    expected = 100 * of_selection[:, :, r, s, m].ravel()
                    is_defined = [x.is_defined for x in results]
                    found_aps = np.where(is_defined, aps(results), np.nan)
                    np.testing.assert_allclose(found_aps, expected, atol=1e-7)


@pytest.mark.parametrize("chunk", [97, 10**6])
def test_a_slow_implementation_on_three_scenes(golden, monkeypatch, chunk):
    """Loops over frames, boxes and thresholds, with shapely, wrote the golden file.

    They are tests/evaluation/reference.py and tests/golden/evaluation_scenes.py of commit fcc0c24.
    """
    monkeypatch.setattr(matching, "PAIRS_PER_CHUNK", chunk)
    data = np.load(golden / "evaluation_scenes.npz")
    ious, cuts = data["ious"].tolist(), data["cuts"].tolist()
    for scene, expected in enumerate(data["ap"]):
        sizes = {"num_frames": 40, "num_objects": 120, "num_classes": 3}
        truth, found, frames = random_scene(101 + scene, ties=scene != 1, **sizes)
        classes = data["classes"].tolist()
        shared_set = EvaluationSet(truth, found, classes=classes, frames=frames)
        for p, protocol in enumerate(data["protocols"].tolist()):
            for c, cut in enumerate(cuts):
                terms = {"iou_thresholds": ious, "score_threshold": cut}
                found_aps = aps(shared_set.results(protocol, **terms))
                wanted = expected[p, c].ravel()
                np.testing.assert_allclose(found_aps, wanted, 0, 1e-9, err_msg=protocol)


def test_k_radars_own_code_on_real_labels(shared):
    folder = shared / "fixtures" / "kradar_eval"
    expected = json.loads((folder / "expected_ap.json").read_text())
    truth = np.load(folder / "ground_truth.npz")
    found = np.load(folder / "predictions.npz")
    names, weather = truth["class_names"], truth["frame_weather"]
    columns = []
    for table in (truth, found):
        column = {k: table[k] for k in ("frame", "box", "score") if k in table}
        columns.append(column | {"cls": names[table["cls"]]})
    data = EvaluationSet(*columns, frames={"frame": np.arange(weather.size)})
    keys = {name: key for key, name in expected["classes"].items()}
    checked = 0
    for protocol, variant in VARIANTS.items():
        for cut in (0.0, 0.3):
            listed = expected["variants"][variant][f"conf_{cut}"]
            for condition, numbers in listed.items():
                for result in data.results(
                    protocol,
                    iou_thresholds=expected["iou_thresholds"],
                    score_threshold=cut,
                    weights=None if condition == "all" else weather == condition,
                ):
                    entry = numbers["classes"][keys[result.cls]]
                    assert result.num_frames == numbers["num_frames"]
                    assert result.num_gt == entry["num_gt"]
                    assert result.num_det == entry["num_det"]
                    ap = entry[result.space][str(result.iou)]
                    assert result.ap == pytest.approx(ap, abs=1e-9)
                    checked += 1
    assert checked == 3 * 2 * 8 * 2 * 3 * 5
