"""Tests of radejax.weights.dinov3_hf."""

import json

import chex
import jax
import numpy as np
import pytest
import safetensors.numpy

from radejax.config import load_module
from radejax.core.errors import DataError, UserError
from radejax.weights import dinov3_hf

from ..torch_files import write_pth

TOLERANCE = 5e-5
SOURCES = [
    *("meta", "meta_swiglu", "timm", "timm_qkvb", "timm_swiglu"),
    *("dinov2", "dinov2_swiglu", "dinov2_registers"),
]


@pytest.fixture(scope="module")
def tensors(make):
    return make.tiny_tensors()


@pytest.fixture
def folder(tmp_path, make):
    """A model folder as Hugging Face lays it out."""
    return make.write_tiny_folder(tmp_path)


def image_of(make, stream, height, width):
    image = make.normal_input(stream, (1, 3, height, width))
    return image.transpose(0, 2, 3, 1)


def test_tokens_of_the_tiny_model(folder, golden, make):
    model, variables = dinov3_hf.load(folder)
    assert sum(x.size for x in jax.tree.leaves(variables)) == 299232 - 96  # mask token
    tokens = jax.jit(model.apply)(variables, image_of(make, 195, 64, 96))
    expected = np.load(golden / "dinorade_vit.npz")["last_hidden_state"]
    chex.assert_shape(tokens, (1, 29, 96))
    np.testing.assert_allclose(tokens[0], expected, atol=TOLERANCE)


@pytest.mark.parametrize("changes", [{}, {"use_gated_mlp": True, "hidden_act": "silu"}])
def test_a_folder_that_is_written_is_the_one_that_was_read(
    folder, tensors, changes, make, tmp_path
):
    model, variables = dinov3_hf.load(folder)
    if changes:
        model = dinov3_hf.model_from_config(make.TINY_CONFIG | changes)
        shapes = jax.eval_shape(model.init, jax.random.key(0), np.zeros((1, 16, 16, 3)))
        rng = np.random.default_rng(0)
        variables = jax.tree.map(lambda x: rng.normal(size=x.shape), shapes)
        variables = jax.tree.map(np.float32, variables)
    dinov3_hf.save(model, variables["params"], tmp_path / "written")
    again, found = dinov3_hf.load(tmp_path / "written")
    assert again == model
    chex.assert_trees_all_equal(found["params"], variables["params"])
    written = safetensors.numpy.load_file(tmp_path / "written" / "model.safetensors")
    if changes:
        assert written["layer.2.mlp.gate_proj.weight"].shape == (192, 96)
    else:  # by the names and in the shapes of transformers
        tensors = dict(tensors) | {"embeddings.mask_token": np.zeros((1, 1, 96))}
        chex.assert_trees_all_equal(written, tensors)


@pytest.mark.slow
def test_full_size_model(released, make):
    shapes = json.loads(str(released("dinov3/vits16")["tensors"]))
    tensors = {n: make.seeded_tensor(n, tuple(s)) for n, s in shapes.items()}
    config = json.loads(str(released("dinov3")["config"]))
    model = dinov3_hf.model_from_config(config)
    variables = {"params": dinov3_hf.to_params(model, tensors)}
    assert sum(x.size for x in jax.tree.leaves(variables)) == 21596544 - 384
    image, file = image_of(make, 851, 720, 1280), released("dinov3/720x1280")
    tokens = jax.jit(model.apply)(variables, image)[0, file["token_index"]]
    np.testing.assert_allclose(tokens, file["last_hidden_state"], atol=TOLERANCE)


WEIGHTS = "model.safetensors"


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({WEIGHTS: None}, f"lacks {WEIGHTS}"),
        ({WEIGHTS: b"PK" * 99}, "not a safetensors file"),
        ({"config.json": b"[1]"}, "config.json: expected a JSON object"),
    ],
)
def test_incomplete_or_corrupted_folders(folder, contents, message):
    for name, content in contents.items():
        (folder / name).unlink(missing_ok=True)
        if content is not None:
            (folder / name).write_bytes(content)
    with pytest.raises((DataError, UserError, FileNotFoundError), match=message):
        dinov3_hf.load(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model_type": "dinov2"}, "'dinov2', expected 'dinov3_vit'"),
        ({"num_hidden_layers": None}, "lacks num_hidden_layers"),
        ({"num_attention_heads": 7}, "hidden_size is 96, expected a multiple of 4"),
        ({"num_hidden_layers": 200}, "missing layer.100."),
    ],
)
def test_other_models_are_rejected(change, message, make, tensors):
    config = make.TINY_CONFIG | change
    config = {k: v for k, v in config.items() if v is not None}
    with pytest.raises((UserError, DataError), match=message):
        dinov3_hf.to_params(dinov3_hf.model_from_config(config), tensors, "x")


# Other sources -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def sources(golden):
    """Seeds, names and features of the tiny models of all sources."""
    arrays = dict(np.load(golden / "backbones.npz"))
    return load_module(golden / "backbones_make.py"), arrays


def description(sources, name):
    """Tensors and config of a tiny model."""
    seeds, arrays = sources
    info = json.loads(str(arrays["info"]))[name]
    return seeds.tensors(info["tensors"]), info["config"]


def write(folder, name, tensors, config):
    """Write a model as its source does, and return the path to load."""
    folder.mkdir(exist_ok=True)
    if name.startswith("meta"):
        write_pth(folder / "dinov3.pth", tensors)
        return folder / "dinov3.pth"
    (folder / "config.json").write_text(json.dumps(config))
    safetensors.numpy.save_file(tensors, folder / "model.safetensors")
    return folder


@pytest.mark.parametrize("name", SOURCES)
def test_features_of_the_original_code(sources, name, tmp_path):
    seeds, arrays = sources
    tensors, config = description(sources, name)
    path = write(tmp_path, name, tensors, config)
    model, variables = dinov3_hf.load(path)
    assert model.options.gated_mlp == ("swiglu" in name)
    assert model.options.position_grid == (4 if "dinov2" in name else 0)
    sizes = [key.split("__")[1] for key in arrays if key.startswith(f"{name}__")]
    assert len(sizes) == (3 if "dinov2" in name else 2)
    for size in sizes if name in ("meta", "dinov2") else sizes[-1:]:
        image = seeds.image(*map(int, size.split("x"))).transpose(0, 2, 3, 1)
        tokens = jax.jit(model.apply)(variables, image)[0, :, ::4]
        np.testing.assert_allclose(tokens, arrays[f"{name}__{size}"], atol=1.5e-5)
    if name.startswith("timm"):  # the file without its folder
        again = dinov3_hf.load(path / "model.safetensors")
        chex.assert_trees_all_equal(again[1], variables)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("timm", {"architecture": "convnext_tiny"}, "architecture is 'convnext_tiny'"),
        ("dinov2", {"model_type": "tips"}, "json: model_type is 'tips', expected a"),
        ("meta", {"rope_embed.periods": [1, 2]}, "periods are not powers of 100"),
        ("meta", {"blocks.0.ls1.gamma": [np.nan] * 32}, "layer_scale1.* not finite"),
        ("meta", {"pos_embed": [0]}, "DINOv2 is read from its Hugging Face"),
        ("timm_qkvb", {"blocks.0.attn.q_bias": None}, "missing .*q_proj.bias"),
    ],
)
def test_other_files_are_rejected(sources, name, change, message, tmp_path):
    tensors, config = description(sources, name)
    for key, value in change.items():
        if "." not in key and key != "pos_embed":
            config = config | {key: value}
        elif value is None:
            del tensors[key]
        else:
            tensors[key] = np.array(value, np.float32)
    path = write(tmp_path, name, tensors, config)
    with pytest.raises((UserError, DataError), match=message):
        dinov3_hf.load(path)


def test_other_networks_are_neither_read_nor_written(sources, tmp_path):
    # The names of Meta's ConvNeXt.
    write_pth(tmp_path / "x.pth", {"stages.0.0.norm.bias": np.zeros(3, np.float32)})
    with pytest.raises(DataError, match=r"expected one state dict .*blocks\.0\."):
        dinov3_hf.load(tmp_path / "x.pth")
    path = write(tmp_path, "dinov2", *description(sources, "dinov2"))
    model, variables = dinov3_hf.load(path)
    with pytest.raises(UserError, match="position_grid is 4, expected 0"):
        dinov3_hf.save(model, variables["params"], tmp_path / "written")


def test_rounded_wavelengths_are_those_of_the_base_100(sources, tmp_path):
    tensors, config = description(sources, "meta")
    periods = tensors["rope_embed.periods"]
    np.testing.assert_allclose(periods, [1, 100**0.25, 10, 100**0.75], rtol=1e-6)
    rounded = np.float32([1, 3.15625, 10, 31.625])  # to bfloat16
    path = write(tmp_path, "meta", tensors | {"rope_embed.periods": rounded}, config)
    assert dinov3_hf.load(path)[0].options.num_heads == 2
