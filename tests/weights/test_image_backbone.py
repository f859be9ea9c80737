"""What radar-camera runs take from files, in place of real weights."""

import jax
import numpy as np
import pytest

from radejax.config import load_config
from radejax.core.errors import UserError
from radejax.models import build
from radejax.models.vit import ViT
from radejax.weights import dinov3_hf, image_backbone

TRUNK = {"stem": np.arange(3.0)}
STAGE = {"block": np.arange(2.0)}


@pytest.fixture
def resnet(monkeypatch):
    part = {"params": {"image_backbone": TRUNK, "image_neck": STAGE}}
    part["batch_stats"] = {"image_neck": STAGE}
    monkeypatch.setattr(image_backbone, "load_resnet", lambda path, model: part)
    return build(load_config("dinorade:rcw_resnet50").model)


def test_embeddings_leave_the_last_stage_to_load(resnet):
    whole = image_backbone.load_image_backbone("resnet50.pth", resnet)
    assert set(whole["params"]) == {"image_backbone", "image_neck"}
    sha256 = image_backbone.weights_sha256(TRUNK)
    part = image_backbone.load_image_backbone("resnet50.pth", resnet, sha256)
    assert set(part["params"]) == {"image_neck"}
    assert part["batch_stats"] == whole["batch_stats"]
    with pytest.raises(UserError, match="--image-backbone FOLDER"):
        image_backbone.load_image_backbone(None, resnet, sha256)

    other = image_backbone.weights_sha256({"stem": np.arange(3.0) + 1})
    with pytest.raises(UserError, match=r"resnet50\.pth is not the image backbone"):
        image_backbone.load_image_backbone("resnet50.pth", resnet, other)
    transformer = build(load_config("dinorade").model)
    assert image_backbone.load_image_backbone(None, transformer, sha256) is None


def test_weights_of_another_transformer_are_rejected(monkeypatch):
    model = build(load_config("dinorade").model)
    found = ViT(model.options.image.replace(num_registers=3))
    monkeypatch.setattr(dinov3_hf, "load", lambda path: (found, {"params": TRUNK}))
    with pytest.raises(UserError, match="num_registers is 3 there and 4 here"):
        image_backbone.load_image_backbone("folder", model)
    same = ViT(model.options.image.replace(attention="xla", layer_scale=0.5))
    monkeypatch.setattr(dinov3_hf, "load", lambda path: (same, {"params": TRUNK}))
    loaded = image_backbone.load_image_backbone("folder", model)
    assert loaded == {"params": {"image_backbone": TRUNK}}


def test_dinov2_small_has_the_sizes_of_its_config():
    model = build(load_config("dinorade:rcw_dinov2").model)
    # facebook/dinov2-small: 14 x 14 pixels per patch, pretrained at 518 x 518 pixels.
    assert model.options.image.feature_shape == (51, 91, 384)
    vit, image = ViT(model.options.image), np.zeros((1, 28, 28, 3), np.float32)
    shapes = jax.eval_shape(vit.init, jax.random.key(0), image)
    count = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    # 22,056,576 parameters, of which a mask token and the biases of the keys are not needed.
    assert count == 22_056_576 - (1 + 12) * 384
