"""Tests of `radejax.models.radenet` and of `radejax.models.build`."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax import models
from radejax.geometry.boxes import boxes7_from_8
from radejax.models.options import RadeNetOptions
from radejax.models.radenet import vehicle_from_beam

from ..small_models import drawn


@pytest.fixture(scope="module")
def small(radenet_golden):
    """One level and short ends, which compile fast."""
    short = {"widths": (16,), "neck": "plain", "heads": "default"}
    return RadeNetOptions(**radenet_golden.SMALL | short)


@pytest.fixture(scope="module")
def variables(small):
    return drawn(models.build(small), np.zeros((1, 8, 8, 13)))


@pytest.fixture(scope="module")
def apply(small):
    """Compiled once for a shape."""
    return jax.jit(models.build(small).apply)


def test_cropped_maps_are_the_padded_ones_cut(small, variables, apply):
    x = jax.random.uniform(jax.random.key(0), (1, 21, 14, 13))
    maps = apply(variables, x)
    cropped = jax.jit(models.build(small.replace(crop_output=True)).apply)(variables, x)
    assert cropped.heatmap_logits.shape == (1, 21, 14, 3)
    expected = jax.tree.map(lambda m: m[:, :21, :14], maps)
    chex.assert_trees_all_close(cropped, expected, atol=1e-5)


def test_center_and_scale_are_those_of_the_input(small, variables, apply):
    """Before padding, which then adds the center; in bfloat16 before the cast."""
    x = jax.random.uniform(jax.random.key(0), (1, 21, 14, 13), minval=0.5, maxval=0.6)
    scaled = small.replace(input_center=0.545, input_scale=25.0)
    maps = jax.jit(models.build(scaled).apply)(variables, x)
    expected = apply(variables, (x - 0.545) * 25.0)
    chex.assert_trees_all_close(maps, expected, atol=1e-5)
    narrow = models.build(scaled.replace(dtype="bfloat16"))
    noise = x.astype(jnp.bfloat16).astype(jnp.float32) - x
    assert jnp.abs(noise).max() > 1e-3  # what a cast before it would lose
    seen = narrow.apply(variables, x, method="_padded")
    seen = seen[:, :21, :14].astype(np.float32)
    np.testing.assert_allclose(seen, (x - 0.545) * 25.0, rtol=2**-8)


def test_a_turned_scene_gives_turned_boxes():
    params = jax.random.normal(jax.random.key(0), (1, 4, 5, 8))
    azimuth_rad = np.deg2rad([-120.0, -40.0, 0.0, 90.0, 170.0])
    found = boxes7_from_8(vehicle_from_beam(params, azimuth_rad))
    seen = boxes7_from_8(params)
    turn = np.asarray(found - seen)[..., 6] + azimuth_rad
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-5)
    offset, expected = (np.asarray(x[..., 0] + 1j * x[..., 1]) for x in (found, seen))
    np.testing.assert_allclose(offset, expected * np.exp(-1j * azimuth_rad), atol=1e-5)
    chex.assert_trees_all_equal(found[..., 2:6], seen[..., 2:6])


def test_yaws_and_offsets_turn_with_the_beam(small, variables, apply):
    """Also of padded columns, and nothing else does."""
    x = jax.random.uniform(jax.random.key(0), (1, 21, 14, 13))
    beams = small.replace(beam_azimuth_deg=(-180.0, 25.0))
    found = jax.jit(models.build(beams).apply)(variables, x)
    maps = apply(variables, x)
    assert found.box_params.shape[2] == 16
    azimuth_rad = np.deg2rad(-180 + 25.0 * np.arange(16))
    expected = vehicle_from_beam(maps.box_params, azimuth_rad)
    chex.assert_trees_all_close(found, maps.replace(box_params=expected), atol=1e-5)


@pytest.mark.slow
def test_remat_changes_neither_parameters_nor_gradients(small):
    x = jax.random.uniform(jax.random.key(0), (1, 16, 8, 13))
    model = models.build(small)
    variables = drawn(model, x)

    def gradient(model):
        def loss(v):
            maps = model.apply(v, x, train=True)
            return jnp.square(maps.heatmap_logits).sum() + maps.box_params.sum()

        return jax.jit(jax.grad(loss))(variables)

    expected = gradient(model)
    for policy in ("blocks", "full"):
        remat = gradient(models.build(small.replace(remat=policy)))
        chex.assert_trees_all_close(remat, expected, rtol=1e-3, atol=1e-3)


def test_bfloat16_is_near_float32(small, variables, apply):
    x = jax.random.uniform(jax.random.key(0), (1, 8, 8, 13))
    narrow = models.build(small.replace(dtype="bfloat16"))
    maps, expected = jax.jit(narrow.apply)(variables, x), apply(variables, x)
    assert maps.heatmap_logits.dtype == maps.box_params.dtype == jnp.float32
    for actual, wide in zip(*map(jax.tree.leaves, (maps, expected)), strict=True):
        assert np.abs(actual - wide).max() > 0  # it did compute in bfloat16
        assert np.abs(actual - wide).max() < 0.1 * np.abs(wide).max()
