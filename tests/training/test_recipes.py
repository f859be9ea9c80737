"""The configs of both papers: what they say, and two steps of each at tiny size."""

import chex
import jax
import numpy as np
import pytest

from radejax import models
from radejax.config import load_config
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.options import DinoRadeOptions
from radejax.training.step import (
    create_state,
    make_optimizer,
    make_schedule,
    make_train_step,
)

from ..small_models import drawn, labeled_batch

SIZE = (32, 576)  # the released crop leaves out 280 columns on both sides
ALL = [
    *(("radenet", words) for words in ("", "paper", "official", "sedan", "stem")),
    *(("radenet", words) for words in ("base", "cbam", "cbam_heads", "expand")),
    *(("radenet", words) for words in ("sigma0.75", "adaptive", "anisotropic")),
    *(("dinorade", words) for words in ("", "paper", "official", "rc", "r")),
    *(("dinorade", words) for words in ("rcw_resnet50", "sedan", "sigma3")),
    *((name, "") for name in ("quickstart", "quickstart_fusion", "full_grid")),
    ("simulate_real_scenes", ""),
]


@pytest.mark.parametrize(
    ("name", "words", "batch", "epochs", "floor", "classes", "labels"),
    [
        ("radenet", "", 10, 10, 1e-4, 5, "v2.1"),
        ("radenet", "official,sedan", 10, 11, 1e-5, 1, "v1.1"),
        ("dinorade", "paper,sedan", 6, 11, 1e-4, 1, "v1.1"),
        ("dinorade", "official", 6, 11, 1e-5, 5, "v2.1"),
    ],
)
def test_trainings_of_the_papers(name, words, batch, epochs, floor, classes, labels):
    config = load_config(f"{name}:{words}")
    train = config.train
    assert (train.batch_size, train.num_epochs) == (batch, epochs)
    assert (len(config.classes), config.model.num_classes) == (classes, classes)
    assert config.data.label_version == labels
    assert train.weight_decay == 0.01
    assert (train.gradient_clip_norm, train.ema_decay) == (None, None)
    assert config.data.mirror_probability == 0.0
    steps = 17_458 // batch * epochs
    schedule = make_schedule(train, steps // epochs)
    is_cyclic = "official" in words
    period = 2 * (steps // epochs) if is_cyclic else 2 * steps
    phase = np.cos(2 * np.pi * np.arange(steps + 1) / period)
    rates = jax.jit(schedule)(np.arange(steps + 1))
    expected = floor + (1e-3 - floor) * (1 + phase) / 2
    np.testing.assert_allclose(rates, expected, rtol=1e-4)


RELEASE = {"model.input_center", "model.input_scale", "data.release"}


@pytest.mark.parametrize(
    ("preset", "word", "changed"),
    [
        ("radenet:official", "adaptive", {"loss.heatmap_sigma_mode"}),
        ("radenet:paper", "sigma0.75", {"loss.heatmap_sigma_bins"}),
        ("dinorade:paper", "anisotropic", {"loss.heatmap_sigma_mode"}),
        ("dinorade:", "sigma3", {"loss.heatmap_sigma_bins"}),
        ("radenet:official,sedan", "polar3d", RELEASE),
        ("dinorade:official,sedan", "rpc", RELEASE),
    ],
)
def test_a_word_changes_only_its_fields(preset, word, changed):
    before = dict(load_config(preset).fields())
    after = dict(load_config(f"{preset},{word}").fields())
    assert before.keys() == after.keys()
    assert {name for name in after if after[name] != before[name]} == changed
    if changed == RELEASE:
        # Half of K-Radar's noise and all echoes are positive.
        assert 0.5 <= after["model.input_center"] <= 0.52
        assert (after["model.input_scale"], after["data.release"]) == (25.0, word)


def _shrink(config):
    """The same choices on a sensor of 8 x 8 bins."""
    model = config.model
    is_wide = model.decoder_width > model.widths[0] and model.heads != "default"
    changes = {
        "doppler_bins": 5,
        "elevation_bins": 4,
        "widths": (8, 8),
        "decoder_width": 16 if is_wide else 8,
        "num_groups": 4,
        "pad_multiple": 4,
    }
    if isinstance(model, DinoRadeOptions):
        changes["image"] = {
            "size": SIZE,
            "hidden_size": 16,
            "num_layers": 1,
            "num_heads": 2,
            "mlp_dim": 16,
            "num_registers": 1,
            "resnet_width": 4,
        }
        changes["fusion"] = {"num_heads": 2, "num_elevation": 3, "chunk_size": 16}
        changes["query_grid"] = {
            "range_m": (2.0, 4.0),
            "azimuth_deg": (-45.0, 12.0),
            "elevation_deg": (-10.0, 10.0),
        }
    train = {"batch_size": 2, "num_epochs": 2, "warmup_steps": 0}
    return config.replace(model=changes, train=train, simulation=None)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words"), ALL)
def test_two_steps_of_every_config(name, words):
    config = _shrink(load_config(f"{name}:{words}"))
    bins = {"num_doppler": 5, "num_range": 8, "num_elevation": 4, "num_azimuth": 8}
    grid = RadarGrid.reduced(**bins, max_range_m=30.0)
    has_camera = isinstance(config.model, DinoRadeOptions)
    rng = np.random.default_rng(0)
    projection = rng.random((2, *grid.projection_shape)).astype(np.float16)
    image = rng.integers(0, 256, (2, *SIZE, 3)).astype(np.uint8) if has_camera else None
    batch = jax.device_put(labeled_batch(projection, image))
    model = models.build(config.model)
    optimizer = make_optimizer(config.train, lambda _: 1e-3)
    variables = drawn(model, *batch.model_inputs())
    start = create_state(variables, optimizer, use_ema=False, model=model)
    grid = models.map_grid(grid, model, config.data.azimuth_mapping)
    step = jax.jit(make_train_step(model, optimizer, grid, loss=config.loss))
    state = start
    for _ in range(2):
        state, metrics = step(state, batch, jax.random.key(1))
    assert (int(state.step), int(metrics["skipped"])) == (2, 0)
    chex.assert_tree_all_finite((state.params, metrics))
    changed = jax.tree.map(lambda a, b: (a != b).any(), state.params, start.params)
    assert np.mean(jax.tree.leaves(changed)) > 0.9
    chex.assert_trees_all_equal(state.frozen, start.frozen)
    assert bool(start.frozen) == (has_camera and config.model.image.freeze)
