"""Tests of radejax.weights.dinorade_torch, against the authors' code's outputs."""

import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.config import load_config
from radejax.core.errors import DataError, UserError
from radejax.inference.saved import load_torch
from radejax.models import build
from radejax.models.lifting import reference_points
from radejax.models.options import OFFICIAL_DINORADE, ViTOptions
from radejax.models.vit import ViT
from radejax.weights import dinorade_torch, dinov3_hf
from radejax.weights.convert import to_torch_layout, torch_name, variable_shapes

from .. import small_models


@pytest.fixture(scope="module")
def seeded(released, make):
    """Seeded tensors of the whole network by official name."""
    shapes = json.loads(str(released("dinorade/end_to_end")["tensors"]))
    return {n: make.seeded_tensor(n, tuple(s)) for n, s in shapes.items()}


def load(content, **options):
    """Model and variables of a checkpoint of the authors' code."""
    saved = load_torch(content, **options)
    return saved.model, saved.variables


def released_geometry():
    camera = small_models.official_calibration().camera("pinhole")
    axes = OFFICIAL_DINORADE.query_grid
    return reference_points(camera, axes, 256, 112, 10, "official")


def sampled(file, ours):
    """Rows and columns of our `[H, W, C]` map as the fixture has them."""
    return ours[file["rows"][:, None], file["cols"]].transpose(2, 0, 1)


def test_released_model_end_to_end(released, seeded, make):
    file = released("dinorade/end_to_end")
    model, variables = load(seeded)
    radar = make.uniform_input(7, (1, 101, 256, 107), 0.6)
    radar = np.ascontiguousarray(np.moveaxis(radar, 1, -1))
    tokens = make.normal_input(121, (1, 3605, 384))
    tokens = tokens[:, 5:].reshape(1, 45, 80, 384)
    maps = jax.jit(model.apply)(variables, radar, tokens, released_geometry())
    heatmap = np.asarray(jax.nn.sigmoid(maps.heatmap_logits))[0]
    chex.assert_shape(heatmap, (256, 112, 5))
    np.testing.assert_allclose(sampled(file, heatmap), file["heatmap"], atol=5e-5)
    boxes = np.asarray(maps.box_params)[0]
    np.testing.assert_allclose(sampled(file, boxes), file["regression"], atol=3e-4)


def test_loading_fills_the_model_exactly(seeded):
    tensors = {f"module.{k}": v for k, v in seeded.items()}
    nested = {"epoch": 3, "model": tensors}
    model, variables = load(nested, crop_output=True, num_heads=8)
    assert model.options.crop_output
    fusion = model.options.fusion
    assert (fusion.num_heads, fusion.num_points) == (8, 2)
    reference = jax.eval_shape(released_geometry)
    image = jnp.zeros((1, 720, 1280, 3), jnp.uint8)
    inputs = jnp.zeros((1, 256, 107, 101)), image, reference
    expected = jax.eval_shape(model.init, jax.random.key(0), *inputs)
    expected = dict(expected["params"]), expected["batch_stats"]
    del expected[0]["image_backbone"]
    found = variables["params"], variables["batch_stats"]
    chex.assert_trees_all_equal_shapes(found, expected)


@pytest.fixture
def tiny(seeded):
    """The tensors for a tiny transformer, without it."""
    neck = {"image_neck.channel_proj.weight": np.zeros((128, 96), np.float32)}
    return seeded | neck


def test_image_backbone_with_adapters(tiny, make):
    prefix = "image_backbone.base_model.model."
    tensors = tiny | {prefix + k: v for k, v in make.tiny_tensors().items()}
    query = f"{prefix}layer.0.attention.q_proj"
    down = make.seeded_tensor("lora_a", (2, 96))
    up = make.seeded_tensor("lora_b", (96, 2))
    plain = tensors.pop(f"{query}.weight")
    tensors[f"{query}.base_layer.weight"] = plain
    tensors[f"{query}.base_layer.bias"] = tensors.pop(f"{query}.bias")
    tensors[f"{query}.lora_A.default.weight"] = down
    tensors[f"{query}.lora_B.default.weight"] = up
    model, variables = load(tensors)
    vit = model.options.image
    sizes = vit.hidden_size, vit.num_layers, vit.num_heads, vit.mlp_dim
    assert sizes == (96, 3, 1, 192)
    backbone = variables["params"]["image_backbone"]
    kernel = backbone["layers"]["query"]["kernel"][0]
    np.testing.assert_allclose(kernel, (plain + up @ down).T, atol=1e-6)
    registers = tensors[f"{prefix}embeddings.register_tokens"]
    np.testing.assert_array_equal(backbone["prefix_tokens"][:, 1:], registers)
    del tensors[f"{query}.lora_B.default.weight"]
    with pytest.raises(DataError, match=r"q_proj: expected an adapter of two halves"):
        load(tensors)


def test_a_folder_in_place_of_the_backbone(tiny, make, tmp_path):
    folder = make.write_tiny_folder(tmp_path)
    loaded = load_torch({"epoch": 1, "model": tiny}, image_backbone=folder)
    assert loaded.config.data.camera.projection == "pinhole"
    vit, expected = dinov3_hf.load(folder)
    fields = dinov3_hf.image_fields(loaded.model.options.image)
    assert fields == dinov3_hf.image_fields(vit.options)
    found = loaded.variables["params"]["image_backbone"]
    chex.assert_trees_all_equal(found, expected["params"])


def test_other_content_is_rejected(tiny, monkeypatch):
    vit = ViT(ViTOptions(patch_size=14, position_grid=37))
    monkeypatch.setattr(dinov3_hf, "load", lambda path: (vit, {"params": {}}))
    for content, options, message in (
        (tiny, {"image_backbone": "x"}, "x is 'DINOv2', expected DINOv3 as in"),
        (tiny, {"depth": 3}, r"config\.model\.depth is not a field"),
        ({"start_conv.weight": np.zeros(3)}, {}, r"tensors backbone\.\* or"),
    ):
        with pytest.raises((UserError, DataError), match=message):
            load(content, **options)


def test_resnet_in_place_of_the_transformer(seeded, make):
    """Its names are those of torchvision's in the released Sequential."""
    tensors = {n: v for n, v in seeded.items() if not n.startswith("image_neck.")}
    config = load_config("dinorade:official,rcw_resnet50").model
    model = build(config)
    shapes = variable_shapes(model)
    names = dinorade_torch.rules("expanded", is_resnet=True)
    expected = {}
    for path, shape in shapes.items():
        if path.split("/")[1] in ("image_backbone", "image_neck"):
            name = torch_name(names, path)
            shape = to_torch_layout(path, np.broadcast_to(0, shape)).shape
            expected[name] = make.seeded_tensor(name, shape)
    assert expected["image_backbone.frozen_layers.0.weight"].shape == (64, 3, 7, 7)
    assert expected["image_backbone.projection.weight"].shape == (128, 2048, 1, 1)
    loaded, variables = load(tensors | expected)
    image = loaded.options.image
    assert (image.kind, image.standardize) == ("resnet50", False)
    kernel = variables["params"]["image_neck"]["block_2"]["conv_2"]["kernel"]
    theirs = expected["image_backbone.layer4.1.conv2.weight"]
    np.testing.assert_array_equal(kernel[0, 2, 5, 7], theirs[7, 5, 0, 2])
