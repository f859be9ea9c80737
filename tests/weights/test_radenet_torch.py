"""Tests of `radejax.weights.radenet_torch` against PyTorch's numbers.

`tests/golden/models_radenet.npz` has them at small widths, `released.npz` extracts of the official
network's outputs at full size.
"""

import json

import chex
import jax
import numpy as np
import pytest
import safetensors.numpy

from radejax import models
from radejax.core.errors import DataError, UserError
from radejax.inference.saved import load_torch
from radejax.models.options import RadeNetOptions
from radejax.weights import radenet_torch
from radejax.weights.radenet_torch import torch_shapes

from ..torch_files import write_pth


@pytest.fixture(scope="module")
def small_state(radenet_golden):
    """Seeded state dict of the small model in official names."""
    model = models.build(RadeNetOptions(**radenet_golden.SMALL))
    return radenet_golden.seeded_state(torch_shapes(model))


def load(content, **options):
    """Model and variables of a checkpoint of the authors' code."""
    saved = load_torch(content, **options)
    return saved.model, saved.variables


OVERRIDES = {"num_groups": 8, "doppler_bins": 8, "elevation_bins": 5}


def load_variant(radenet_golden, variant):
    # PyTorch's model has None for no attention.
    changes = {k: x or "off" for k, x in radenet_golden.VARIANTS[variant].items()}
    model = models.build(RadeNetOptions(**radenet_golden.SMALL | changes))
    state = radenet_golden.seeded_state(torch_shapes(model))
    overrides = OVERRIDES | ({"cbam": "paper"} if variant == "paper" else {})
    return model, *load(state, **overrides)


OUTPUTS = ("heatmap_logits", "box_params")


def check_outputs(outputs, variant, radenet_golden, arrays):
    for name, output in zip(OUTPUTS, outputs, strict=True):
        found = output[:, :: radenet_golden.ROW_STEP]
        np.testing.assert_allclose(found, arrays[f"{variant}/{name}"], atol=2e-5)


@pytest.mark.parametrize("variant", ["base", "stem", "expand", "paper"])
def test_small_outputs_equal_torchs(variant, radenet_golden, golden):
    expected_model, model, variables = load_variant(radenet_golden, variant)
    assert model == expected_model  # worked out from names and shapes
    maps = jax.jit(model.apply)(variables, radenet_golden.small_input())
    with np.load(golden / "models_radenet.npz") as arrays:
        outputs = maps.heatmap_logits, maps.box_params
        check_outputs(outputs, variant, radenet_golden, arrays)


def test_small_outputs_and_gradients_equal_torchs(radenet_golden, golden):
    expected_model, model, variables = load_variant(radenet_golden, "model")
    assert model == expected_model
    x = radenet_golden.small_input()

    def loss(variables):
        maps = model.apply(variables, x, train=True)
        maps = (maps.heatmap_logits, maps.box_params)
        weights = radenet_golden.cotangents([m.shape for m in maps])
        total = sum((m * w).sum() for m, w in zip(maps, weights, strict=True))
        return total, maps

    gradient, outputs = jax.jit(jax.grad(loss, has_aux=True))(variables)
    # Written like a checkpoint, a gradient has torch's names and layout.
    gradient = radenet_torch.save(model, gradient)
    with np.load(golden / "models_radenet.npz") as arrays:
        check_outputs(outputs, "model", radenet_golden, arrays)
        for name in radenet_golden.GRADIENTS:
            expected = arrays[f"model/grad/{name}"]
            tolerance = 1e-4 * np.abs(expected).max()
            np.testing.assert_allclose(gradient[name], expected, atol=tolerance)


@pytest.mark.parametrize("ending", [".pth", ".safetensors"])
def test_files_of_every_kind_come_back(small_state, tmp_path, ending):
    model, variables = load(small_state, **OVERRIDES)
    path = tmp_path / f"weights{ending}"
    if ending == ".pth":  # as torch writes it, which is not needed
        write_pth(path, small_state)
    else:
        saved = radenet_torch.save(model, variables)
        chex.assert_trees_all_equal(saved, small_state)
        safetensors.numpy.save_file(saved, path)
    again, loaded = load(path, **OVERRIDES)
    assert again == model
    chex.assert_trees_all_equal(loaded, variables)


def test_torch_tensors_are_taken_as_they_are(small_state):
    torch = pytest.importorskip("torch")
    tensors = {n: torch.tensor(v, requires_grad=True) for n, v in small_state.items()}
    _, variables = load(tensors, **OVERRIDES)
    _, expected = load(small_state, **OVERRIDES)
    chex.assert_trees_all_equal(variables, expected)


def test_all_problems_are_listed(small_state):
    state = dict(small_state)
    del state["neck.neck.1.gn.bias"], state["head.reg_head.head.9.weight"]
    state["neck.neck.7.gn.bias"] = np.zeros(3, np.float32)
    name = "backbone.encoder_block_2.double_conv.0.single_conv.0.weight"
    state[name] = np.zeros((31, 16, 3, 3), np.float32)
    with pytest.raises(DataError) as error:
        load(state, **OVERRIDES)
    message = str(error.value)
    assert "4 problems" in message
    assert "missing neck.neck.1.gn.bias" in message
    assert "missing head.reg_head.head.9.weight" in message
    assert "unexpected neck.neck.7.gn.bias" in message
    assert f"{name} is float32(31, 16, 3, 3), expected (32, 16, 3, 3)" in message


def test_released_models_without_cbam_still_have_its_tensors(small_state):
    model, variables = load(small_state, cbam="off", **OVERRIDES)
    assert model.options.cbam == "off"
    assert not any("cbam" in name for name in variables["params"]["backbone"])
    saved = radenet_torch.save(model, variables)
    chex.assert_trees_all_equal_shapes(saved, small_state)
    for name in torch_shapes(model):
        np.testing.assert_array_equal(saved[name], small_state[name])


def test_what_cannot_be_converted_is_named(small_state, radenet_golden, tmp_path):
    _, paper, paper_variables = load_variant(radenet_golden, "paper")
    scaled = OVERRIDES | {"input_center": 0.545, "input_scale": 25.0}
    for call, message in (
        (lambda: load({"model": small_state, "ema": small_state}), "one state dict"),
        (lambda: load({"backbone.fc.weight": np.zeros(3)}), "not a state dict of"),
        (lambda: load(small_state, width=3, **OVERRIDES), r"model\.width is not a"),
        (lambda: load(tmp_path / "none.pth"), "none.pth"),
        (lambda: radenet_torch.save(paper, paper_variables), 'no cbam="paper"'),
        (lambda: radenet_torch.save(*load(small_state, **scaled)), r"center=0\.545"),
    ):
        with pytest.raises((DataError, UserError, FileNotFoundError), match=message):
            call()


# The official network at full size ---------------------------------------------------


def official_shapes(released, variant):
    shapes = json.loads(str(released(f"radenet/{variant}")["tensors"]))
    return {name: tuple(shape) for name, shape in shapes.items()}


def official_input():
    cube = np.random.default_rng([1234, 7]).random((1, 101, 256, 107), np.float32)
    return (cube * np.float32(0.6)).transpose(0, 2, 3, 1)


def check_maps(expected, maps):
    rows, columns = expected["rows"][:, None], expected["cols"]
    heatmap = np.asarray(jax.nn.sigmoid(maps.heatmap_logits[0]))
    boxes = np.asarray(maps.box_params[0])
    for name, actual, atol in (("heatmap", heatmap, 2e-5), ("regression", boxes, 1e-4)):
        assert actual.shape[:2] == (256, 112)
        subset = actual[rows, columns].transpose(2, 0, 1)
        np.testing.assert_allclose(subset, expected[name], atol=atol)
        stats = [f(actual, (0, 1)) for f in (np.mean, np.std, np.min, np.max)]
        wanted = expected[f"{name}_stats"]
        np.testing.assert_allclose(np.stack(stats, -1), wanted, atol=1e-4)


OTHERS = ("stem", "no_cbam", "expand256", "default_heads", "default_neck", "base")


@pytest.mark.parametrize(
    "variant",
    ["default", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)],
)
def test_official_network_at_full_size(released, radenet_golden, variant):
    shapes = official_shapes(released, variant)
    overrides = {"cbam": "off"} if variant in ("base", "no_cbam") else {}
    model, variables = load(radenet_golden.seeded_state(shapes), **overrides)
    if variant == "default":
        assert sum(v.size for v in jax.tree.leaves(variables)) == 28_336_878
    if not overrides:  # names and shapes are the official ones
        assert torch_shapes(model) == shapes
    maps = jax.jit(model.apply)(variables, official_input())
    check_maps(released(f"radenet/{variant}"), maps)
