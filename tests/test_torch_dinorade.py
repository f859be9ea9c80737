"""The torch network that the benchmark compares with is the same one."""

import pathlib

import jax
import numpy as np
import pytest

from radejax.core.config import load_config
from radejax.models import build
from radejax.models.lifting import ReferencePoints

torch = pytest.importorskip("torch")

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_same_parameters_and_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import torch_dinorade

    config = load_config(str(ROOT / "configs" / "dinorade.py")).model
    config.update(widths=(8, 8, 8), decoder_width=8, num_groups=4)
    config.image.update(size=(32, 64), hidden_size=24, num_layers=2, mlp_dim=48)
    config.image.num_heads = 2
    config.fusion.update(num_heads=2, num_elevation=3)
    bins, channels = 8, config.doppler_bins + config.elevation_bins
    points = np.random.default_rng(0).random((1, bins, bins, 3, 2), np.float32)
    ours = build(config)
    inputs = (
        np.zeros((1, bins, bins, channels), np.float32),
        np.zeros((1, 32, 64, 3), np.uint8),
        ReferencePoints(points, np.ones(points.shape[:-1], bool)),
    )
    shapes = jax.eval_shape(ours.init, jax.random.key(0), *inputs)["params"]
    torch_points = torch.tensor(points.reshape(-1, 3, 2))
    model = torch_dinorade.DinoRade(config, torch_points).eval()
    numbers = [sum(x.numel() for x in model.parameters())]
    numbers.append(sum(x.size for x in jax.tree.leaves(shapes)))
    assert numbers[0] == numbers[1]
    with torch.inference_mode():
        x = torch.zeros(1, channels, bins, bins)
        heatmap, boxes = model(
            x, model.embed(torch.zeros(1, 32, 64, 3, dtype=torch.uint8))
        )
    assert heatmap.shape == (1, config.num_classes, bins, bins)
    assert boxes.shape == (1, 8, bins, bins)
