"""Tests of radejax.models.lifting."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.geometry.camera import stack_cameras
from radejax.geometry.radar_grid import RadarGrid
from radejax.models import lifting
from radejax.models.lifting import WeightingNetwork
from radejax.models.options import QueryGridOptions

from .. import small_models as small

ANGLES = {"azimuth_deg": (-40.0, 20.0), "elevation_deg": (-10.0, 10.0)}
AXES = QueryGridOptions(range_m=(1.0, 4.0), **ANGLES)


def test_centers_by_hand():
    centers = AXES.centers_ego(2, 3, 2)
    chex.assert_shape(centers, (2, 3, 2, 3))
    # Range 5, azimuth 0, elevation -5 and +5 degrees.
    low = [5 * np.cos(np.deg2rad(5)), 0, -5 * np.sin(np.deg2rad(5))]
    np.testing.assert_allclose(centers[1, 2, 0], low, atol=1e-12)
    np.testing.assert_allclose(centers[1, 2, 1], np.array(low) * [1, 1, -1], atol=1e-12)
    # Negative azimuth is to the left: positive y.
    assert centers[1, 0, 0, 1] > 3


def test_axes_follow_the_grid():
    grid = RadarGrid.kradar()
    axes = QueryGridOptions.of_grid(grid)
    centers = axes.centers_ego(256, 112, 10)
    flat = np.hypot(centers[..., 0], centers[..., 1]) / np.cos(np.deg2rad(16.2))
    np.testing.assert_allclose(flat[:, 5, 0], grid.range_m, atol=1e-9)
    azimuth = -np.arctan2(centers[9, :107, 3, 1], centers[9, :107, 3, 0])
    np.testing.assert_allclose(azimuth, grid.azimuth_rad, atol=1e-12)
    down = axes.replace(elevation_deg=(18.0, -18.0)).centers_ego(3, 4, 10)
    np.testing.assert_allclose(down, axes.centers_ego(3, 4, 10)[:, :, ::-1])


def test_uneven_axes_are_given_by_all_centers_and_continue_into_padding():
    grid = small.uneven_grid()
    axes = QueryGridOptions.of_grid(grid)
    assert axes.elevation_deg == (-18.0, 18.0)
    centers = axes.centers_ego(16, 16, 1)[:, :, 0]
    expected = grid.padded(8).bin_centers_ego()
    np.testing.assert_allclose(centers[..., :2], expected, atol=1e-9)
    assert hash(axes) == hash(QueryGridOptions.of_grid(grid))


def check_official(reference, index, points, is_valid):
    found = np.asarray(reference.points).reshape(-1, 2)[index]
    np.testing.assert_allclose(found, points, atol=2e-6)
    found = np.asarray(reference.is_valid).ravel()[index]
    np.testing.assert_array_equal(found, is_valid)


def test_released_reference_points(golden, released):
    file = np.load(golden / "dinorade_geometry.npz")
    axes, camera = QueryGridOptions.official(), small.official_calibration()
    camera = camera.camera("pinhole")
    on_host = lifting.reference_points(camera, axes, 256, 112, 10, "official")
    chex.assert_shape(on_host.points, (1, 256, 112, 10, 2))
    assert on_host.points.dtype == np.float32
    check_official(on_host, file["index"], file["reference_points_f64"], file["valid"])
    masks = released("dinorade/geometry").items()
    masks = {name: np.unpackbits(mask).astype(bool) for name, mask in masks}
    is_clear = ~masks["near_mask_border_packed"]
    is_valid = on_host.is_valid.ravel()[is_clear]
    np.testing.assert_array_equal(is_valid, masks["valid_packed"][is_clear])
    # Without the released crop 95.3 % of the queries lie in the image.
    whole = lifting.reference_points(camera, axes, 256, 112, 10)
    assert whole.is_valid.mean() == pytest.approx(0.953, abs=5e-4)
    # In the program, in float32, for two cameras.
    cameras = stack_cameras([camera] * 2)
    project = jax.jit(lifting.reference_points, static_argnums=range(1, 6))
    cameras = jax.tree.map(jnp.asarray, cameras)
    in_program = project(cameras, axes, 256, 112, 10, "official")
    second = jax.tree.map(lambda x: x[1], in_program)
    check_official(second, file["index"], file["reference_points_f64"], file["valid"])


def test_queries_outside_the_image_are_invalid_and_clipped():
    angles = {"azimuth_deg": (-60.0, 60.0), "elevation_deg": (-1.0, 1.0)}
    axes = QueryGridOptions(range_m=(10.0, 10.0), **angles)
    calibration = small.forward_camera()
    reference = lifting.reference_points(calibration.camera(), axes, 2, 5, 1)
    # Azimuth -60, 0, 60, 120, 180 degrees: left of the image, in it, right, behind.
    assert reference.is_valid[0, 1, :, 0].tolist() == [False, True] + 3 * [False]
    np.testing.assert_allclose(reference.points[0, 0, :3, 0, 0], [0, 0.5, 1])
    assert reference.has_image is None
    # Points are fractions of the image, so that its size does not matter.
    resized = calibration.resized(60, 35).camera()
    other = lifting.reference_points(resized, axes, 2, 5, 1)
    chex.assert_trees_all_close(other, reference, atol=1e-7)


def test_a_camera_of_zeros_sees_nothing():
    ahead = stack_cameras([small.forward_camera().camera()] * 2)
    zeros = jax.tree.map(lambda x: 0 * x, ahead)
    for camera in (zeros, jax.tree.map(jnp.asarray, zeros)):
        with np.errstate(invalid="ignore", divide="ignore"):
            reference = lifting.reference_points(camera, AXES, 3, 4, 2)
        chex.assert_tree_all_finite(reference.points)
        assert not np.any(reference.is_valid)


@pytest.mark.parametrize("kind", ["mlp", "cnn"])
def test_elevation_weights_sum_to_one(kind):
    network = WeightingNetwork(6, kind)
    elevation = np.random.default_rng(0).random((2, 5, 4, 9)).astype(np.float32)
    variables = jax.jit(network.init)(jax.random.key(0), elevation)
    weights = jax.jit(network.apply)(variables, elevation)
    chex.assert_shape(weights, (2, 5, 4, 6))
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    # The MLP sees one bin alone, the CNN its neighbors.
    moved = elevation.copy()
    moved[:, 0, 0] += 1
    changed = np.abs(jax.jit(network.apply)(variables, moved) - weights).max(-1) > 1e-7
    assert changed[:, 0, 0].all()
    assert changed[:, 1, 1].any() == (kind == "cnn")
