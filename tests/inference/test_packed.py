"""Packed models are read back as they were, without what may not be passed on."""

import json
import pathlib
import random
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy

from radejax import Detector, UserError, models
from radejax.cli.demo import MODEL
from radejax.core.config import base_config, load_module
from radejax.core.errors import DataError
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference import exported_loader, packed
from radejax.inference.open import load

from .. import small_models as small


def _equal(a: Any, b: Any) -> None:
    assert np.asarray(a.is_valid).any()
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_packed_radar_model_gives_the_same_boxes(tmp_path: pathlib.Path) -> None:
    detector = small.detector(nms_iou=0.2, azimuth_mapping="stretched")
    config = base_config()
    config.seed = 3
    content = packed.write_packed(tmp_path, detector, training_config=config)
    assert content["left_out"] == []
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "config.json",
        "model.safetensors",
    ]
    loaded = Detector.from_checkpoint(tmp_path, batch_sizes=(4,))
    assert loaded.model == detector.model
    assert loaded.classes == detector.classes
    assert (loaded.nms_iou, loaded.score_threshold) == (0.2, 0.1)
    _equal(loaded(small.projections(3)), detector(small.projections(3)))
    assert load(tmp_path).config.to_json() == config.to_json()
    # A neck that this version does not have is not taken for another.
    content["model"]["neck"] = "strips"
    (tmp_path / "config.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"neck is 'strips', expected .*dilated.*plain"):
        load(tmp_path)


def test_a_model_stored_in_half_is_half_and_computes_in_float32(
    tmp_path: pathlib.Path,
) -> None:
    detector = small.detector()
    for half in (False, True):
        packed.write_packed(tmp_path / str(half), detector, half=half)
    sizes = [
        (tmp_path / n / packed.WEIGHTS_FILE).stat().st_size for n in ("False", "True")
    ]
    assert sizes[1] < 0.6 * sizes[0]
    found = packed.read_packed(tmp_path / "True").variables

    def same(ours: Any, theirs: Any) -> None:
        assert ours.dtype == np.float32
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-7)

    jax.tree.map(same, found, dict(detector.variables))


def test_the_demo_comes_with_a_small_model_of_simulated_data() -> None:
    files = list(MODEL.iterdir())
    assert sum(path.stat().st_size for path in files) < 4e6
    loaded = packed.read_packed(MODEL)
    assert "sha256" in json.loads((MODEL / "config.json").read_text())
    card = (MODEL / "README.md").read_text()
    assert "float16" in card
    assert "simulated data alone" in card
    assert "CC BY" not in card
    assert loaded.config.simulation.scenes == "procedural"  # nothing of K-Radar in it
    assert loaded.grid.projection_shape == (64, 56, 25)


@pytest.mark.slow
def test_a_packed_camera_model_is_without_dinov3(tmp_path: pathlib.Path) -> None:
    detector = small.detector("camera")
    content = packed.write_packed(tmp_path, detector)
    assert content["left_out"] == ["params/image_backbone"]
    names = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    assert not any("image_backbone" in name for name in names)
    inputs = small.projections(2), small.images(2), small.calibration()
    loaded = Detector.from_checkpoint(tmp_path, batch_sizes=(4,))
    _equal(loaded(inputs[0]), detector(inputs[0]))
    with pytest.raises(UserError, match="give"):
        loaded(*inputs)
    packed.write_packed(tmp_path, detector, with_backbone=True)
    loaded = Detector.from_checkpoint(tmp_path, batch_sizes=(4,))
    _equal(loaded(*inputs), detector(*inputs))
    assert loaded.camera_options == detector.camera_options
    tuned = Detector(
        detector.model.clone(freeze=False), detector.variables, detector.grid
    )
    with pytest.raises(UserError, match="--with-backbone"):
        packed.write_packed(tmp_path, tuned)


CONFIGS = [
    ("radenet", words) for words in ("base", "paper", "official", "stem", "sedan")
] + [("dinorade", words) for words in ("rc", "rcw", "rcw_resnet50", "official", "r")]


@pytest.mark.parametrize(("name", "words"), CONFIGS)
def test_the_config_of_a_model_makes_the_same_model(name: str, words: str) -> None:
    path = small.CONFIGS / f"{name}.py"
    module = load_module(path)
    model = models.build(module.get_config(words).model)
    again = models.build(packed.model_config(model))
    assert again == model
    assert again.clone(dtype="bfloat16") != model if name == "radenet" else True


def test_damaged_and_absent_folders_are_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        Detector.from_checkpoint(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match="no model in"):
        Detector.from_checkpoint(tmp_path)
    packed.write_packed(tmp_path, small.detector())
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-8])
    with pytest.raises(DataError, match=r"model.safetensors: damaged"):
        Detector.from_checkpoint(tmp_path)
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"format": "other"}))
    with pytest.raises(DataError, match=r"config.json: format is 'other'"):
        Detector.from_checkpoint(tmp_path)


def test_bfloat16_computes_close_to_float32() -> None:
    full, half = small.detector(), small.detector(dtype="bfloat16")
    assert half.model.dtype == "bfloat16"
    assert small.detector("camera", dtype="bfloat16").model.radar.dtype == "bfloat16"
    inputs = small.projections(1)
    a, b = (np.asarray(d(inputs).scores[0, 0]) for d in (full, half))
    assert a != b
    assert a == pytest.approx(b, abs=0.02)
    leaf = jax.tree.leaves(half.variables)[0]
    assert leaf.dtype == np.float32
    with pytest.raises(UserError, match="dtype is 'float16'"):
        small.detector(dtype="float16")


def test_grid_survives_json_exactly(tmp_path: pathlib.Path) -> None:
    packed.write_packed(tmp_path, small.detector())
    assert load(tmp_path).grid == small.small_grid()
    assert RadarGrid.kradar() != small.small_grid()


def test_a_flipped_bit_of_the_weights_is_found(tmp_path: pathlib.Path) -> None:
    programs = {"detector.stablehlo": b"a program"}
    packed.write_packed(tmp_path, small.detector(), programs=programs)
    whole, draw = packed.read_packed(tmp_path), random.Random(0)
    path = tmp_path / "model.safetensors"
    content = path.read_bytes()
    for bit in draw.sample(range(8 * len(content)), 20):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"model\.safetensors: damaged or of"):
            packed.read_packed(tmp_path)
        with pytest.raises(ValueError, match=r"model\.safetensors: damaged"):
            exported_loader.load(tmp_path)
    path.write_bytes(content)
    (tmp_path / "detector.stablehlo").write_bytes(b"e program")
    with pytest.raises(ValueError, match=r"detector\.stablehlo: damaged"):
        exported_loader.load(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    del config["sha256"]  # as of 0.2 and before
    (tmp_path / "config.json").write_text(json.dumps(config))
    jax.tree.map(
        np.testing.assert_array_equal,
        packed.read_packed(tmp_path).variables,
        whole.variables,
    )


def test_whatever_is_wrong_in_the_config_is_named(tmp_path: pathlib.Path) -> None:
    packed.write_packed(tmp_path, small.detector())
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    model, decode = content["model"], content["decode"]
    for change, message in (
        ({"classes": ["Sedan"]}, "1 classes, expected 5, as model.num_classes"),
        ({"decode": {**decode, "nms_iou": 2}}, r"nms_iou 2, .*from 0 to 1"),
        ({"decode": {**decode, "nms": 1}}, r"decode has unknown \['nms'\]"),
        ({"camera": {"projection": "x"}}, "camera.projection is 'x', expected one of"),
        (
            {"model": {**model, "widths": 8}},
            "config.model.widths is 8, expected a list",
        ),
        ({"model": {**model, "num_groups": 0}}, "num_groups is 0, expected 1 to"),
        ({"model": {**model, "decoder_width": 16}}, "do not fit config.model"),
        ({"grid": {}}, "grid lacks range_m"),
        ({"training_config": {"a.b": 1}}, "training_config: .*dots in field names"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(DataError, match=rf"config\.json: .*{message}"):
            packed.read_packed(tmp_path)
