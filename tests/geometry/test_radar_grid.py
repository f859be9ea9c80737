import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.geometry.radar_grid import RadarGrid

KRADAR = RadarGrid.kradar()
GRIDS = {
    "center_padded": KRADAR.padded(8, "stretched"),
    "center_unpadded": KRADAR.padded(1, "stretched"),
    "center_upsampled": dataclasses.replace(
        KRADAR.padded(1, "stretched"),
        azimuth_rad=np.linspace(*KRADAR.azimuth_rad[[0, -1]], 214),
    ),
}


@pytest.fixture(scope="module")
def encoding(golden):
    return np.load(golden / "geometry_encoding.npz")


@pytest.mark.parametrize("name", GRIDS)
def test_nearest_bin_is_the_released_encoding_exactly(encoding, name):
    x, y = encoding["position"].T
    np.testing.assert_array_equal(GRIDS[name].nearest_bin(x, y), encoding[name])


@pytest.mark.parametrize("name", GRIDS)
def test_nearest_bin_in_float32_under_jit_keeps_the_ties(encoding, name):
    x, y = encoding["position"].astype(np.float32).T
    cell = jax.jit(GRIDS[name].nearest_bin)(x, y)
    assert cell.dtype == jnp.int32
    np.testing.assert_array_equal(cell, encoding[name])


def test_golden_encoding_is_the_reference(encoding, shared):
    reference = np.load(shared / "fixtures/ground_truth/encoding.npz")
    np.testing.assert_array_equal(encoding["position"], reference["values"][:, :2])
    for name in GRIDS:
        np.testing.assert_array_equal(encoding[name], reference[name])


def test_field_of_view(encoding):
    x, y = encoding["position"].T
    np.testing.assert_array_equal(KRADAR.in_field_of_view(x, y), encoding["in_fov"])
    assert not encoding["in_fov"].all()


def test_kradar_axes(shared):
    axes = np.load(shared / "data/kradar/radar_axes.npz")
    np.testing.assert_allclose(KRADAR.range_m, axes["range"], atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(KRADAR.azimuth_rad), axes["azimuth"])
    np.testing.assert_allclose(np.rad2deg(KRADAR.elevation_rad), axes["elevation"])
    np.testing.assert_allclose(KRADAR.doppler_mps, axes["doppler"], atol=1e-5)
    assert KRADAR.shape_drea == (64, 256, 37, 107)
    assert KRADAR.projection_shape == (256, 107, 101)


def test_straight_ahead_and_left_by_hand():
    # Bin 53 is boresight; one bin left of it is -1 degree, y positive.
    ahead = KRADAR.bin_to_ego(100, 53)
    np.testing.assert_allclose(ahead, [46.2890625, 0.0], atol=1e-12)
    left = KRADAR.bin_to_ego(100, 52)
    np.testing.assert_allclose(
        left, 46.2890625 * np.array([np.cos(np.pi / 180), np.sin(np.pi / 180)])
    )
    assert KRADAR.nearest_bin(*left).tolist() == [100, 52]


def test_padding_keeps_bins_in_place_unless_stretched():
    padded = KRADAR.padded(8)
    assert (padded.num_range, padded.num_azimuth) == (256, 112)
    np.testing.assert_allclose(padded.azimuth_rad[:107], KRADAR.azimuth_rad, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(padded.azimuth_rad[-1]), 58.0)
    stretched = KRADAR.padded(8, "stretched")
    np.testing.assert_allclose(
        np.rad2deg(stretched.azimuth_rad), -53 + np.arange(112) * 106 / 111
    )
    np.testing.assert_allclose(stretched.range_m, np.arange(256) * 118 / 255)


@settings(deadline=None, max_examples=50)
@given(st.floats(1, 255), st.floats(0, 106), st.sampled_from([KRADAR, *GRIDS.values()]))
def test_cells_and_meters_are_inverse(range_cell, azimuth_cell, grid):
    position = grid.bin_to_ego(range_cell, azimuth_cell)
    cell = grid.ego_to_bin(position[0], position[1])
    np.testing.assert_allclose(cell, [range_cell, azimuth_cell], atol=1e-9)


def test_every_center_is_its_own_nearest_bin():
    for grid in GRIDS.values():
        centers = grid.bin_centers_ego()[1:]  # all azimuths meet at range 0
        cell = grid.nearest_bin(centers[..., 0], centers[..., 1])
        rows, columns = np.indices(centers.shape[:2])
        np.testing.assert_array_equal(cell, np.stack([rows + 1, columns], -1))


def test_far_and_behind_clip_to_the_grid():
    assert KRADAR.nearest_bin(500.0, 0.0).tolist() == [255, 53]
    assert [KRADAR.nearest_bin(-1.0, y)[1] for y in (10.0, -10.0)] == [0, 106]


def test_host_results_are_float64_whatever_the_input():
    single = KRADAR.ego_to_bin(np.float32(30.0), np.float32(5.0))
    assert single.dtype == np.float64
    assert KRADAR.ego_to_bin(jnp.float32(30), jnp.float32(5)).dtype == jnp.float32
    assert KRADAR.bin_to_ego(jnp.arange(3), jnp.arange(3)).dtype == jnp.float32


def test_values_survive_json_and_compare_and_hash():
    again = RadarGrid.from_dict(json.loads(json.dumps(KRADAR.to_dict())))
    assert again == KRADAR
    assert hash(again) == hash(KRADAR)
    assert KRADAR.padded(8) != KRADAR.padded(8, "stretched")
    assert KRADAR != "a grid"


def test_axes_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        KRADAR.range_m[0] = 1.0


def test_reduced_grid_looks_like_the_sensor():
    small = RadarGrid.reduced(
        num_doppler=16, num_range=64, num_elevation=9, num_azimuth=56
    )
    assert small.shape_drea == (16, 64, 9, 56)
    assert small.range_m[-1] == 118.0
    np.testing.assert_allclose(np.rad2deg(small.azimuth_rad[[0, -1]]), [-53, 53])
    np.testing.assert_allclose(small.elevation_rad, -small.elevation_rad[::-1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"range_m": np.array([1.0])}, "range_m must be a vector of at least 2 bins"),
        ({"azimuth_rad": np.array([0.0, 1.0, 3.0])}, "azimuth_rad must be uniform"),
        ({"range_m": np.array([2.0, 1.0])}, "range_m must be uniform and increasing"),
        ({"doppler_mps": np.array([0.0, np.nan])}, "doppler_mps must be finite"),
        ({"azimuth_rad": np.array([0.0, np.inf])}, "azimuth_rad must be finite"),
        ({"elevation_rad": np.array([0, 1e300])}, "elevation_rad must be finite"),
        ({"fov_range_m": np.nan}, "fov_range_m must be positive and finite"),
    ],
)
def test_bad_axes_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(KRADAR, **changes)


@pytest.mark.wrong_types
def test_unknown_mapping_is_rejected():
    with pytest.raises(ValueError, match="is 'bent', expected true or stretched"):
        KRADAR.padded(8, "bent")
