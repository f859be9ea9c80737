"""ResNet-50 weights of torchvision."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from radejax import models
from radejax.config import load_config
from radejax.core.archives import read_safetensors
from radejax.core.errors import DataError
from radejax.models.image import ResNetNeck, ResNetTrunk
from radejax.weights.image_backbone import load_resnet, save_resnet

from ..torch_files import write_pth

WIDTH = 4  # in place of 64
NARROW = models.build(
    load_config("dinorade:rcw_resnet50").model.replace(image={"resnet_width": WIDTH})
)


def torchvision_shapes():
    """Names and shapes of torchvision's ResNet-50, written down layer by layer."""
    shapes = {"conv1.weight": (WIDTH, 3, 7, 7)}

    def norm(name, width):
        for kind in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{kind}"] = (width,)
        shapes[f"{name}.num_batches_tracked"] = ()

    norm("bn1", WIDTH)
    before = WIDTH
    for stage, depth in enumerate((3, 4, 6, 3), 1):
        inside = WIDTH * 2 ** (stage - 1)
        for i in range(depth):
            name = f"layer{stage}.{i}"
            shapes[f"{name}.conv1.weight"] = (inside, before, 1, 1)
            shapes[f"{name}.conv2.weight"] = (inside, inside, 3, 3)
            shapes[f"{name}.conv3.weight"] = (4 * inside, inside, 1, 1)
            for j, width in enumerate((inside, inside, 4 * inside), 1):
                norm(f"{name}.bn{j}", width)
            if i == 0:
                shapes[f"{name}.downsample.0.weight"] = (4 * inside, before, 1, 1)
                norm(f"{name}.downsample.1", 4 * inside)
            before = 4 * inside
    return shapes | {"fc.weight": (1000, before), "fc.bias": (1000,)}


@pytest.fixture(scope="module")
def tensors():
    rng = np.random.default_rng(0)
    out = {}
    for name, shape in torchvision_shapes().items():
        value = rng.standard_normal(shape)
        if len(shape) == 1:
            value = 1 + 0.1 * value
        elif len(shape) == 4:
            value = value / np.sqrt(np.prod(shape[1:]))
        out[name] = np.asarray(value, np.float32)
    return out


@pytest.fixture(scope="module")
def loaded(tensors):
    return load_resnet(tensors, NARROW)


def convolved(x, weight, stride=1):
    """torch's `conv2d` of `[C, H, W]` with a padding of half the kernel's size."""
    size = weight.shape[-1]
    margin = size // 2
    padded = np.pad(x, [(0, 0), (margin, margin), (margin, margin)])
    windows = sliding_window_view(padded, (size, size), (1, 2))[:, ::stride, ::stride]
    return np.einsum("chwkl,ockl->ohw", windows, weight)


def stages(tensors, image):
    """What torchvision's four stages return for `[3, H, W]`, by the definition."""

    def norm(x, name):
        kinds = ("running_mean", "running_var", "weight", "bias")
        mean, var, scale, bias = (tensors[f"{name}.{k}"][:, None, None] for k in kinds)
        return (x - mean) / np.sqrt(var + 1e-5) * scale + bias

    def block(x, name, stride):
        y = convolved(x, tensors[f"{name}.conv1.weight"])
        y = np.maximum(norm(y, f"{name}.bn1"), 0)
        y = convolved(y, tensors[f"{name}.conv2.weight"], stride)
        y = np.maximum(norm(y, f"{name}.bn2"), 0)
        y = norm(convolved(y, tensors[f"{name}.conv3.weight"]), f"{name}.bn3")
        if (weight := tensors.get(f"{name}.downsample.0.weight")) is not None:
            x = norm(convolved(x, weight, stride), f"{name}.downsample.1")
        return np.maximum(x + y, 0)

    x = norm(convolved(image, tensors["conv1.weight"], 2), "bn1")
    padded = np.pad(np.maximum(x, 0), [(0, 0), (1, 1), (1, 1)])
    x = sliding_window_view(padded, (3, 3), (1, 2))[:, ::2, ::2].max((-1, -2))
    for stage, depth in enumerate((3, 4, 6, 3), 1):
        for i in range(depth):
            x = block(x, f"layer{stage}.{i}", 2 if stage > 1 and i == 0 else 1)
        yield x


def test_features_equal_the_definition(tensors, loaded):
    """Those of the trunk and, as the projection is the model's own, of the last stage."""
    assert set(loaded["params"]) == {"image_backbone", "image_neck"}
    assert set(loaded["params"]["image_neck"]) == {"block_1", "block_2", "block_3"}
    assert set(loaded["batch_stats"]) == {"image_neck"}
    image = np.random.default_rng(1).standard_normal((1, 42, 64, 3)).astype(np.float32)
    width = 32 * WIDTH
    kernel = np.eye(width, dtype=np.float32)[None, None]
    neck = {"params": loaded["params"]["image_neck"] | {"proj": {"kernel": kernel}}}
    neck["batch_stats"] = loaded["batch_stats"]["image_neck"]

    @jax.jit
    def apply(image):
        trunk = {"params": loaded["params"]["image_backbone"]}
        features = ResNetTrunk(WIDTH).apply(trunk, image)
        last = ResNetNeck(width, WIDTH).apply(neck, features, jnp.ones(1, bool))
        return features, last

    _, _, *expected = stages(tensors, image[0].transpose(2, 0, 1))
    for found, wanted in zip(apply(image), expected, strict=True):
        close = 1e-4 * np.abs(wanted).max()
        np.testing.assert_allclose(found[0].transpose(2, 0, 1), wanted, atol=close)


def test_files_and_their_problems(tensors, tmp_path):
    path = tmp_path / "resnet50.pth"
    broken = dict(tensors)
    del broken["layer3.5.bn2.weight"]
    broken["avgpool.weight"] = np.zeros(2, np.float32)
    write_pth(path, broken)
    message = r"resnet50\.pth does not fit, 2 problems: missing layer3\.5\.bn2\.weight"
    with pytest.raises(DataError, match=f"{message}.*unexpected avgpool"):
        load_resnet(path, NARROW)
    with pytest.raises(FileNotFoundError):
        load_resnet(tmp_path / "nothing.pth", NARROW)


def test_a_trunk_by_itself_is_written_and_read(tensors, loaded, tmp_path):
    params = loaded["params"]["image_backbone"]
    path = tmp_path / "resnet50.safetensors"
    save_resnet(params, path)
    found = load_resnet(path, NARROW)
    chex.assert_trees_all_equal(found, {"params": {"image_backbone": params}})
    # By the names that another program would look for.
    names = [name for name, value in tensors.items() if value.ndim]
    names = [name for name in names if not name.startswith(("layer4", "fc"))]
    expected = {name: tensors[name] for name in names}
    chex.assert_trees_all_equal(read_safetensors(path), expected)
