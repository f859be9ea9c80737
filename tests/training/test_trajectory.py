"""Training as released: our optimizer, schedule and step beside the official code's own.

`tests/golden/trajectory.npz` holds twelve optimizer steps of the released RADE-Net on six
frames of random objects, and four of DinoRADE. Limits are a few times what another order of
float32 sums alone does to the authors' code there.
"""

import json
import zlib

import jax
import numpy as np
import pytest

from radejax import models
from radejax.config import load_config
from radejax.core import devices
from radejax.core.structures import Batch
from radejax.geometry.boxes import boxes8_from_7
from radejax.geometry.camera import stack_cameras
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import load_torch
from radejax.models.vit import ViT
from radejax.training.step import (
    create_state,
    make_optimizer,
    make_schedule,
    make_train_step,
)
from radejax.weights import dinov3_hf, radenet_torch

from .. import small_models

SEED = 1234
LOSSES = ("focal", "gwd", "smooth_l1", "grad_norm")
STEPS_PER_EPOCH = 3

Measured = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def file(golden):
    return dict(np.load(golden / "trajectory.npz"))


def of_training(file, kind):
    """The arrays of one of the two trainings."""
    prefix = f"{kind}/"
    return {k.removeprefix(prefix): v for k, v in file.items() if k.startswith(prefix)}


def cube_of(frame, boxes, classes):
    """The cube `[101, 256, 107]` in which each object is a spot with channels of its class."""
    rng = np.random.default_rng([SEED, 950 + frame])
    cube = 0.45 + 0.1 * rng.random((101, 256, 107), dtype=np.float32)
    rows, cols, channel = np.arange(256)[:, None], np.arange(107)[None], np.arange(101)
    for (x, y, z, *_), cls in zip(boxes, classes, strict=True):
        row = np.hypot(x, y) * 255 / 118
        column = np.rad2deg(-np.arctan2(y, x)) + 53
        spot = (rows - row) ** 2 / (2 * 2.0**2) + (cols - column) ** 2 / (2 * 1.5**2)
        doppler = (channel - (6 + 12 * cls)) ** 2 / (2 * (2.0 + cls) ** 2)
        elevation = (channel - 82 - 4 * z) ** 2 / (2 * 3.0**2)
        level = np.where(channel < 64, np.exp(-doppler), np.exp(-elevation))
        cube += (0.35 * level[:, None, None] * np.exp(-spot)[None]).astype(np.float32)
    return cube


@pytest.fixture(scope="module")
def frames(file):
    """The six frames, float32 as the authors' network sees them."""
    boxes, classes = file["boxes"], file["classes"].astype(np.int32)
    cubes = np.stack(
        [cube_of(i, boxes[i][x >= 0], x[x >= 0]) for i, x in enumerate(classes)]
    )
    assert zlib.crc32(cubes.tobytes()) == file["radenet/cube_crc32"]
    return Batch(
        projection=np.ascontiguousarray(np.moveaxis(cubes, 1, -1)),
        boxes=np.asarray(boxes8_from_7(np.nan_to_num(boxes)), np.float32)
        * (classes >= 0)[..., None],
        classes=classes,
        is_valid=classes >= 0,
        frame=np.arange(len(boxes), dtype=np.int32),
    )


def train(config, model, variables, batch, num_steps):
    """State after batches of two in order, and what each step measured."""
    num_epochs = -(-num_steps // STEPS_PER_EPOCH)
    options = config.train.replace(batch_size=2, num_epochs=num_epochs)
    schedule = make_schedule(options, STEPS_PER_EPOCH)
    optimizer = make_optimizer(options, schedule)
    grid = models.map_grid(RadarGrid.kradar(), model, config.data.azimuth_mapping)
    mesh = devices.make_mesh(1)
    state = create_state(variables, optimizer, use_ema=False, model=model)
    placement = devices.state_sharding(state, mesh, "replicated")
    state = jax.device_put(state, placement)
    step = make_train_step(
        model, optimizer, grid, loss=config.loss, decoding=config.decode
    )
    step = jax.jit(step, donate_argnums=0, out_shardings=(placement, None))
    measured, rng = [], jax.random.key(1)
    for i in range(num_steps):
        first = 2 * (i % STEPS_PER_EPOCH)
        part = jax.tree.map(lambda x, a=first: x[a : a + 2], batch)
        state, metrics = step(state, devices.put_batch(part, mesh), rng)
        rate = schedule(np.int32(i))
        measured.append({"lr": rate} | {name: metrics[name] for name in LOSSES})
    return state, {
        name: np.array([float(m[name]) for m in measured]) for name in measured[0]
    }


def check_steps(measured, fixture, limits):
    """Rates are float32's of the recorded ones, losses within relative limits."""
    np.testing.assert_allclose(measured["lr"], fixture["lr"], rtol=1.2e-7)
    for name in LOSSES:
        found = np.abs(measured[name] / fixture[name] - 1)
        # Of a sum over 28 million numbers in the first step.
        limit = np.where(limits < 1e-5, 3e-5, limits) if name == "grad_norm" else limits
        assert (found < limit).all(), (name, found)


def check_maps(maps, fixture, *, heatmap, regression):
    """Maps of the first frame at the end, every 16th row and 8th column."""
    for name, limit, found in (
        ("heatmap", heatmap, jax.nn.sigmoid(maps.heatmap_logits)),
        ("regression", regression, maps.box_params),
    ):
        found = np.moveaxis(np.asarray(found)[0, ::16, ::8], -1, 0)
        np.testing.assert_allclose(found, fixture[name], atol=limit, rtol=0)


def check_stats(tensors, fixture, limits):
    """Mean, standard deviation and largest magnitude of tensors at the end."""
    of_name = dict(zip(map(str, fixture["names"]), fixture["stats"], strict=True))
    for name, value in tensors.items():
        size = np.abs(value).max()
        found = (value.mean(dtype=np.float64), value.std(dtype=np.float64), size)
        assert (np.abs(found - of_name[name]) < limits).all(), (name, found)


@pytest.mark.slow  # twelve steps of the full network: 8 processor minutes, 8 GiB
@pytest.mark.timeout(3000)
def test_radenet_trains_as_released(file, frames, make):
    config = load_config("radenet:official")
    model = models.build(config.model)
    tensors = {
        n: make.seeded_tensor(n, s)
        for n, s in radenet_torch.torch_shapes(model).items()
    }
    variables = load_torch(tensors).variables
    state, measured = train(config, model, variables, frames, 12)
    maps = jax.jit(model.apply)(state.eval_variables, frames.projection[:1])
    fixture = of_training(file, "radenet")
    # Seen: 3e-7, up to 2e-4 in steps 2 to 5, 4e-3 after.
    check_steps(measured, fixture, np.array([2e-6, *[6e-4] * 4, *[8e-3] * 7]))
    check_maps(maps, fixture, heatmap=8e-4, regression=1.2e-2)
    trained = radenet_torch.save(model, state.eval_variables)
    assert set(trained) == set(map(str, fixture["names"]))
    check_stats(trained, fixture, (2e-5, 2e-5, 1.5e-4))


def by_torch_name(load, tensors, variables):
    """The numbers of every tensor that a loader puts into variables, in no order.

    Told by loading tensors of their own positions.
    """
    names = list(tensors)
    marked = {n: np.full(tensors[n].shape, i, np.float32) for i, n in enumerate(names)}
    tree = load(marked)
    assert jax.tree.structure(tree) == jax.tree.structure(variables)
    position, value = (
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(t)])
        for t in (tree, variables)
    )
    order = np.argsort(position, kind="stable")
    ends = np.searchsorted(position[order], np.arange(len(names) + 1))
    parts = {n: value[order[ends[i] : ends[i + 1]]] for i, n in enumerate(names)}
    return {name: part for name, part in parts.items() if part.size}


def images(fixture, model, variables):
    """The six frames' images as the frozen backbone sees them."""
    embed = jax.jit(lambda image: model.apply(variables, image, method="embed"))
    features = []
    for i, crc32 in enumerate(fixture["image_crc32"]):
        rng = np.random.default_rng([SEED, 970 + i])
        image = rng.integers(0, 256, (720, 1280, 3), dtype=np.uint8)
        assert zlib.crc32(image.tobytes()) == crc32
        features.append(np.asarray(embed(image[None])[0]))
    embedded, index = np.stack(features), fixture["token_index"]
    patches = embedded.reshape(len(features), -1, embedded.shape[-1])
    after = 5  # the class token and four registers
    np.testing.assert_allclose(
        patches[:, index[index >= after] - after],
        fixture["tokens"][:, index >= after],
        atol=2e-5,
    )
    return embedded


# Their gradient is rounding alone, before a normalization by batch.
NO_GRADIENT = [f"image_neck.{n}.0.bias" for n in ("fpn_layer1", "fpn_layer2", "refine")]


@pytest.mark.slow  # six ViT-S/16 and four steps of all: 6 processor minutes, 8 GiB
@pytest.mark.timeout(3000)
def test_dinorade_trains_as_released(file, frames, make, released):
    config = load_config("dinorade:official")
    # The fixture's settings where they are not the release's.
    config = config.replace(
        model={"fusion": {"num_points": 4, "necks": False, "dropout": 0.0}},
        train={"final_learning_rate": config.train.learning_rate},
    )
    model = models.build(config.model)
    tensors, of_backbone = (
        {name: make.seeded_tensor(name, tuple(shape)) for name, shape in listed.items()}
        for listed in (
            json.loads(str(released(group)["tensors"]))
            for group in ("dinorade/end_to_end", "dinov3/vits16")
        )
    )
    variables = load_torch(tensors).variables
    backbone = dinov3_hf.to_params(ViT(model.options.image), of_backbone)
    variables["params"]["image_backbone"] = backbone
    calibration = small_models.official_calibration()
    fixture = of_training(file, "dinorade")
    batch = frames.replace(
        image=images(fixture, model, variables),
        camera=stack_cameras([calibration.camera("pinhole")] * len(frames.frame)),
    )
    state, measured = train(config, model, variables, batch, 4)
    # Seen: 5e-7, 3e-5, 2e-4, 5e-4.
    check_steps(measured, fixture, np.array([2e-6, 4e-4, 8e-4, 3e-3]))
    one = jax.tree.map(lambda x: x[:1], batch)
    apply = jax.jit(model.apply)
    maps = apply(state.eval_variables, one.projection, one.image, one.camera)
    check_maps(maps, fixture, heatmap=4e-3, regression=0.1)

    after = jax.device_get({"params": state.params, **state.model_state})
    trained = by_torch_name(lambda x: load_torch(x).variables, tensors, after)
    left_out = {name for name in tensors if name not in trained}
    assert all("num_batches" in n or "fusion.output_proj" in n for n in left_out)
    running = [name for name in trained if ".running_" in name]
    for name in running:  # vectors, whose order is torch's
        expected = fixture[f"running/{name}"]
        limit = 2e-2 * np.abs(expected).max()
        np.testing.assert_allclose(trained.pop(name), expected, atol=limit, rtol=0)
    assert len(running) == 6
    for name in NO_GRADIENT:
        del trained[name]
    check_stats(trained, fixture, (1.5e-4, 1.5e-4, 1.5e-3))
