"""Tests of radejax.weights.dinorade_torch, against the released code's outputs."""

import functools
import json
import pathlib

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.config import load_module
from radejax.core.errors import DataError, UserError
from radejax.geometry.camera import CameraCalibration
from radejax.models.camera_neck import CameraNeck
from radejax.models.fusion import Fusion
from radejax.models.lifting import (
    OFFICIAL_OFFSET_M,
    LiftingAxes,
    WeightingNetwork,
    static_reference_points,
)
from radejax.weights import dinorade_torch
from radejax.weights.state_dict import StateDictReader


def golden_recipes():
    return load_module(
        pathlib.Path(__file__).parents[1] / "golden" / "dinorade_make.py"
    )


RECIPES = golden_recipes()


def listing(shared, name):
    text = (shared / "fixtures" / "dinorade" / f"{name}_params.json").read_text()
    return json.loads(text)["tensors"]


@functools.cache
def end_to_end_tensors(shared):
    return RECIPES.seeded_state_dict(listing(shared, "end_to_end"))


def part(shared, name, prefix):
    tensors = RECIPES.seeded_state_dict(listing(shared, name))
    return {prefix + key: value for key, value in tensors.items()}


def released_geometry(shared):
    calibration = CameraCalibration.from_kradar(
        shared / "data/kradar/calib/common/cam_front0.yml",
        radar_from_lidar_m=OFFICIAL_OFFSET_M,
    )
    return static_reference_points(
        calibration,
        LiftingAxes.official(),
        256,
        112,
        image="pinhole",
        out_of_view="official",
    )


def channels_last(x):
    return np.ascontiguousarray(np.moveaxis(x, 1, -1))


def sampled(file, ours, rows="rows", cols="cols"):
    """Rows and columns of our `[H, W, C]` map as the fixture has them."""
    return ours[file[rows][:, None], file[cols]].transpose(2, 0, 1)


def patch_tokens():
    tokens = RECIPES.normal_input(121, (1, 3605, 384))
    return tokens[:, 5:].reshape(1, 45, 80, 384)


def radar_cube():
    return channels_last(RECIPES.uniform_input(7, (1, 101, 256, 107), 0.6))


def test_released_camera_neck(shared):
    file = np.load(shared / "fixtures" / "dinorade" / "camneck.npz")
    tensors = part(shared, "camneck", "image_neck.")
    reader = StateDictReader(tensors, "camneck")
    _, params, stats = dinorade_torch.read_image(reader, tensors)
    reader.finish()
    variables = {"params": params["image_neck"], "batch_stats": stats}
    out = jax.jit(CameraNeck().apply)(variables, patch_tokens(), jnp.ones(1, bool))
    chex.assert_shape(out, (1, 180, 320, 128))
    out = np.asarray(out[0])
    np.testing.assert_allclose(sampled(file, out), file["output"], atol=2e-5)
    stats = file["output_channel_stats"]
    np.testing.assert_allclose(out.mean((0, 1)), stats[:, 0], atol=2e-5)
    np.testing.assert_allclose(out.max((0, 1)), stats[:, 3], atol=2e-5)


@pytest.mark.slow
def test_released_fusion(shared):
    file = np.load(shared / "fixtures" / "dinorade" / "fusion.npz")
    tensors = part(shared, "fusion", "fusion.")
    reader = StateDictReader(tensors, "fusion")
    fields = dinorade_torch.fusion_fields(tensors, {})
    assert fields["weighting"] == "cnn"
    assert not fields["necks"]
    params = dinorade_torch.read_fusion(reader, fields)
    reader.finish(ignored=(r"fusion\.output_proj",))
    variables = {"params": params}
    radar = channels_last(RECIPES.normal_input(122, (1, 128, 256, 112)))
    camera = channels_last(RECIPES.normal_input(123, (1, 128, 180, 320)))
    elevation = np.pad(radar_cube()[..., 64:], ((0, 0), (0, 0), (0, 5), (0, 0)))
    reference = released_geometry(shared)

    @jax.jit
    def run(variables, *inputs):
        return Fusion(**fields).apply(variables, *inputs, mutable="intermediates")

    out, state = run(variables, radar, elevation, camera, reference)
    out, gate = np.asarray(out[0]), state["intermediates"]["camera_share"][0][0]
    np.testing.assert_allclose(sampled(file, out), file["output"], atol=2e-4)
    np.testing.assert_allclose(gate, file["gate"], atol=1e-4)
    means = file["output_channel_stats"][:, 0]
    np.testing.assert_allclose(out.mean((0, 1)), means, atol=2e-5)
    # The mean over elevation, from the sum it is part of.
    share = np.asarray(gate)[..., None]
    reduced = (out - (1 - share) * radar[0]) / share
    rows, cols = file["reduced_rows"], file["cols"]
    is_clear = share[rows[:, None], cols][..., 0] > 0.2
    actual = reduced[rows[:, None], cols][is_clear]
    expected = file["reduced"].transpose(1, 2, 0)[is_clear]
    np.testing.assert_allclose(actual, expected, atol=1e-3)
    weights = jax.jit(WeightingNetwork(10, "cnn").apply)(
        {"params": params["weighting"]}, elevation
    )[0]
    np.testing.assert_allclose(
        sampled(file, np.asarray(weights), "elevation_rows", "elevation_cols"),
        file["elevation_weights"],
        atol=1e-5,
    )


@pytest.mark.slow
def test_released_model_end_to_end(shared):
    file = np.load(shared / "fixtures" / "dinorade" / "end_to_end.npz")
    model, variables = dinorade_torch.load(end_to_end_tensors(shared))
    reference = released_geometry(shared)
    maps = jax.jit(model.apply)(variables, radar_cube(), patch_tokens(), reference)
    heatmap = np.asarray(jax.nn.sigmoid(maps.heatmap_logits))[0]
    chex.assert_shape(heatmap, (256, 112, 5))
    np.testing.assert_allclose(sampled(file, heatmap), file["heatmap"], atol=5e-5)
    boxes = np.asarray(maps.box_params)[0]
    np.testing.assert_allclose(sampled(file, boxes), file["regression"], atol=3e-4)


def test_loading_fills_the_model_exactly(shared):
    tensors = end_to_end_tensors(shared)
    nested = {"epoch": 3, "model": {f"module.{k}": v for k, v in tensors.items()}}
    model, variables = dinorade_torch.load(nested, crop_output=True, num_heads=8)
    assert model.radar.crop_output
    assert (model.fusion["num_heads"], model.fusion["num_points"]) == (8, 2)
    reference = jax.eval_shape(lambda: released_geometry(shared))
    expected = jax.eval_shape(
        model.init,
        jax.random.key(0),
        jnp.zeros((1, 256, 107, 101)),
        jnp.zeros((1, 720, 1280, 3), jnp.uint8),
        reference,
    )
    expected = dict(expected["params"]), expected["batch_stats"]
    del expected[0]["image_backbone"]
    chex.assert_trees_all_equal_shapes(
        (variables["params"], variables["batch_stats"]), expected
    )


def vit_tensors(prefix):
    shapes = {
        "embeddings.cls_token": (1, 1, 64),
        "embeddings.mask_token": (1, 1, 64),
        "embeddings.register_tokens": (1, 4, 64),
        "embeddings.patch_embeddings.weight": (64, 3, 16, 16),
        "embeddings.patch_embeddings.bias": (64,),
        "norm.weight": (64,),
        "norm.bias": (64,),
    }
    layer = {f"norm{i}.{kind}": (64,) for i in (1, 2) for kind in ("weight", "bias")}
    layer |= {f"layer_scale{i}.lambda1": (64,) for i in (1, 2)}
    layer |= {f"attention.{k}_proj.weight": (64, 64) for k in "qkvo"}
    layer |= {f"attention.{k}_proj.bias": (64,) for k in "qvo"}
    layer |= {"mlp.up_proj.weight": (96, 64), "mlp.up_proj.bias": (96,)}
    layer |= {"mlp.down_proj.weight": (64, 96), "mlp.down_proj.bias": (64,)}
    shapes |= {f"layer.0.{k}": s for k, s in layer.items()}
    return {prefix + k: RECIPES.seeded_tensor(k, s) for k, s in shapes.items()}


def test_image_backbone_with_adapters():
    tensors = vit_tensors("image_backbone.base_model.model.")
    plain_query = None
    with_adapters = {}
    for name, value in tensors.items():
        if name.endswith("q_proj.weight"):
            plain_query = value
            stem = name.removesuffix(".weight")
            down = RECIPES.seeded_tensor("lora_a", (2, 64))
            up = RECIPES.seeded_tensor("lora_b", (64, 2))
            with_adapters[f"{stem}.base_layer.weight"] = value
            with_adapters[f"{stem}.lora_A.default.weight"] = down
            with_adapters[f"{stem}.lora_B.default.weight"] = up
        elif name.endswith("q_proj.bias"):
            with_adapters[name.replace(".bias", ".base_layer.bias")] = value
        else:
            with_adapters[name] = value
    with_adapters |= {
        "image_neck.channel_proj.weight": np.zeros((128, 64), np.float32),
    }
    merged = dinorade_torch.without_lora(with_adapters)
    reader = StateDictReader(merged, "test")
    vit, params, _ = dinorade_torch.read_image(reader, merged)
    assert (vit.hidden_size, vit.num_layers, vit.num_heads, vit.mlp_dim) == (
        64,
        1,
        1,
        96,
    )
    query = params["image_backbone"]["layers"]["query"]["kernel"][0]
    np.testing.assert_allclose(query, (plain_query + up @ down).T, atol=1e-6)


def test_all_problems_are_listed(shared):
    tensors = dict(end_to_end_tensors(shared))
    del tensors["rad_backbone.bottleneck.conv1.double_conv.0.single_conv.0.bias"]
    del tensors["fusion.fusion_gate.2.bias"]
    tensors["image_neck.refine.0.bias"] = np.zeros(3, np.float32)
    tensors["fusion.pos_embed"] = np.zeros(3, np.float32)
    with pytest.raises(DataError) as error:
        dinorade_torch.load(tensors)
    message = str(error.value)
    for text in (
        "radar branch",
        "bottleneck.conv1.double_conv.0.single_conv.0.bias",
        "1 missing: fusion.fusion_gate.2.bias",
        "1 unexpected: fusion.pos_embed",
        "image_neck.refine.0.bias is [3], expected [128]",
    ):
        assert text in message


def test_other_content_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no DinoRADE state dict"):
        dinorade_torch.load({"backbone.start_conv.weight": np.zeros(3)})
    with pytest.raises(FileNotFoundError):
        dinorade_torch.load(tmp_path / "nothing.pth")
    with pytest.raises(UserError, match=r"unknown model fields \['depth'\]"):
        dinorade_torch.load({"rad_backbone.x": np.zeros(3)}, depth=3)
