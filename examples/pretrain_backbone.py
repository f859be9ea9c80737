"""Pretrains a small image backbone on simulated images, to be used frozen.

    python examples/pretrain_backbone.py --out backbones/small
    python train.py --config configs/quickstart_fusion.py:pretrained \\
        --image-backbone backbones/small

The backbone replaces DINOv3 on simulated data. It is trained on images of scenes with another seed
than those of the dataset, to predict which classes each patch shows and how near they are. These
targets come from the renderer; labels of the detector are not used. The output folder has Hugging
Face's DINOv3 format, or with `--config configs/quickstart_fusion.py:resnet50` a file
`resnet50.safetensors` with torchvision's names. The average precision of the patches of each
class is printed for scenes of a third seed.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import pathlib
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import click
import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import optax

from radejax.cli import entry
from radejax.config import Config, load_config
from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.models.image import STRIDE, ResNetTrunk, normalize
from radejax.models.options import DinoRadeOptions
from radejax.models.vit import ViT
from radejax.simulation.camera.renderer import CameraRenderer, stereo_calibration
from radejax.simulation.camera.shapes import camera_position
from radejax.simulation.config import SimulationOptions
from radejax.simulation.simulator import make_source
from radejax.simulation.world.scene import Sequence
from radejax.simulation.world.traffic import SIZES
from radejax.weights import dinov3_hf, image_backbone

CONFIG = (
    pathlib.Path(__file__).resolve().parents[1]
    / "configs"
    / "quickstart_fusion.py:pretrained"
)
SEEDS = (2_000_003, 3_000_017)
"""Offsets added to the seed of the dataset for the training images and the test images."""

REPORT, RESNET_FILE = "pretraining.json", "resnet50.safetensors"
PIXELS_SHOWN = 4
"""Minimum number of pixels of a class in a patch that counts as showing it."""
NEAR_M = 10.0
SMALL = tuple(map(CLASSES.index, ("Pedestrian", "Motorcycle", "Bicycle")))
SHARE_TURNED = 0.4
"""Fraction of the cars in training images that VRUs replace; see `with_small_ones`."""


class Images(NamedTuple):
    """Images and the content of their patches.

    Attributes:
        image: `[N, H, W, 3]` uint8.
        pixels: `[N, h, w, K]` uint16, number of pixels of each class in each patch.
        nearness: `[N, h, w]` 10 m / distance, averaged over the pixels of objects; 0 without any.
    """

    image: np.ndarray
    pixels: np.ndarray
    nearness: np.ndarray


def with_small_ones(sequence: Sequence, share: float, seed: int) -> Sequence:
    """Replaces a random fraction of the cars of a sequence by VRUs, which are rare otherwise."""
    rng = np.random.default_rng([seed, sequence.name, 17])
    tracks, cls = sequence.tracks, sequence.tracks.cls.copy()
    size, position = tracks.size_m.copy(), tracks.position_m.copy()
    is_car = cls == CLASSES.index("Sedan")
    for index in np.flatnonzero(is_car & (rng.random(cls.size) < share)):
        cls[index] = rng.choice(SMALL)
        mean, deviation = SIZES[CLASSES[cls[index]]]
        size[:, index] = np.array(mean) + np.array(deviation) * rng.normal(size=3)
        position[:, index, 2] = sequence.ground_m + size[:, index, 2] / 2.0
    tracks = dataclasses.replace(tracks, cls=cls, size_m=size, position_m=position)
    return dataclasses.replace(sequence, tracks=tracks)


def draw(
    options: SimulationOptions, patch: int, count: int, seed: int, share: float = 0.0
) -> Images:
    """Renders one image of each of `count` procedural scenes; `patch` is in pixels.

    VRUs replace the fraction `share` of the cars, see `with_small_ones`.
    """
    options = options.replace(
        seed=seed, train_sequences=count, test_sequences=0, frames_per_sequence=1
    )
    if options.scenes != "procedural" or not options.image_width:
        raise UserError(
            "simulation.scenes must be procedural and simulation.image_width above 0"
        )
    height, width = options.image_height, options.image_width
    origin = camera_position(stereo_calibration(options)[0])
    source = make_source(options)
    shape = (count, height // patch, width // patch)
    images = Images(
        np.empty((count, height, width, 3), np.uint8),
        np.empty((*shape, len(CLASSES)), np.uint16),
        np.empty(shape, np.float32),
    )

    def of_patches(pixels: np.ndarray) -> np.ndarray:
        """Sums `[H, W, K]` over the pixels of each patch, giving `[h, w, K]`."""
        rows, columns = shape[1:]
        return pixels.reshape(rows, patch, columns, patch, -1).sum((1, 3))

    def draw_one(index: int) -> None:
        sequence = with_small_ones(source.make(index + 1), share, seed)
        renderer = CameraRenderer(sequence, options)
        frame = sequence.frame(0)
        box = renderer.shown_boxes(frame, 0)
        cls = np.append(frame.cls, -1)[box]  # -1 where there is no box
        near = NEAR_M / np.linalg.norm(frame.boxes[:, :3] - origin, axis=1)
        near = np.append(near, 0.0)[box][..., None]
        pixels = of_patches(cls[..., None] == np.arange(len(CLASSES)))
        images.image[index] = renderer.view(frame, 0)
        images.pixels[index] = pixels
        total = np.maximum(pixels.sum(-1), 1)
        images.nearness[index] = of_patches(near)[..., 0] / total

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(draw_one, range(count)))
    return images


class Patches(nn.Module):
    """Backbone with a linear layer that predicts `[B, h, w, K + 1]` logits and nearness."""

    backbone: ViT | ResNetTrunk

    @nn.compact
    def __call__(self, image: jax.Array, train: bool = False) -> jax.Array:
        features = normalize(image)
        if isinstance(self.backbone, ViT):
            options = self.backbone.options
            size = options.patch_size
            shape = (len(image), image.shape[1] // size, image.shape[2] // size, -1)
            tokens = self.backbone(features)[:, options.num_prefix :]
            features = tokens.reshape(shape)
        else:
            features = self.backbone(features, train)
        return nn.Dense(len(CLASSES) + 1)(features)


def loss(found: jax.Array, pixels: jax.Array, nearness: jax.Array) -> jax.Array:
    """Returns the weighted cross-entropy by class plus the squared error of the nearness."""
    # A few pixels suffice for a target of 1, as a distant pedestrian has no more.
    target = jnp.minimum(pixels / (2.0 * PIXELS_SHOWN), 1.0)
    entropy = optax.sigmoid_binary_cross_entropy(found[..., :-1], target)
    entropy = jnp.sum(entropy * (1.0 + 2.0 * target), axis=-1)
    error = jnp.square(found[..., -1] - nearness)
    return jnp.mean(entropy + jnp.where(nearness > 0, error, 0.0))


def train(
    model: Patches, data: Images, *, epochs: int, seed: int, batch_size: int = 16
) -> Any:
    """Trains with AdamW, a cosine schedule and random mirroring, and returns the variables."""
    steps = epochs * (len(data.image) // batch_size)
    schedule = optax.warmup_cosine_decay_schedule(0.0, 1.5e-3, steps // 20, steps)
    optimizer = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=0.01)
    )
    variables = jax.jit(model.init)(jax.random.key(seed), data.image[:1])
    state = optimizer.init(variables["params"])

    @functools.partial(jax.jit, donate_argnums=(0, 1))
    def step(variables: Any, state: Any, batch: Images) -> tuple[Any, Any, jax.Array]:
        def total(params: Any) -> tuple[jax.Array, Any]:
            found, stats = model.apply(
                {**variables, "params": params},
                batch.image,
                train=True,
                mutable=["batch_stats"],
            )
            value = loss(found, batch.pixels.astype(jnp.float32), batch.nearness)
            return value, stats

        params = variables["params"]
        (value, stats), gradient = jax.value_and_grad(total, has_aux=True)(params)
        updates, state = optimizer.update(gradient, state, params)
        params = optax.apply_updates(params, updates)
        return {**variables, **stats, "params": params}, state, value

    rng, started = np.random.default_rng(seed), time.perf_counter()
    for epoch in range(epochs):
        order, values = rng.permutation(len(data.image)), []
        for start in range(0, len(order) - batch_size + 1, batch_size):
            chosen = order[start : start + batch_size]
            turn = slice(None, None, -1 if rng.random() < 0.5 else 1)
            batch = Images(*(part[chosen][:, :, turn] for part in data))
            variables, state, value = step(variables, state, batch)
            values.append(value)
        minutes = (time.perf_counter() - started) / 60
        mean = float(np.mean(values))
        click.echo(f"epoch {epoch + 1}: loss {mean:.4f}, {minutes:.1f} minutes")
    return variables


def average_precision(score: np.ndarray, is_shown: np.ndarray) -> float:
    """Returns the average precision from 0 to 1 of a ranking, or NaN without positives."""
    right = is_shown.ravel()[np.argsort(-score.ravel(), kind="stable")]
    precision = np.cumsum(right) / np.arange(1, right.size + 1)
    return float(precision[right].mean()) if right.any() else float("nan")


def patch_ap(model: Patches, variables: Any, data: Images) -> dict[str, float]:
    """Returns the AP by class; patches with at least `PIXELS_SHOWN` pixels are positives."""
    predict = jax.jit(model.apply)
    found = [
        predict(variables, data.image[i : i + 32]) for i in range(0, len(data[0]), 32)
    ]
    found = np.concatenate(found)
    return {
        cls: average_precision(found[..., k], data.pixels[..., k] >= PIXELS_SHOWN)
        for k, cls in enumerate(CLASSES)
    }


def save(backbone: ViT | ResNetTrunk, variables: Any, out: pathlib.Path) -> None:
    """Writes the backbone in the format that `--image-backbone` reads."""
    own = {name: part["backbone"] for name, part in variables.items()}
    if isinstance(backbone, ViT):
        dinov3_hf.save(backbone, own["params"], out)
    else:
        out.mkdir(parents=True, exist_ok=True)
        image_backbone.save_resnet(_frozen_params(own), out / RESNET_FILE)


def _frozen_params(variables: Mapping[str, Any]) -> dict[str, Any]:
    """Converts the variables of a trunk with `frozen=False` to parameters of a frozen one."""
    flat = flax.traverse_util.flatten_dict(dict(variables["params"]))
    stats = flax.traverse_util.flatten_dict(dict(variables["batch_stats"]))
    return flax.traverse_util.unflatten_dict(flat | stats)


def pretrain(
    config: Config,
    out: pathlib.Path,
    *,
    images: int = 3072,
    held_out: int = 512,
    epochs: int = 10,
    seed: int = 0,
) -> dict[str, float]:
    """Pretrains and writes the backbone of a config, and returns the patch AP by class.

    Args:
        config: Config of a radar-camera model with a `simulation` section.
        out: Folder for Hugging Face's DINOv3 format, or for `resnet50.safetensors`.
        images: Number of training images.
        held_out: Number of test images.
        epochs: Number of epochs.
        seed: Seed of initialization and batches, which is also added to that of the scenes.

    Raises:
        UserError: The config has no images of procedural scenes, or its model has no camera.
    """
    simulation = config.simulation
    if simulation is None or not isinstance(config.model, DinoRadeOptions):
        raise UserError("the config has no simulated images, or its model no camera")
    image = config.model.image
    patch = image.patch_size if image.kind == "vit" else STRIDE
    started, base = time.perf_counter(), simulation.seed + seed
    train_data, test_data = (
        draw(simulation, patch, count, base + offset, share)
        for count, offset, share in zip(
            (images, held_out), SEEDS, (SHARE_TURNED, 0.0), strict=True
        )
    )
    seconds = time.perf_counter() - started
    click.echo(f"{images + held_out} images rendered in {seconds:.0f} s")
    trunk = ResNetTrunk(image.resnet_width, frozen=False)
    model = Patches(ViT(image) if image.kind == "vit" else trunk)
    variables = train(model, train_data, epochs=epochs, seed=seed)
    found = patch_ap(model, variables, test_data)
    save(model.backbone, variables, out)
    minutes = (time.perf_counter() - started) / 60
    report = {"images": images, "epochs": epochs, "seed": seed, "minutes": minutes}
    files.write_json(out / REPORT, report | {"patch_ap": found})
    text = ", ".join(f"{cls} {ap:.2f}" for cls, ap in found.items())
    click.echo(f"AP of patches on {held_out} held-out images: {text}")
    click.echo(f"{minutes:.1f} minutes; written to {out}")
    return found


@click.command()
@click.option(
    "--config",
    default=str(CONFIG),
    help="Config of the detector. Default: quickstart_fusion.",
)
@click.option("--out", required=True, type=click.Path(path_type=pathlib.Path))
@click.option("--images", default=3072, show_default=True, type=click.IntRange(16))
@click.option("--held-out", default=512, show_default=True, type=click.IntRange(1))
@click.option("--epochs", default=10, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
def main(config, out, **options):
    """Pretrain the image backbone of a config and write it into the folder OUT."""
    entry.set_up_jax()
    with entry.exit_codes():
        pretrain(load_config(config), out, **options)


if __name__ == "__main__":
    main()
