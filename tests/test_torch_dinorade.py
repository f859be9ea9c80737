"""The torch network and losses of the benchmarks equal radejax's."""

import pathlib

import jax
import numpy as np
import pytest

from radejax.config import load_config
from radejax.core.structures import DetectionMaps
from radejax.losses.detection import detection_loss
from radejax.models import build
from radejax.models.lifting import ReferencePoints

torch = pytest.importorskip("torch")

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_same_maps_from_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import case
    import networks
    import torch_dinorade

    image = {"size": (32, 64), "hidden_size": 24, "num_layers": 2, "mlp_dim": 48}
    config = load_config("dinorade").model.replace(
        widths=(8, 8, 8),
        decoder_width=8,
        num_groups=4,
        image=image | {"num_heads": 2},
        fusion={"num_heads": 2, "num_elevation": 3},
    )
    rng = np.random.default_rng(0)
    bins, channels = 8, config.doppler_bins + config.elevation_bins
    points = rng.random((1, bins, bins, 3, 2), np.float32)
    x = rng.random((1, bins, bins, channels), np.float32)
    image = rng.integers(0, 256, (1, 32, 64, 3), np.uint8)
    ours = build(config)
    inputs = (x, image, ReferencePoints(points, np.ones(points.shape[:-1], bool)))
    variables = networks.random_variables(ours, *inputs)
    maps = jax.tree.leaves(ours.apply(variables, *inputs))
    model = torch_dinorade.DinoRade(
        config.to_dict(), torch.tensor(points.reshape(-1, 3, 2))
    )
    state = networks.torch_state(ours, variables)
    model.load_state_dict({k: torch.tensor(v) for k, v in state.items()})
    with torch.inference_mode():
        theirs = model.eval()(torch.tensor(x).permute(0, 3, 1, 2), torch.tensor(image))
    found = [np.moveaxis(np.asarray(m), -1, 1) for m in maps]
    assert case.difference(found, [t.numpy() for t in theirs]) < 1e-4


def test_same_losses_and_gradients_from_the_same_maps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import inputs
    import networks
    import torch_losses

    config = load_config("radenet")
    batch, model = inputs.frames_of(2), build(config.model)
    rng = np.random.default_rng(0)
    logits = rng.normal(-3, 2, (2, 256, 107, 5)).astype(np.float32)
    logits[0, 0, 0, :2] = 20.0, -20.0  # clipped
    params = rng.normal(0, 2, (2, 256, 107, 8)).astype(np.float32)

    def ours(maps: DetectionMaps) -> tuple[jax.Array, jax.Array]:
        total, parts = detection_loss(maps, batch, networks.GRID, config.loss)
        return total, parts["weighted_sum"]

    function = jax.jit(jax.value_and_grad(ours, has_aux=True))
    (total, weighted_sum), gradient = function(DetectionMaps(logits, params))
    losses = torch_losses.Losses(*networks.torch_losses(config, model, batch), "cpu")
    padded = np.pad([*logits.transpose(0, 3, 1, 2)], [(0, 0)] * 3 + [(0, 5)])
    given = [
        torch.tensor(padded, requires_grad=True),
        torch.tensor(params.transpose(0, 3, 1, 2), requires_grad=True),
    ]
    found, found_sum = losses(*given)
    found.backward()
    assert found.item() == pytest.approx(float(total), rel=1e-6)
    assert found_sum.item() == pytest.approx(float(weighted_sum), rel=1e-5)
    for x, wanted in zip(given, jax.tree.leaves(gradient), strict=True):
        theirs = x.grad.numpy().transpose(0, 2, 3, 1)[:, :, :107]
        limit = 1e-5 * np.abs(wanted).max()
        np.testing.assert_allclose(theirs, wanted, rtol=1e-4, atol=limit)
