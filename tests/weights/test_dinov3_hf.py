"""Tests of radejax.weights.dinov3_hf."""

import json
import shutil

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


def test_only_the_first_layers(golden, make, tensors):
    # Without the final normalization's statistics, to see where an error starts.
    expected = np.load(golden / "dinorade_vit.npz")
    config = make.TINY_CONFIG | {"num_hidden_layers": 1}
    kept = {
        k: v for k, v in tensors.items() if not k.startswith(("layer.1", "layer.2"))
    }
    model = dinov3_hf.model_from_config(config)
    variables = {"params": dinov3_hf.to_params(model, kept)}
    tokens = jax.jit(model.apply)(variables, image_of(make, 195, 64, 96))
    after = expected["after_layer_0"]
    mean, deviation = after.mean(-1, keepdims=True), after.std(-1, keepdims=True)
    normed = (after - mean) / np.sqrt(deviation**2 + 1e-5)
    normed = normed * tensors["norm.weight"] + tensors["norm.bias"]
    np.testing.assert_allclose(tokens[0], normed, atol=TOLERANCE)


@pytest.mark.parametrize(("size", "stream"), [("64x96", 195), ("224x224", 355)])
def test_tiny_model_folder_of_transformers(shared, make, size, stream):
    model, variables = dinov3_hf.load(shared / "fixtures" / "dinov3" / "tiny_model")
    check_tokens(shared, "tiny", model, variables, make, size, stream)


@pytest.mark.parametrize(
    ("size", "stream"),
    [
        ("64x96", 195),
        ("224x224", 355),
        pytest.param("720x1280", 851, marks=pytest.mark.slow),
    ],
)
def test_full_size_model(shared, make, size, stream):
    folder = shared / "fixtures" / "dinov3"
    listing = json.loads((folder / "vits16_params.json").read_text())["tensors"]
    config = json.loads((folder / "vits16_config.json").read_text())
    model = dinov3_hf.model_from_config(config)
    variables = {"params": dinov3_hf.to_params(model, make.seeded_state_dict(listing))}
    assert sum(x.size for x in jax.tree.leaves(variables)) == 21596544 - 384
    check_tokens(shared, "vits16", model, variables, make, size, stream)


def check_tokens(shared, name, model, variables, make, size, stream):
    height, width = map(int, size.split("x"))
    tokens = jax.jit(model.apply)(variables, image_of(make, stream, height, width))[0]
    file = np.load(shared / "fixtures" / "dinov3" / f"{name}.npz")
    index = file[f"{size}__token_index"]
    expected = file[f"{size}__last_hidden_state"]
    np.testing.assert_allclose(tokens[index], expected, atol=TOLERANCE)
    norms = np.linalg.norm(tokens, axis=-1)
    np.testing.assert_allclose(norms, file[f"{size}__token_norms"], atol=TOLERANCE)


def test_names_of_transformers_5_in_memory(tensors, make):
    model = dinov3_hf.model_from_config(make.TINY_CONFIG)
    plain = dinov3_hf.to_params(model, tensors)
    prefixed = {f"model.{k}": v for k, v in tensors.items()}
    chex.assert_trees_all_equal(dinov3_hf.to_params(model, prefixed), plain)


def test_incomplete_or_corrupted_folders(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config.json and model.safetensors"):
        dinov3_hf.load(tmp_path / "nowhere")
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(DataError, match="not a safetensors file"):
        dinov3_hf.load(folder)
    weights.unlink()
    with pytest.raises(FileNotFoundError, match=r"lacks model.safetensors"):
        dinov3_hf.load(folder)
    shutil.copy(__file__, folder / "config.json")
    weights.write_bytes(b"")
    with pytest.raises(DataError, match="is not valid JSON"):
        dinov3_hf.load(folder)
    (folder / "model.safetensors.index.json").touch()
    with pytest.raises(UserError, match="has its weights in several files"):
        dinov3_hf.load(folder)
    (folder / "model.safetensors.index.json").unlink()
    (folder / "config.json").write_text('{"architecture": "vit_small_patch16_dinov3"}')
    safetensors.numpy.save_file(
        {"blocks.0.attn.qkv.weight": np.zeros((3, 1), np.float32)}, weights
    )
    with pytest.raises(DataError, match="not the tensors of a DINOv3 ViT"):
        dinov3_hf.load(folder)
    (folder / "config.json").write_text("[1]")
    with pytest.raises(DataError, match=r"config.json: expected a JSON object"):
        dinov3_hf.load(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model_type": "dinov2"}, "'dinov2', expected 'dinov3_vit'"),
        ({"hidden_act": "relu"}, "is 'relu', expected 'gelu'"),
        ({"num_hidden_layers": None}, "lacks num_hidden_layers"),
        ({"num_hidden_layers": 10**9}, "is 1000000000, expected .* at most 65536"),
        ({"num_hidden_layers": "8"}, "is '8', expected an integer"),
        ({"num_hidden_layers": True}, "is True, expected an integer"),
        ({"num_attention_heads": 0}, "expected an integer of at least 1"),
        ({"num_register_tokens": -1}, "expected an integer of at least 0"),
        ({"layer_norm_eps": float("nan")}, "is nan, expected 1e-05"),
        ({"rope_theta": 10.0}, "is 10.0, expected 100.0"),
        ({"use_gated_mlp": "no"}, "is 'no', expected False"),
        ({"num_attention_heads": 7}, "hidden_size is 96, expected a multiple of 4"),
    ],
)
def test_other_models_are_rejected(change, message, make):
    config = make.TINY_CONFIG | change
    config = {k: v for k, v in config.items() if v is not None}
    with pytest.raises(UserError, match=message):
        dinov3_hf.model_from_config(config)


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (2, "unexpected layer.2."),
        (4, "missing layer.3."),
        (65536, "missing layer.100."),
    ],
)
def test_another_number_of_layers_is_rejected(make, tensors, count, message):
    model = dinov3_hf.model_from_config(make.TINY_CONFIG | {"num_hidden_layers": count})
    with pytest.raises(DataError, match=f"x does not fit, .*{message}"):
        dinov3_hf.to_params(model, tensors, "x")


# Other sources -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def sources(golden):
    """Seeds, names and features of the tiny models of all sources."""
    return load_module(golden / "backbones_make.py"), dict(
        np.load(golden / "backbones.npz")
    )


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
    for size in sizes:
        image = seeds.image(*map(int, size.split("x"))).transpose(0, 2, 3, 1)
        tokens = jax.jit(model.apply)(variables, image)[0, :, ::4]
        np.testing.assert_allclose(tokens, arrays[f"{name}__{size}"], atol=1.5e-5)
    if name.startswith("timm"):  # the file without its folder
        again = dinov3_hf.load(path / "model.safetensors")
        chex.assert_trees_all_equal(again[1], variables)


@pytest.mark.parametrize("name", ["meta", "timm_qkvb", "dinov2_registers"])
def test_missing_and_unexpected_tensors(sources, name, tmp_path):
    tensors, config = description(sources, name)
    norm = {"meta": "blocks.1.norm2.bias", "timm_qkvb": "blocks.1.norm2.bias"}.get(
        name, "encoder.layer.1.norm2.bias"
    )
    registers = next(n for n in tensors if "reg" in n or "storage" in n)
    del tensors[norm]
    tensors["head.weight"] = tensors.pop(registers)
    path = write(tmp_path, name, tensors, config)
    with pytest.raises(DataError, match=r"missing layer\.1\.norm2\.bias; unexp.*head"):
        dinov3_hf.load(path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("timm", {"architecture": "convnext_tiny"}, r"architecture is 'convnext_tiny'"),
        (
            "dinov2",
            {"model_type": "dinov3_convnext"},
            "model_type is 'dinov3_convnext'",
        ),
        (
            "dinov2",
            {"model_type": "tips"},
            r"json: model_type is 'tips', expected a ViT",
        ),
        (
            "dinov2",
            {"model_type": None},
            "model_type is None, expected a ViT of DINOv3",
        ),
        ("dinov2", {"layer_norm_eps": 1e-5}, "json: layer_norm_eps is 1e-05, expected"),
        ("dinov2", {"qkv_bias": False}, "qkv_bias is False, expected True"),
        (
            "dinov2",
            {"num_attention_heads": "2"},
            "num_heads is '2', expected an integer",
        ),
        ("dinov2", {"num_hidden_layers": 3}, "missing layer.2."),
        ("dinov2", {"patch_size": 16}, r"patch_embeddings.weight .*14, 14\), expected"),
        (
            "dinov2",
            {"model_type": "dinov3_vit"},
            "DINOv3 config lacks intermediate_size",
        ),
    ],
)
def test_other_folders_are_rejected(sources, name, change, message, tmp_path):
    tensors, config = description(sources, name)
    path = write(tmp_path, name, tensors, config | change)
    with pytest.raises((UserError, DataError), match=message):
        dinov3_hf.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rope_embed.periods": np.float32([1, 2])}, "periods are not powers of 100"),
        (
            {"blocks.0.attn.qkv.bias_mask": np.ones(96)},
            "unexpected layer.0.*k_proj.bias",
        ),
        ({"blocks.0.ls1.gamma": np.full(32, np.nan)}, "layer_scale1.* not finite"),
        ({"pos_embed": np.zeros((1, 17, 32))}, "DINOv2 is read from its Hugging Face"),
        (
            {"blocks.0.attn.qkv.bias_mask": np.ones(2)},
            "unexpected layer.0.*k_proj.bias",
        ),
        ({"cls_norm.weight": np.ones(32)}, "unexpected cls_norm.weight"),
    ],
)
def test_other_files_are_rejected(sources, change, message, tmp_path):
    tensors, config = description(sources, "meta")
    change = {name: value.astype(np.float32) for name, value in change.items()}
    path = write(tmp_path, "meta", tensors | change, config)
    with pytest.raises((UserError, DataError), match=message):
        dinov3_hf.load(path)


@pytest.mark.parametrize("part", "qv")
def test_a_missing_bias_is_not_zero(sources, part, tmp_path):
    tensors, config = description(sources, "timm_qkvb")
    del tensors[f"blocks.0.attn.{part}_bias"]
    path = write(tmp_path, "timm_qkvb", tensors, config)
    with pytest.raises(DataError, match=rf"1 problems: missing .*{part}_proj.bias"):
        dinov3_hf.load(path)


def test_files_of_other_networks_are_rejected(tmp_path):
    # The names of Meta's ConvNeXt.
    write_pth(tmp_path / "x.pth", {"stages.0.0.norm.bias": np.zeros(3, np.float32)})
    with pytest.raises(DataError, match=r"expected one state dict .*blocks\.0\."):
        dinov3_hf.load(tmp_path / "x.pth")


def test_rounded_wavelengths_are_those_of_the_base_100(sources, tmp_path):
    tensors, config = description(sources, "meta")
    assert tensors["rope_embed.periods"].tolist() == pytest.approx(
        [1, 100**0.25, 10, 100**0.75]
    )
    rounded = np.float32([1, 3.15625, 10, 31.625])  # to bfloat16
    path = write(tmp_path, "meta", tensors | {"rope_embed.periods": rounded}, config)
    assert dinov3_hf.load(path)[0].options.num_heads == 2


def test_only_dinov3_is_written(sources, tmp_path):
    model, variables = dinov3_hf.load(
        write(tmp_path, "dinov2", *description(sources, "dinov2"))
    )
    with pytest.raises(UserError, match="position_grid is 4, expected 0"):
        dinov3_hf.save(model, variables["params"], tmp_path / "written")
