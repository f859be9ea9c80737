import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.geometry.radar_grid import RadarGrid

KRADAR = RadarGrid.kradar()
changed = functools.partial(dataclasses.replace, KRADAR)
GRIDS = {
    "center_padded": KRADAR.padded(8, "stretched"),
    "center_unpadded": KRADAR.padded(1, "stretched"),
    "center_upsampled": dataclasses.replace(
        KRADAR.padded(1, "stretched"),
        azimuth_rad=np.linspace(*KRADAR.azimuth_rad[[0, -1]], 214),
    ),
}

SINE = np.arcsin(np.linspace(-0.9, 0.9, 41))  # uniform in sin(azimuth)
UNEVEN = RadarGrid(
    range_m=np.geomspace(2.0, 80.0, 30),
    azimuth_rad=SINE,
    elevation_rad=np.array([]),
    doppler_mps=np.linspace(-5.0, 5.0, 8),
    fov_range_m=80.0,
    fov_azimuth_rad=1.1,
)
TO_THE_LEFT = dataclasses.replace(UNEVEN, azimuth_rad=SINE[::-1])
EVEN_LEFT = dataclasses.replace(KRADAR, azimuth_rad=KRADAR.azimuth_rad[::-1])


@pytest.fixture(scope="module")
def encoding(golden):
    return np.load(golden / "geometry_encoding.npz")


@pytest.mark.parametrize("name", GRIDS)
def test_nearest_bin_is_the_released_encoding_exactly(encoding, name):
    """Also in float32 under jit, which keeps the ties."""
    x, y = encoding["position"].T
    np.testing.assert_array_equal(GRIDS[name].nearest_bin(x, y), encoding[name])
    single = encoding["position"].astype(np.float32).T
    cell = jax.jit(GRIDS[name].nearest_bin)(*single)
    assert cell.dtype == jnp.int32
    np.testing.assert_array_equal(cell, encoding[name])
    np.testing.assert_array_equal(KRADAR.in_field_of_view(x, y), encoding["in_fov"])


def test_kradar_axes():
    """The ends are those of K-Radar's own files."""
    assert KRADAR.shape_drea == (64, 256, 37, 107)
    assert KRADAR.projection_shape == (256, 107, 101)
    ends = [KRADAR.range_m, KRADAR.doppler_mps]
    ends += [np.rad2deg(KRADAR.azimuth_rad), np.rad2deg(KRADAR.elevation_rad)]
    expected = [[0, 118.037109], [-1.932591, 1.872198], [-53, 53], [-18, 18]]
    found = [axis[[0, -1]] for axis in ends]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    sizes = {"num_range": 64, "num_elevation": 9, "num_azimuth": 56}
    small = RadarGrid.reduced(num_doppler=1, **sizes)
    assert small.shape_drea == (1, 64, 9, 56)
    assert (small.range_m[-1], small.doppler_mps.tolist()) == (118.0, [0])
    np.testing.assert_allclose(np.rad2deg(small.azimuth_rad[[0, -1]]), [-53, 53])
    np.testing.assert_allclose(small.elevation_rad, -small.elevation_rad[::-1])


def test_straight_ahead_and_left_by_hand():
    # Bin 53 is boresight; one bin left of it is -1 degree, y positive.
    ahead = KRADAR.bin_to_ego(100, 53)
    np.testing.assert_allclose(ahead, [46.2890625, 0.0], atol=1e-12)
    left, degree = KRADAR.bin_to_ego(100, 52), np.pi / 180
    expected = 46.2890625 * np.array([np.cos(degree), np.sin(degree)])
    np.testing.assert_allclose(left, expected)
    assert KRADAR.nearest_bin(*left).tolist() == [100, 52]


def test_padding_keeps_bins_in_place_unless_stretched():
    padded = KRADAR.padded(8)
    assert (padded.num_range, padded.num_azimuth) == (256, 112)
    np.testing.assert_allclose(padded.azimuth_rad[:107], KRADAR.azimuth_rad, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(padded.azimuth_rad[-1]), 58.0)
    stretched = KRADAR.padded(8, "stretched")
    expected = np.linspace(-53, 53, 112)
    np.testing.assert_allclose(np.rad2deg(stretched.azimuth_rad), expected)
    np.testing.assert_allclose(stretched.range_m, np.arange(256) * 118 / 255)
    uneven = UNEVEN.padded(8)
    assert (uneven.num_range, uneven.num_azimuth) == (32, 48)
    np.testing.assert_allclose(uneven.range_m[:30], UNEVEN.range_m, rtol=1e-12)
    np.testing.assert_allclose(uneven.azimuth_rad[:41], SINE, atol=1e-12)
    np.testing.assert_allclose(np.diff(uneven.azimuth_rad[40:]), SINE[-1] - SINE[-2])


def test_host_results_are_float64_whatever_the_input():
    single = KRADAR.ego_to_bin(np.float32(30.0), np.float32(5.0))
    assert single.dtype == np.float64
    assert KRADAR.ego_to_bin(jnp.float32(30), jnp.float32(5)).dtype == jnp.float32
    assert KRADAR.bin_to_ego(jnp.arange(3), jnp.arange(3)).dtype == jnp.float32


def test_values_survive_json_and_compare_and_hash():
    for grid in (KRADAR, UNEVEN):
        again = RadarGrid.from_dict(json.loads(json.dumps(grid.to_dict())))
        assert again == grid
        assert hash(again) == hash(grid)
    assert KRADAR.padded(8) != KRADAR.padded(8, "stretched")
    assert KRADAR != "a grid"
    with pytest.raises(ValueError, match="read-only"):
        KRADAR.range_m[0] = 1.0


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: changed(range_m=[2.0, 1.0]), "be increasing, got 2 before 1$"),
        (
            lambda: changed(azimuth_rad=np.linspace(-53, 53, 107)),
            "azimuth_rad must be finite, to 3.* radians .* -53 to 53$",
        ),
        (lambda: changed(fov_range_m=np.nan), "is nan, expected .* above 0, to 236.07"),
        (
            lambda: changed(fov_azimuth_rad=53.0),
            "fov_azimuth_rad is 53.0, .* to 1.85005",
        ),
        (lambda: changed(doppler_mps=[], elevation_rad=[]), "are both empty"),
    ],
)
def test_bad_axes_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_field_of_view_may_be_all_around():
    azimuth = np.linspace(-np.pi, np.pi, 8, endpoint=False)
    fov = {"fov_range_m": 50.0, "fov_azimuth_rad": np.pi}
    whole = dataclasses.replace(KRADAR, azimuth_rad=azimuth, **fov)
    x = np.array([10.0, -10.0, -10.0, -50.0, -50.1])
    y = np.array([0.0, 0.0, -3.0, 0.0, 0.0])
    assert whole.in_field_of_view(x, y).tolist() == [True] * 4 + [False]
    assert whole.nearest_bin(-10.0, 0.01)[1] == 0
    assert not KRADAR.in_field_of_view(x[1:3], y[1:3]).any()


@pytest.mark.parametrize("grid", [UNEVEN, TO_THE_LEFT, EVEN_LEFT])
def test_nearest_bin_of_any_axis_is_that_with_the_nearest_center(grid):
    rng = np.random.default_rng(0)
    range_m = rng.uniform(grid.range_m[0], grid.range_m[-1], 500)
    azimuth = rng.uniform(-1.2, 1.2, 500)  # also beyond the axis
    x, y = range_m * np.cos(azimuth), -range_m * np.sin(azimuth)
    pairs = (range_m, grid.range_m), (azimuth, grid.azimuth_rad)
    nearest = [abs(value[:, None] - axis).argmin(1) for value, axis in pairs]
    np.testing.assert_array_equal(grid.nearest_bin(x, y), np.stack(nearest, -1))
    beyond = grid.nearest_bin(500.0, 0.0), grid.nearest_bin(-1.0, 10.0)
    assert beyond[0][0] == grid.num_range - 1
    assert beyond[1][1] == grid.azimuth_rad.argmin()
    jitted = jax.jit(grid.nearest_bin)(x.astype(np.float32), y.astype(np.float32))
    assert (np.asarray(jitted) == np.stack(nearest, -1)).mean() > 0.999


@settings(deadline=None, max_examples=50)
@given(
    st.floats(-0.5, 32),
    st.floats(-2, 43),
    st.sampled_from([KRADAR, *GRIDS.values(), UNEVEN, TO_THE_LEFT]),
)
def test_bins_and_meters_are_inverse_on_any_axis(range_bin, azimuth_bin, grid):
    range_bin += 1  # all azimuths meet at range 0
    position = grid.bin_to_ego(range_bin, azimuth_bin)
    found = grid.ego_to_bin(position[0], position[1])
    np.testing.assert_allclose(found, [range_bin, azimuth_bin], atol=1e-9)


@pytest.mark.parametrize("grid", [KRADAR, UNEVEN])
def test_a_box_without_offset_is_at_the_center_of_its_bin(grid):
    rows, columns = np.indices((grid.num_range, grid.num_azimuth))
    bins = np.stack([rows, columns], -1)[1:]  # all azimuths meet at range 0
    boxes = np.asarray(jax.jit(grid.boxes_at)(jnp.zeros((*bins.shape[:2], 8)), bins))
    np.testing.assert_allclose(boxes[..., :2], grid.bin_centers_ego()[1:], atol=1e-4)
    np.testing.assert_array_equal(grid.nearest_bin(*boxes.T[:2]), bins.swapaxes(0, 1))


def test_positions_between_bins_by_hand():
    range_m = np.array([1.0, 2.0, 4.0, 8.0])
    grid = dataclasses.replace(UNEVEN, range_m=range_m, fov_range_m=8.0)
    bins = np.array([-1.0, 0.5, 1.5, 3.0, 4.0]), np.full(5, 20.0)
    for found in (grid.bin_to_ego(*bins), jax.jit(grid.bin_to_ego)(*bins)):
        np.testing.assert_allclose(found[:, 0], [0.0, 1.5, 3.0, 8.0, 12.0], rtol=1e-6)
        np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(grid.range_widths_m, [1.0, 1.5, 3.0, 4.0])


def test_an_absent_axis_has_one_bin_in_tesseracts_and_no_channel():
    assert UNEVEN.shape_drea == (8, 30, 1, 41)
    assert UNEVEN.projection_shape == (30, 41, 8)
    axes = {"elevation_rad": np.array([0.1, 0.2]), "doppler_mps": np.array([])}
    flat = dataclasses.replace(UNEVEN, **axes)
    assert flat.shape_drea == (1, 30, 2, 41)
    projection = np.arange(3.0)
    assert flat.measured_channels(projection).tolist() == [1.0, 2.0]
    assert UNEVEN.measured_channels(np.arange(9.0)).tolist() == list(range(8))
    assert KRADAR.measured_channels(projection := np.arange(101.0)) is projection
