"""ResNet-50 weights of torchvision."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax import models
from radejax.config import load_config
from radejax.core.archives import read_safetensors
from radejax.core.errors import DataError
from radejax.models.image import ResNetNeck, ResNetTrunk
from radejax.weights.image_backbone import load_resnet, save_resnet

from ..torch_files import write_pth

MODEL = models.build(load_config("dinorade:rcw_resnet50").model)


def torchvision_shapes():
    """Names and shapes of torchvision's ResNet-50, written down layer by layer."""
    shapes = {"conv1.weight": (64, 3, 7, 7)}

    def norm(name, width):
        for kind in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{kind}"] = (width,)
        shapes[f"{name}.num_batches_tracked"] = ()

    norm("bn1", 64)
    before = 64
    for stage, (depth, inside) in enumerate(
        zip((3, 4, 6, 3), (64, 128, 256, 512), strict=True), 1
    ):
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
    return shapes | {"fc.weight": (1000, 2048), "fc.bias": (1000,)}


@pytest.fixture(scope="module")
def tensors():
    rng = np.random.default_rng(0)
    out = {}
    for name, shape in torchvision_shapes().items():
        value = 0.1 * rng.standard_normal(shape)
        if len(shape) == 1:
            value = 1 + value
        elif len(shape) == 4:
            value = value * 10 / np.sqrt(np.prod(shape[1:]))
        out[name] = np.asarray(value, np.float32)
    return out


def test_every_tensor_finds_its_place(tensors):
    loaded = load_resnet(tensors, MODEL)
    assert set(loaded["params"]) == {"image_backbone", "image_neck"}
    blocks = {f"block_{i}" for i in (1, 2, 3)}  # the projection is the model's own
    assert set(loaded["params"]["image_neck"]) == blocks
    assert set(loaded["batch_stats"]) == {"image_neck"}
    block = loaded["params"]["image_backbone"]["stage_2_block_1"]
    np.testing.assert_array_equal(
        block["conv_2"]["kernel"][0, 2, 5, 7],
        tensors["layer2.0.conv2.weight"][7, 5, 0, 2],
    )
    np.testing.assert_array_equal(
        block["norm_shortcut"]["var"], tensors["layer2.0.downsample.1.running_var"]
    )


def test_features_equal_torch(tensors):
    torch = pytest.importorskip("torch")
    functional = torch.nn.functional
    t = {k: torch.from_numpy(v) for k, v in tensors.items() if v.ndim}

    def norm(x, name):
        kinds = ("running_mean", "running_var", "weight", "bias")
        return functional.batch_norm(x, *(t[f"{name}.{k}"] for k in kinds))

    def block(x, name, stride):
        y = functional.conv2d(x, t[f"{name}.conv1.weight"])
        y = functional.relu(norm(y, f"{name}.bn1"))
        y = functional.conv2d(y, t[f"{name}.conv2.weight"], stride=stride, padding=1)
        y = functional.relu(norm(y, f"{name}.bn2"))
        y = norm(functional.conv2d(y, t[f"{name}.conv3.weight"]), f"{name}.bn3")
        if f"{name}.downsample.0.weight" in t:
            weight = t[f"{name}.downsample.0.weight"]
            x = functional.conv2d(x, weight, stride=stride)
            x = norm(x, f"{name}.downsample.1")
        return functional.relu(x + y)

    image = np.random.default_rng(1).standard_normal((1, 3, 48, 64)).astype(np.float32)
    x = functional.conv2d(
        torch.from_numpy(image), t["conv1.weight"], stride=2, padding=3
    )
    x = functional.max_pool2d(functional.relu(norm(x, "bn1")), 3, 2, 1)
    for stage, depth in enumerate((3, 4, 6, 3), 1):
        for i in range(depth):
            x = block(x, f"layer{stage}.{i}", 2 if stage > 1 and i == 0 else 1)
        if stage == 3:
            third = x
    loaded = load_resnet(tensors, MODEL)
    image = image.transpose(0, 2, 3, 1)
    features = jax.jit(ResNetTrunk().apply)(
        {"params": loaded["params"]["image_backbone"]}, image
    )
    expected = third.numpy().transpose(0, 2, 3, 1)
    np.testing.assert_allclose(features, expected, atol=2e-4 * np.abs(expected).max())
    # The projection that follows is the model's own: pass everything through.
    kernel = np.eye(2048, dtype=np.float32)[None, None]
    params = loaded["params"]["image_neck"] | {"proj": {"kernel": kernel}}
    out = jax.jit(ResNetNeck(2048).apply)(
        {"params": params, "batch_stats": loaded["batch_stats"]["image_neck"]},
        features,
        jnp.ones(1, bool),
    )
    expected = x.numpy().transpose(0, 2, 3, 1)
    np.testing.assert_allclose(out, expected, atol=2e-4 * np.abs(expected).max())


def test_files_and_their_problems(tensors, tmp_path):
    path = tmp_path / "resnet50.pth"
    broken = dict(tensors)
    del broken["layer3.5.bn2.weight"]
    broken["avgpool.weight"] = np.zeros(2, np.float32)
    write_pth(path, broken)
    with pytest.raises(DataError) as error:
        load_resnet(path, MODEL)
    assert "resnet50.pth does not fit, 2 problems: missing layer3.5.bn2" in str(error)
    assert "unexpected avgpool.weight" in str(error)
    with pytest.raises(FileNotFoundError):
        load_resnet(tmp_path / "nothing.pth", MODEL)


def test_a_trunk_by_itself_is_written_and_read(tmp_path):
    trunk = ResNetTrunk(width=4)
    shapes = jax.eval_shape(trunk.init, jax.random.key(0), jnp.zeros((1, 16, 16, 3)))
    rng = np.random.default_rng(2)
    params = jax.tree.map(
        lambda leaf: rng.standard_normal(leaf.shape).astype(np.float32),
        shapes["params"],
    )
    path = tmp_path / "resnet50.safetensors"
    save_resnet(params, path)
    narrow = MODEL.options.replace(image={"resnet_width": 4})
    loaded = load_resnet(path, models.build(narrow))
    assert loaded.keys() == {"params"}
    chex.assert_trees_all_equal(loaded["params"], {"image_backbone": params})
    # Its names are torchvision's: what another program would look for.
    names = set(read_safetensors(path))
    expected = {
        n for n in torchvision_shapes() if n.split(".")[0] not in ("layer4", "fc")
    }
    assert names == {n for n in expected if not n.endswith("num_batches_tracked")}
    with pytest.raises(DataError, match=r"conv1.weight is float32.4, 3, 7, 7., expect"):
        load_resnet(path, MODEL)
