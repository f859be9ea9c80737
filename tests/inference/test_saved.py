"""Every kind of model is loaded the same way, and exported folders hold all of it."""

import dataclasses
import json
import random

import grain
import jax
import numpy as np
import pytest
import safetensors.numpy
from flax.traverse_util import flatten_dict

from radejax import Detector, UserError, models
from radejax.config import Config
from radejax.core.errors import DataError
from radejax.inference import exported_loader
from radejax.inference import saved as saved_models
from radejax.inference.export import export
from radejax.inference.saved import (
    WEIGHTS_FILE,
    load_model,
    matching_weights,
    save_model,
    starting_weights,
)
from radejax.runs import experiment
from radejax.training.checkpoints import Checkpoints
from radejax.weights import image_backbone, radenet_torch

from .. import small_models as small


def _equal(a, b):
    assert np.asarray(a.is_valid).any()
    jax.tree.map(np.testing.assert_array_equal, a, b)


# Runs and official files -------------------------------------------------------------


def _write_torch(path):
    bins = {"doppler_bins": 64, "elevation_bins": 37}
    sizes = {"num_groups": 32, "widths": (32, 32), "decoder_width": 64}
    options = small.radar_config().model.replace(**bins, **sizes)
    model = models.build(options)
    inputs = np.zeros((1, 16, 16, 101), np.float32)
    shapes = jax.eval_shape(model.init, jax.random.key(0), inputs)
    variables = jax.tree.map(lambda x: np.ones(x.shape, x.dtype), shapes)
    safetensors.numpy.save_file(radenet_torch.save(model, variables), path)
    return options


def test_a_torch_file_is_loaded_like_a_folder(tmp_path):
    path = tmp_path / "best.safetensors"
    options = _write_torch(path)
    loaded = load_model(path)
    assert loaded.config.data.azimuth_mapping == "stretched"
    assert (loaded.step, loaded.run) == (None, {})
    assert loaded.grid.projection_shape == (256, 107, 101)
    assert len(loaded.config.classes) == options.num_classes
    weights, _ = starting_weights(models.build(options), path)
    jax.tree.map(np.testing.assert_array_equal, weights, loaded.variables)


# Weights to start from ---------------------------------------------------------------


def test_weights_of_another_run_need_the_same_model(tmp_path):
    model = small.saved()
    save_model(model, tmp_path)
    variables, _ = starting_weights(model.model, init_from=tmp_path)
    jax.tree.map(np.testing.assert_array_equal, variables, dict(model.variables))
    assert starting_weights(model.model) == ({}, None)


def test_matching_weights_are_those_of_equal_name_and_shape(
    tmp_path, caplog, monkeypatch
):
    saved = small.saved()
    save_model(saved, tmp_path)
    options = saved.config.model.replace(num_classes=7, outputs={"velocity": 2})
    with caplog.at_level("INFO", logger="radejax"):
        part = matching_weights(tmp_path, models.build(options))
    flat, own = (flatten_dict(x, sep="/") for x in (part, dict(saved.variables)))
    other = {f"params/heads/heatmap/out/{name}" for name in ("kernel", "bias")}
    assert own.keys() - flat.keys() == other
    for name, values in flat.items():
        np.testing.assert_array_equal(values, own[name])
    assert f"{len(flat)} of {len(own)} arrays are used" in caplog.text
    assert "2 arrays are of another shape, which are initialized: par" in caplog.text
    assert "params/heads/velocity/out" in caplog.text
    assert "another radar" not in caplog.text
    stranger = dataclasses.replace(saved, variables={"params": {"other": np.zeros(1)}})
    monkeypatch.setattr(saved_models, "load_model", lambda path: stranger)
    with pytest.raises(UserError, match=r"--init-partial is .* a model with some"):
        matching_weights(tmp_path, saved.model)


# Exported folders --------------------------------------------------------------------


def test_an_exported_radar_model_gives_the_same_boxes(tmp_path):
    model = small.saved(data__azimuth_mapping="stretched", seed=3)
    detector = Detector(model, nms_iou=0.2, score_threshold=0.1, batch_sizes=(4,))
    saved = dataclasses.replace(detector.saved, usual_input=(0.5, 0.125))
    content = save_model(saved, tmp_path)
    assert content["left_out"] == []
    assert load_model(tmp_path).usual_input == [0.5, 0.125]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["config.json", "model.safetensors"]
    loaded = Detector.from_workdir(tmp_path, batch_sizes=(4,))
    assert loaded.model == detector.model
    assert loaded.classes == detector.classes
    assert loaded.grid == small.small_grid()  # exact in JSON
    assert loaded.decode_options == detector.decode_options
    assert loaded.decode_options.nms_iou == 0.2
    _equal(loaded(small.projections(3)), detector(small.projections(3)))
    assert load_model(tmp_path).config == detector.saved.config


def test_weights_that_are_not_finite_are_an_error(tmp_path):
    model = small.saved()
    params = jax.tree.map(np.array, model.variables["params"])
    jax.tree.leaves(params)[3][...] = np.nan
    save_model(dataclasses.replace(model, variables={"params": params}), tmp_path)
    with pytest.raises(DataError, match=r"params/.* has values that are not finite"):
        load_model(tmp_path)


def test_a_model_stored_in_half_is_half_and_computes_in_float32(tmp_path):
    for half in (False, True):
        save_model(small.saved(), tmp_path / str(half), half=half)
    sizes = [(tmp_path / n / WEIGHTS_FILE).stat().st_size for n in ("False", "True")]
    assert sizes[1] < 0.6 * sizes[0]

    def same(ours, theirs):
        assert ours.dtype == np.float32
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-7)

    found = load_model(tmp_path / "True").variables
    jax.tree.map(same, found, dict(small.saved().variables))


@pytest.mark.slow
def test_an_exported_camera_model_is_without_dinov3(tmp_path):
    detector = small.detector("camera")
    content = save_model(detector.saved, tmp_path)
    assert content["left_out"] == ["params/image_backbone"]
    names = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    assert not any("image_backbone" in name for name in names)
    inputs = small.projections(2), small.images(2), small.calibration()
    loaded = Detector.from_workdir(tmp_path, batch_sizes=(4,))
    _equal(loaded(inputs[0]), detector(inputs[0]))
    with pytest.raises(UserError, match="give"):
        loaded(*inputs)
    save_model(detector.saved, tmp_path, with_backbone=True)
    loaded = Detector.from_workdir(tmp_path, batch_sizes=(4,))
    _equal(loaded(*inputs), detector(*inputs))
    assert loaded.camera_options == detector.camera_options
    with pytest.raises(UserError, match="--with-backbone"):
        save_model(small.saved("camera", model__image__freeze=False), tmp_path)


def test_another_backbone_than_that_of_the_training_is_rejected(tmp_path, monkeypatch):
    saved = small.saved("camera")
    params = dict(saved.variables["params"])
    own = params.pop("image_backbone")
    statistics = {"batch_stats": saved.variables["batch_stats"]}
    found = {"own": own, "other": jax.tree.map(lambda x: x + 1, own)}
    load = lambda path, model: {"params": {"image_backbone": found[path]}}  # noqa: E731
    monkeypatch.setattr(image_backbone, "load_image_backbone", load)
    same = {saved_models.FROZEN_BACKBONE: image_backbone.weights_sha256(own)[:16]}
    info = experiment.checkpoint_info(saved.config, saved.grid, {}, same)
    positions = iter(grain.MapDataset.range(9).to_iter_dataset())
    run, exported, tuned = (tmp_path / name for name in ("run", "exported", "tuned"))
    state = {"params": params, "model_state": statistics}
    with Checkpoints(run / "checkpoints") as checkpoints:
        checkpoints.save(1, state, positions, info=info)
    save_model(load_model(run), exported)
    for folder in (run, exported):
        params = load_model(folder, image_backbone="own").variables["params"]
        assert params["image_backbone"] is own
        with pytest.raises(UserError, match="other is not the image backbone that was"):
            load_model(folder, image_backbone="other")
    config = saved.config.replace(model={"image": {"freeze": False}})
    save_model(dataclasses.replace(saved, config=config), tuned, with_backbone=True)
    with pytest.raises(UserError, match="own, but the model has a fine-tuned image"):
        load_model(tuned, image_backbone="own")


def test_a_flipped_bit_of_the_weights_is_found(tmp_path):
    programs = {"detector.stablehlo": b"a program"}
    save_model(small.saved(), tmp_path, programs=programs)
    path, draw = tmp_path / "model.safetensors", random.Random(0)
    content = path.read_bytes()
    for bit in draw.sample(range(8 * len(content)), 20):
        corrupted = bytearray(content)
        corrupted[bit // 8] ^= 1 << bit % 8
        path.write_bytes(corrupted)
        with pytest.raises(DataError, match=r"model\.safetensors is corrupted or of"):
            load_model(tmp_path)
        with pytest.raises(ValueError, match=r"model\.safetensors: corrupted"):
            exported_loader.load(tmp_path)
    path.write_bytes(content)
    # The folder was copied in part.
    for name in ("config.json", "model.safetensors", "detector.stablehlo"):
        moved = (tmp_path / name).rename(tmp_path / "moved")
        with pytest.raises(FileNotFoundError, match=name):
            exported_loader.load(tmp_path)
        moved.rename(tmp_path / name)


def test_folders_and_files_that_do_not_fit_are_named(tmp_path):
    model, torch_file = small.saved().model, tmp_path / "best.safetensors"
    _write_torch(torch_file)
    backbone = {"image_backbone_path": "dinov3"}
    untrained, other = tmp_path / "run", tmp_path / "other"
    for folder in (untrained, other):
        folder.mkdir()
    (untrained / "config.json").write_text(Config().model_dump_json())
    save_model(small.saved(model__heatmap_prior=0.25), other)
    for call, message in (
        (lambda: Detector.from_workdir(tmp_path / "gone"), "no such file or folder"),
        (lambda: load_model(tmp_path), r"no model in .*: expected config\.json"),
        (lambda: Detector.from_workdir(untrained), "a run that has trained"),
        (lambda: load_model(torch_file, step=3), "holds one model only, but step=3"),
        (lambda: load_model(torch_file, image_backbone="x"), "the model is RADE-Net"),
        (lambda: starting_weights(model, other), r"do not fit: .*\.heatmap_prior is"),
        (lambda: starting_weights(model, **backbone), "RadeNet has no camera"),
    ):
        with pytest.raises((UserError, FileNotFoundError), match=message):
            call()


def test_whatever_is_wrong_in_the_config_is_named(tmp_path):
    save_model(small.saved(), tmp_path)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    config = content["config"]
    for change, message in (
        ({"format": "other"}, "format is 'other', .*: export the run again with"),
        ({"config": {**config, "classes": ["Sedan"]}}, "num_classes is 5, expected 1"),
        ({"config": {**config, "model": {**config["model"], "neck": "x"}}}, "neck is"),
        ({"grid": {}}, "range_m"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(DataError, match=message):
            load_model(tmp_path)
    wider = dataclasses.replace(small.saved(), variables={"params": {}})
    save_model(wider, tmp_path)
    with pytest.raises(DataError, match=r"do not fit config\.model"):
        load_model(tmp_path)


# Score thresholds and calibration of a run -------------------------------------------


def _evaluation(workdir, name, step, chosen_on, thresholds):
    row = {"cls": "Sedan", "threshold": 0.9, "rule": "wanted_precision"}
    chosen = [row | {"count": 2, "num_gt": 88}] if thresholds else []
    for cls, threshold in thresholds.items():
        row = {"cls": cls, "threshold": threshold, "rule": "best_f1"}
        chosen.append(row | {"count": 70, "num_gt": 88})
    found = {"step": step, "thresholds": {"chosen_on": chosen_on, "chosen": chosen}}
    found["options"] = {"wanted_precision": 0.8}
    (workdir / name).mkdir()
    (workdir / name / "metrics.json").write_text(json.dumps(found))


def test_the_thresholds_of_the_validation_split_are_exported(tmp_path, caplog):
    run = tmp_path / "run"
    run.mkdir()
    model = dataclasses.replace(small.detector().saved, step=7, identity={"run": "a"})
    _evaluation(run, "evaluation_a", 3, "the validation split", {"Sedan": 0.7})
    _evaluation(run, "evaluation", 7, None, {})
    with pytest.raises(UserError, match="no evaluation of step 7 chose"):
        saved_models.with_chosen_thresholds(model, run, "best_f1")
    itself = "the evaluated frames themselves"
    _evaluation(run, "evaluation_b", 7, itself, {"Sedan": 0.6})
    chosen = {"Pedestrian": 0.2, "Sedan": 0.4}
    _evaluation(run, "evaluation_c", 7, "the validation split", chosen)
    found = saved_models.with_chosen_thresholds(model, run, "best_f1")
    # The other classes keep the threshold of the config.
    assert found.config.decode.score_threshold == (0.4, 0.1, 0.2, 0.1, 0.1)
    export(Detector(found), tmp_path / "out", kind="huggingface")
    again = load_model(tmp_path / "out")
    assert again.config.decode.score_threshold == (0.4, 0.1, 0.2, 0.1, 0.1)
    assert again.identity["thresholds"]["evaluation"] == "evaluation_c"
    found = saved_models.with_chosen_thresholds(model, run, "wanted_precision")
    assert found.config.decode.score_threshold == (0.9, 0.1, 0.1, 0.1, 0.1)
    assert found.identity["thresholds"]["rule"] == "wanted_precision of 0.8"
    assert found.identity["thresholds"]["matches"] == {"Sedan": "2 of 88"}


def test_classes_reordered_in_a_workdir_change_nothing_or_are_rejected(tmp_path):
    """A checkpoint has its own config; a training compares its config with the folder's."""
    config, grid = small.radar_config(), small.small_grid()
    run = {"input": [0.5, 0.125]}
    info = experiment.checkpoint_info(config, grid, run, {})
    state = {"params": small.detector().variables["params"]}
    positions = iter(grain.MapDataset.range(9).to_iter_dataset())
    with (
        experiment.claimed(tmp_path, config),
        Checkpoints(tmp_path / "checkpoints") as checkpoints,
    ):
        checkpoints.save(1, state, positions, info=info)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    content["classes"].reverse()
    path.write_text(json.dumps(content))
    assert load_model(tmp_path).config == config
    assert load_model(tmp_path).usual_input == [0.5, 0.125]
    with (
        pytest.raises(UserError, match="a run with another config: config"),
        experiment.claimed(tmp_path, config),
    ):
        pass
