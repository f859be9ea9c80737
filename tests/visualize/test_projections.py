import numpy as np
import pytest
from matplotlib.collections import LineCollection

from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import projections

GRID = RadarGrid.reduced(num_doppler=4, num_range=6, num_elevation=3, num_azimuth=5)
# A value that tells its place: range.azimuth.channel
PROJECTION = (
    0.1 * np.arange(6)[:, None, None]
    + 0.01 * np.arange(5)[None, :, None]
    + 0.001 * np.arange(7)
).astype(np.float32)


def test_reductions_over_the_right_channels():
    reduce = projections.range_azimuth
    np.testing.assert_allclose(reduce(PROJECTION, GRID)[2, 3], 0.236, atol=1e-6)
    doppler = reduce(PROJECTION, GRID, channels="doppler")
    np.testing.assert_allclose(doppler[2, 3], 0.233, atol=1e-6)
    elevation = reduce(PROJECTION, GRID, channels="elevation", reduce="mean")
    np.testing.assert_allclose(elevation[2, 3], 0.235, atol=1e-6)


def test_slices_are_the_named_bins():
    doppler = projections.range_doppler(PROJECTION, GRID, azimuth_idx=1)
    assert doppler.shape == (6, 4)
    np.testing.assert_allclose(doppler[5, 2], 0.512, atol=1e-6)
    elevation = projections.azimuth_elevation(PROJECTION, GRID, range_idx=2)
    assert elevation.shape == (5, 3)
    np.testing.assert_allclose(elevation[4, 0], 0.244, atol=1e-6)
    peak = projections.azimuth_elevation(PROJECTION, GRID)
    np.testing.assert_allclose(peak[4, 0], 0.544, atol=1e-6)


def test_decibels_agree_with_the_projection_that_the_data_has():
    data = pytest.importorskip("radejax.data.projection")
    power = np.full(GRID.shape_drea, 1e5, np.float32)
    values = projections.range_azimuth(data.project(power), GRID, units="db")
    np.testing.assert_allclose(values, 50.0, atol=1e-3)


def test_edges_are_half_a_bin_outside():
    edges = projections.bin_edges(np.array([0.0, 2.0, 4.0]))
    np.testing.assert_array_equal(edges, [-1.0, 1.0, 3.0, 5.0])


def test_pictures_never_call_doppler_a_velocity():
    figure = projections.draw_slices(PROJECTION, GRID, range_idx=1, azimuth_idx=2)
    axes = figure.axes
    texts = [f(a) for a in axes for f in (type(a).get_xlabel, type(a).get_title)]
    assert "Doppler (aliased) [m/s]" in texts
    assert any("(aliased), at 0.0°" in t for t in texts)
    assert any("at 23.6 m" in t for t in texts)
    assert not any("velocity" in t.lower() for t in texts)


def test_slice_bounds_are_the_axes():
    ax = projections.draw_slice("range_azimuth", PROJECTION, GRID)
    step = 106 / 4
    np.testing.assert_allclose(ax.get_xlim(), (-53 - step / 2, 53 + step / 2))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: projections.range_doppler(PROJECTION, GRID, azimuth_idx=5), "0..4"),
        (lambda: projections.azimuth_elevation(PROJECTION, GRID, range_idx=-1), "0..5"),
        pytest.param(
            lambda: projections.draw_slice("bev", PROJECTION, GRID),
            "range_doppler",
            marks=pytest.mark.wrong_types,
        ),
        (lambda: projections.range_azimuth(PROJECTION[:5], GRID), r"\(6, 5, 7\)"),
    ],
)
def test_wrong_use_is_named(call, message):
    with pytest.raises(UserError, match=message):
        call()


def test_boxes_are_outlined_in_all_slices() -> None:
    box = np.array([[20.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]])
    figure = projections.draw_slices(PROJECTION, GRID, ground_truth=(box, ["Sedan"]))
    lines = [ax.findobj(LineCollection)[-1].get_segments()[0] for ax in figure.axes[:3]]
    side = np.rad2deg(np.arctan2(1.0, 18.0))  # of the near corners
    far = np.hypot(22.0, 1.0)
    np.testing.assert_allclose(lines[0].max(0), [side, far], rtol=1e-6)
    np.testing.assert_allclose(lines[0].min(0), [-side, 18.0], atol=0.1)
    left, right = figure.axes[1].get_xlim()
    left += 0.02 * (right - left)
    np.testing.assert_allclose(lines[1].max(0), [left, far], rtol=1e-6)
    top = np.rad2deg(np.arctan2(2.0, np.hypot(18.0, 1.0)))
    np.testing.assert_allclose(lines[2].min(0), [-side, 0.0], atol=1e-6)
    np.testing.assert_allclose(lines[2].max(0), [side, top], rtol=1e-6)
    without = projections.draw_slices(PROJECTION, GRID).axes[0]
    assert not [c for c in without.findobj(LineCollection) if len(c.get_segments())]
