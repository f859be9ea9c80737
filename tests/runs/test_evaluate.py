"""What is done to the frames of a run before it is evaluated."""

import dataclasses
import json
import pathlib
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.config import Config
from radejax.core.errors import UserError
from radejax.core.structures import DetectionMaps
from radejax.data.kradar import Frame
from radejax.detection.decode import DecodeOptions, decode
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import evaluate
from radejax.runs.evaluate import report_options

DATA = {
    "choosing_split": "test",
    "preprocess": lambda: None,
    "input_of": lambda split: ("mean", split),
}


def _shuffled(paths, seed):
    """Frames 0, 1, ... with images (and calibrations) of these names, shuffled."""
    blank = {field.name: None for field in dataclasses.fields(Frame)}
    frames = []
    for i, path in enumerate(paths):
        fields = {"camera_path": path, "camera_calibration_path": path}
        frames.append(Frame(**blank | fields | {"name": str(i)}))
    data = SimpleNamespace(camera=True, split=lambda _: frames)
    return evaluate.with_shuffled_images(data, "test", seed)


def test_every_frame_sees_another_ones_image():
    paths = ["a", "b", None, "c", "d", "e"]
    shuffled = _shuffled(paths, 3)
    found = [frame.camera_path for frame in shuffled]
    assert [frame.name for frame in shuffled] == list("012345")
    assert sorted(filter(None, found)) == ["a", "b", "c", "d", "e"]
    assert found[2] is None
    assert all(a != b for a, b in zip(found, paths, strict=True) if b is not None)
    assert found == [frame.camera_calibration_path for frame in shuffled]
    again = [[f.camera_path for f in _shuffled(paths, seed)] for seed in range(3, 8)]
    assert found == again[0]
    assert any(found != other for other in again[1:])


def test_images_of_fewer_than_two_frames_cannot_be_shuffled():
    with pytest.raises(UserError, match="two frames with an image, found 1"):
        _shuffled(["a", None], 0)


def test_a_cut_when_scoring_is_a_cut_when_decoding():
    """What lies below the cut takes no part in NMS and costs no row of those above."""
    rng = np.random.default_rng(0)
    bins = {"num_range": 24, "num_elevation": 4, "num_azimuth": 16}
    grid = RadarGrid.reduced(num_doppler=4, **bins)
    params = rng.normal((0, 0, 0, 5, 3, 2, 0, 1), 1, (2, 24, 16, 8))
    maps = DetectionMaps(
        jnp.asarray(rng.normal(-5, 2, (2, 24, 16, 5)), jnp.float32),
        jnp.asarray(params, jnp.float32),
    )

    def columns(score):
        options = DecodeOptions(max_detections=30, score_threshold=score)
        decoded = jax.jit(lambda x: decode(x, grid, options))(maps)
        return decoded.to_boxes().columns()

    low, high = columns(0.05), columns(0.3)
    assert len(low["score"]) > len(high["score"]) > 10
    above = low["score"] > 0.3
    for name, column in high.items():
        np.testing.assert_array_equal(low[name][above], column)


def test_settings_of_a_run_hold_for_all_protocols_except_all_point():
    config = Config().replace(evaluation={"empty_frames": "class"})
    options = report_options(config)
    expected = {"score_threshold": 0.3, "empty_frames": "class"}
    assert options.settings_of("kradar_r40") == expected
    expected = {"score_threshold": 0.05, "empty_frames": "protocol"}
    assert options.settings_of("all_point") == expected
    # A threshold below what the run would store is kept.
    config = Config().replace(evaluation={"score_threshold": 0.0})
    assert report_options(config).min_score == 0.0


def test_changes_replace_what_the_config_says():
    changes = {"protocols": ("auc",), "min_score": 0.2, "roi": None}
    options = report_options(Config(), **changes, classes=("Sedan",))
    assert (options.protocols, options.min_score) == (("auc",), 0.2)
    assert (options.roi, options.classes) == (None, ("Sedan",))
    assert options.known_classes == Config().classes
    with pytest.raises(UserError, match="'Tram', expected some of the run's: Sed"):
        report_options(Config(), classes=("Tram",))


@pytest.fixture
def evaluated(tmp_path, monkeypatch):
    """Function from options to what is written of a run that is not there."""

    def run(choosing, **options):
        written = {}
        data = SimpleNamespace(**DATA | {"choosing_split": choosing})
        saved = {"run": "run", "variables": None, "step": 3}
        saved["check_input"] = lambda *found: written.update(compared=found)
        loaded = SimpleNamespace(config=Config(), **saved)
        make_evaluation = mock.Mock()
        monkeypatch.setattr(evaluate, "load_model", lambda *_, **__: loaded)

        def data_of_run(saved, other):
            return saved.config.replace(data=other or {}), data

        monkeypatch.setattr(evaluate, "data_of_run", data_of_run)
        monkeypatch.setattr(evaluate, "Evaluation", make_evaluation)
        evaluate.evaluate_run(tmp_path, **options)
        report = make_evaluation.return_value.report.call_args
        return written | make_evaluation.call_args.kwargs | report.kwargs

    return run


ALL = {"split": "all", "step": "best"}


@pytest.mark.parametrize(
    ("choosing", "options", "folder", "remark"),
    [
        ("test", {"step": "best"}, "_checkpoint_best", "chosen on the test split"),
        ("test", {}, "", ""),
        ("validation", ALL, "_all_checkpoint_best", "chosen on the validation split"),
        ("test", {"roi": "wide", "step": 70}, "_checkpoint_70_roi_wide", ""),
        ("test", {"out": "elsewhere", "roi": "wide"}, None, ""),
    ],
)
def test_folder_and_remark_follow_the_options(
    choosing, options, folder, remark, evaluated, tmp_path, caplog
):
    """Numbers on the frames that chose the checkpoint are marked."""
    written = evaluated(choosing, **options)
    expected = options["out"] if folder is None else tmp_path / f"evaluation{folder}"
    assert pathlib.Path(written["out"]) == pathlib.Path(expected)
    name = f"{tmp_path.name} ({remark})" if remark else tmp_path.name
    assert written["run"] == name
    assert written["compared"] == ("mean", options.get("split", "test"))
    assert ("may not be reported" in caplog.text) == bool(remark)


def test_the_report_names_the_label_version_that_was_read(
    evaluated, tmp_path, monkeypatch
):
    assert evaluated("test")["options"].label_version == "v2.1"
    data = {"images": lambda _: None, "split": lambda _: []}
    monkeypatch.setitem(DATA, "images", data["images"])
    monkeypatch.setitem(DATA, "split", data["split"])
    written = evaluated("test", other={"label_version": "v1.0"}, out=tmp_path)
    assert written["options"].label_version == "v1.0"


def test_calibration_of_a_run_is_stored_with_it(tmp_path, monkeypatch):
    box = np.tile([20.0, 0, 0, 4, 2, 1.5, 0], (2, 1))
    truth = {"frame": np.arange(2), "box": box, "cls": np.array(["Sedan", "Bicycle"])}
    given = {}

    def evaluate_run(workdir, **options):
        given.update(options)
        found = {**truth, "score": np.array([0.9, 0.4])}
        data = EvaluationSet(truth, found, classes=given["classes"])
        metrics = {"step": 7, "options": {"iou_thresholds": [0.3, 0.5]}}
        metrics["data"] = "drives"
        return SimpleNamespace(data=data, metrics=metrics, folder=tmp_path / "report")

    monkeypatch.setattr(evaluate, "evaluate_run", evaluate_run)
    found = evaluate.calibrate_run(tmp_path, classes=("Bicycle", "Sedan"))
    assert given["split"] == "validation"
    stored = json.loads((tmp_path / "calibration.json").read_text())
    assert (stored["step"], stored["evaluation"], stored["iou"]) == (7, "report", 0.3)
    assert (stored["data"], stored["split"]) == ("drives", "validation")
    assert {n: tuple(x) for n, x in stored["classes"].items()} == found["classes"]
    with pytest.raises(UserError, match=r"report: predictions to fit is .*rian': 0},"):
        evaluate.calibrate_run(tmp_path, classes=("Sedan", "Pedestrian"), split="all")
    assert given["split"] == "all"
