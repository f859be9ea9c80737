"""What is done to the frames of a run before it is evaluated."""

import dataclasses
import pathlib
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.core.structures import DetectionMaps
from radejax.data.kradar.frame import Frame
from radejax.detection.decode import decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import evaluate
from radejax.runs.evaluate import _changed, report_options, with_images_exchanged


def _frames(paths: list[str | None]) -> list[Frame]:
    blank = {field.name: None for field in dataclasses.fields(Frame)}
    return [
        Frame(
            **blank | {"name": str(i), "camera_path": p, "camera_calibration_path": p}
        )
        for i, p in enumerate(paths)
    ]


def test_every_frame_sees_another_ones_image() -> None:
    paths = ["a", "b", None, "c", "d", "e"]
    exchanged = with_images_exchanged(_frames(paths), seed=3)
    found = [frame.camera_path for frame in exchanged]
    assert [frame.name for frame in exchanged] == list("012345")
    assert sorted(filter(None, found)) == ["a", "b", "c", "d", "e"]
    assert found[2] is None
    assert all(a != b for a, b in zip(found, paths, strict=True) if b is not None)
    assert found == [frame.camera_calibration_path for frame in exchanged]

    def again(seed: int) -> list[str | None]:
        frames = with_images_exchanged(_frames(paths), seed)
        return [frame.camera_path for frame in frames]

    assert found == again(3)
    assert any(found != again(seed) for seed in range(4, 8))


def test_images_of_fewer_than_two_frames_cannot_be_exchanged() -> None:
    with pytest.raises(UserError, match="1 frames have an image: none to exchange"):
        with_images_exchanged(_frames(["a", None]), seed=0)


def test_a_cut_when_scoring_is_a_cut_when_decoding() -> None:
    """What lies below the cut takes no part in NMS and costs no row of those above."""
    rng = np.random.default_rng(0)
    grid = RadarGrid.reduced(
        num_doppler=4, num_range=24, num_elevation=4, num_azimuth=16
    )
    params = rng.normal((0, 0, 0, 5, 3, 2, 0, 1), 1, (2, 24, 16, 8))
    maps = DetectionMaps(
        jnp.asarray(rng.normal(-5, 2, (2, 24, 16, 5)), jnp.float32),
        jnp.asarray(params, jnp.float32),
    )

    def columns(score: float) -> dict[str, np.ndarray]:
        return decode(maps, grid, max_detections=60, score_threshold=score).to_columns()

    low, high = columns(0.05), columns(0.3)
    assert len(low["score"]) > len(high["score"]) > 10
    above = low["score"] > 0.3
    for name, column in high.items():
        np.testing.assert_array_equal(low[name][above], column)


def _config(**evaluation: object) -> ConfigDict:
    config = base_config()
    config.evaluation.update(evaluation)
    return config


def test_reports_of_runs_cut_all_but_exact() -> None:
    options = report_options(_config(empty_frames="class"), "run")
    assert options.cut("kradar_r40") == 0.3
    assert options.cut("all_point") == options.min_score == 0.05
    assert options.frame_rule("coco101") == "class"
    assert options.frame_rule("all_point") == "protocol"
    # A cut below what the run would keep is kept.
    assert report_options(_config(score_threshold=0.0), "run").cut("all_point") == 0.0


def test_every_option_is_given_when_evaluating() -> None:
    old = _config()
    del old.evaluation.min_score  # a run of before
    config, options = _changed(old, {})
    assert (config.evaluation.min_score, options) == (0.05, {})
    changes = {"protocols": ("auc",), "min_score": 0.2, "roi": None, "run": "mine"}
    config, options = _changed(old, changes | {"classes": ("Sedan",)})
    assert options == {"run": "mine", "classes": ("Sedan",)}
    made = report_options(config, "run")
    assert (made.protocols, made.min_score, made.roi) == (("auc",), 0.2, None)
    assert old.evaluation.protocols == base_config().evaluation.protocols
    _, options = _changed(old, {"score_threshold": 0.5})
    assert options == {"uncut": ()}
    for changes, message in (
        ({"protocols": ("nope",)}, r"config.evaluation.protocols is \('nope',\)"),
        ({"batch_size": 0}, "config.evaluation.batch_size is 0, expected an integer"),
        ({"classes": ("Tram",)}, "classes has 'Tram', expected some of the run's: Sed"),
    ):
        with pytest.raises(UserError, match=message):
            _changed(old, changes)


@dataclasses.dataclass(frozen=True)
class _Loaded:
    config: ConfigDict
    model: None = None
    variables: None = None
    step: int = 3


@pytest.mark.parametrize(
    ("choosing", "split", "step", "folder", "remark"),
    [
        ("test", "test", "best", "evaluation", "chosen on the test split"),
        ("test", "test", None, "evaluation", ""),
        ("validation", "test", "best", "evaluation", ""),
        ("validation", "validation", None, "evaluation_validation", ""),
        ("validation", "all", "best", "evaluation", "chosen on the validation split"),
    ],
)
def test_numbers_on_what_chose_the_checkpoint_are_marked(
    choosing: str,
    split: str,
    step: str | None,
    folder: str,
    remark: str,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    written: dict[str, Any] = {}
    data = SimpleNamespace(choosing_split=choosing)
    loaded = _Loaded(_config())
    monkeypatch.setattr(evaluate, "load", lambda *_, **__: loaded)
    monkeypatch.setattr(evaluate, "data_of_run", lambda *_: (None, data))
    monkeypatch.setattr(evaluate, "evaluate", lambda *_, **named: written.update(named))
    evaluate.evaluate_run(tmp_path, step=step, split=split)
    assert written["out"] == tmp_path / folder
    assert written["remark"] == (f" ({remark})" if remark else "")
    assert ("may not be reported" in caplog.text) == bool(remark)
