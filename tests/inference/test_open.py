"""Every kind of model is opened the same way, and weights must fit where they start."""

import json
import pathlib

import grain
import jax
import numpy as np
import pytest
from ml_collections import ConfigDict

from radejax import Detector, UserError, models
from radejax.core.config import base_config
from radejax.inference import open as opening
from radejax.inference import packed
from radejax.runs import workdir
from radejax.training.checkpoints import Checkpoints
from radejax.weights import radenet_torch
from radejax.weights.image_backbone import weights_sha256

from .. import small_models as small


def test_a_torch_file_is_opened_like_a_folder(tmp_path: pathlib.Path) -> None:
    fields = packed.model_config(small.detector().model)
    fields |= {"doppler_bins": 64, "elevation_bins": 37, "num_groups": 32}
    model = models.build(fields | {"widths": (32, 32), "decoder_width": 64})
    shapes = jax.eval_shape(
        model.init, jax.random.key(0), np.zeros((1, 16, 16, 101), np.float32)
    )
    variables = jax.tree.map(lambda x: np.ones(x.shape, x.dtype), shapes)
    path = tmp_path / "best.npz"
    radenet_torch.save(model, variables, path)
    loaded = opening.load(path)
    assert loaded.settings["azimuth_mapping"] == "stretched"
    assert (loaded.config, loaded.step, loaded.run) == (None, None, {})
    with pytest.raises(UserError, match=r"step 3 of .*, which holds one model"):
        opening.load(path, step=3)
    with pytest.raises(UserError, match="the model is RADE-Net"):
        opening.load(path, image_backbone=tmp_path)


def test_a_run_that_has_not_trained_says_so(tmp_path: pathlib.Path) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"no model in .*: expected config\.json"
    ):
        opening.load(tmp_path)
    (tmp_path / "config.json").write_text(base_config().to_json())
    with pytest.raises(FileNotFoundError, match=r"the run has not trained yet"):
        Detector.from_workdir(tmp_path)


def test_weights_of_another_run_need_the_same_model(tmp_path: pathlib.Path) -> None:
    detector = small.detector()
    packed.write_packed(tmp_path, detector, training_config=ConfigDict({"seed": 3}))
    weights = opening.starting_weights(detector.model, init_from=tmp_path)
    variables = weights.variables
    assert weights.source == str(tmp_path)
    assert weights.pretrained is None
    for name, value in detector.variables["params"]["backbone"].items():
        assert set(variables["params"]["backbone"][name]) == set(value)
    config = packed.model_config(detector.model)
    other = models.build(config | {"heatmap_prior": 0.25})
    with pytest.raises(
        UserError, match=r"do not fit: config\.model\.heatmap_prior is .* 0\.25 here"
    ):
        opening.starting_weights(other, init_from=tmp_path)


def test_classes_reordered_in_a_work_folder_change_nothing_or_are_refused(
    tmp_path: pathlib.Path,
) -> None:
    """A checkpoint has its own config; a training compares its config with the folder's."""
    config, grid = small.radar_config(), small.small_grid()
    info = workdir.checkpoint_info(config, grid, {}, {})
    state = {"params": small.detector().variables["params"]}
    positions = iter(grain.MapDataset.range(9).to_iter_dataset())
    with (
        workdir.claimed(tmp_path, config),
        Checkpoints(tmp_path / "checkpoints") as saved,
    ):
        saved.save(1, state, positions, info=info)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    content["classes"].reverse()
    path.write_text(json.dumps(content))
    assert opening.load(tmp_path).settings["classes"] == tuple(config.classes)
    with (
        pytest.raises(UserError, match="a run with another config: config"),
        workdir.claimed(tmp_path, config),
    ):
        pass


def test_without_anything_to_start_from_all_is_drawn() -> None:
    model = small.detector().model
    assert opening.starting_weights(model) == opening.StartingWeights()
    with pytest.raises(UserError, match="which has no camera"):
        opening.starting_weights(model, image_backbone_path="dinov3")


def test_settings_are_those_of_the_config() -> None:
    config = base_config()
    config.decode.update(score_threshold=0.2, nms_iou=0.1, per_class_nms=True)
    for given in (config, json.loads(config.to_json())):
        settings = opening.settings_of_config(given)
        assert settings["classes"] == tuple(config.classes)
        assert np.isclose(settings["score_threshold"], 0.2)
        assert settings["decode_options"]["per_class_nms"] is True
        assert "nms_iou" not in settings["decode_options"]


def test_a_frozen_backbone_is_known_by_its_weights(tmp_path: pathlib.Path) -> None:
    detector = small.detector("camera")
    weights = detector.variables["params"]["image_backbone"]
    packed.write_packed(tmp_path / "all", detector, with_backbone=True)
    found = opening.starting_weights(detector.model, tmp_path / "all")
    assert found.pretrained is None
    assert found.frozen_sha256 == weights_sha256(weights)
    # Embeddings of the same backbone stand for it.
    content = {"weights_sha256": found.frozen_sha256}
    (tmp_path / "manifest.json").write_text(json.dumps(content))
    embedded = opening.starting_weights(detector.model, embeddings=tmp_path)
    assert embedded.frozen_sha256 == found.frozen_sha256
    assert embedded.variables is embedded.pretrained is None
    trained = opening.starting_weights(detector.model.clone(freeze=False))
    assert trained.frozen_sha256 is None
