"""The pretrained backbone: its images, its training and its output folder."""

import pathlib

import jax
import numpy as np
import pretrain_backbone as pretraining
import pytest
from click.testing import CliRunner

from radejax import models
from radejax.config import load_config
from radejax.core.structures import CLASSES
from radejax.models.image import ResNetTrunk
from radejax.models.vit import ViT
from radejax.weights.image_backbone import load_image_backbone

from .. import small_models as small


def _config(word="pretrained"):
    config = load_config(str(small.CONFIGS / f"quickstart_fusion.py:{word}"))
    image = {
        "size": (32, 128),
        "hidden_size": 16,
        "num_layers": 1,
        "num_heads": 2,
        "mlp_dim": 16,
        "resnet_width": 4,
    }
    return config.replace(
        simulation={"image_width": 128, "image_height": 32, "cover_lens": False},
        model={"image": image},
    )


def _drawn(count, share=0.0, **fields):
    options = _config().simulation.replace(**fields)
    return pretraining.draw(options, 16, count, 7, share)


def test_patches_show_the_classes_that_are_drawn():
    plain_images = _drawn(6)
    flat = _drawn(6, camera_mode="oracle")
    np.testing.assert_array_equal(flat.pixels, plain_images.pixels)
    # Silhouettes have the color of their class: where the roadside hides none, each
    # of its pixels is one of the class.
    red = (flat.image[..., 0] > 0) & ~flat.image[..., 1:].any(-1)
    by_patch = red.reshape(6, 2, 16, 8, 16).sum((2, 4))
    sedans = flat.pixels[..., CLASSES.index("Sedan")]
    assert sedans.sum() > 100
    assert (sedans <= by_patch).all()
    assert (sedans == by_patch).mean() > 0.8
    # 20 m away: half as bright in a silhouette, 0.5 here.
    is_full = (sedans == by_patch) & (flat.pixels.sum(-1) == sedans) & (sedans > 60)
    brightest = flat.image[..., 0].reshape(6, 2, 16, 8, 16).max((2, 4))[is_full] / 255
    nearest = 2 * brightest / (1 - brightest) * 0.25  # 10 / d from 20 / (20 + d)
    assert is_full.sum() > 3
    assert (flat.nearness[is_full] <= nearest * 1.1).all()
    assert flat.nearness[is_full].min() > 0.08


def test_average_precision_by_hand():
    score, right = np.array([0.9, 0.8, 0.7, 0.1]), np.array([1, 0, 1, 0], bool)
    assert pretraining.average_precision(score, right) == pytest.approx((1 + 2 / 3) / 2)
    assert np.isnan(pretraining.average_precision(score, right & False))


@pytest.mark.slow  # compiles a training
@pytest.mark.parametrize("word", ["pretrained", "resnet50"])
def test_it_learns_and_what_it_writes_is_a_frozen_backbone(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    monkeypatch.setattr(pretraining, "load_config", lambda _: _config(word))
    options = ["--images", "64", "--held-out", "32", "--epochs", "12"]
    command = [*options, "--out", str(tmp_path / "backbone")]
    result = CliRunner().invoke(pretraining.main, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    losses = [float(line.split()[3][:-1]) for line in result.output.splitlines()[1:13]]
    assert losses[-1] < 0.6 * losses[0]
    (line,) = (row for row in result.output.splitlines() if "Sedan" in row)
    shown = pretraining.draw(_config().simulation, 16, 32, pretraining.SEEDS[1])
    chance = (shown.pixels[..., 0] >= pretraining.PIXELS_SHOWN).mean()
    assert float(line.split("Sedan ")[1].split(",")[0]) > chance + 0.2
    options = _config(word).model
    model, image = models.build(options), options.image
    assert image.freeze
    file = {"pretrained": "", "resnet50": pretraining.RESNET_FILE}[word]
    params = load_image_backbone(tmp_path / "backbone" / file, model)["params"]
    trunk = ResNetTrunk(image.resnet_width)
    backbone = ViT(image) if image.kind == "vit" else trunk
    shapes = jax.eval_shape(backbone.init, jax.random.key(0), np.zeros((1, 32, 128, 3)))
    assert jax.tree.map(np.shape, params["image_backbone"]) == jax.tree.map(
        lambda leaf: leaf.shape, shapes["params"]
    )
