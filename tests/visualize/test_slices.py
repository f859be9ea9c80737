import dataclasses

import numpy as np
from matplotlib.collections import LineCollection, QuadMesh

from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import draw
from radejax.visualize.style import Scene

from .. import small_models as small

GRID = RadarGrid.reduced(num_doppler=4, num_range=6, num_elevation=3, num_azimuth=5)
# The digits of a value are its place: range, azimuth, channel.
PROJECTION = (
    0.1 * np.arange(6)[:, None, None]
    + 0.01 * np.arange(5)[None, :, None]
    + 0.001 * np.arange(7)
).astype(np.float32)
SCENE = Scene(PROJECTION, GRID)


def planes(figure) -> list[np.ndarray]:
    return [ax.findobj(QuadMesh)[0].get_array() for ax in figure.axes[:3]]


def test_slices_are_the_named_bins():
    power, doppler, elevation = planes(draw.draw_slices(SCENE, range_idx=2))
    np.testing.assert_allclose(power[2, 3], 0.236, atol=1e-6)
    assert doppler.shape == (6, 4)
    np.testing.assert_allclose(doppler[5, 2], 0.542, atol=1e-6)
    assert elevation.shape == (3, 5)
    np.testing.assert_allclose(elevation[0, 4], 0.244, atol=1e-6)
    _, _, elevation = planes(draw.draw_slices(SCENE))
    np.testing.assert_allclose(elevation[0, 4], 0.544, atol=1e-6)


def test_edges_are_half_a_bin_outside():
    edges = draw.bin_edges(np.array([0.0, 2.0, 4.0]))
    np.testing.assert_array_equal(edges, [-1.0, 1.0, 3.0, 5.0])


def test_figures_never_call_doppler_a_velocity():
    axes = draw.draw_slices(SCENE, range_idx=1).axes
    texts = [f(a) for a in axes for f in (type(a).get_xlabel, type(a).get_title)]
    assert "Doppler (aliased) [m/s]" in texts
    assert any("at 23.6 m" in t for t in texts)
    assert not any("velocity" in t.lower() for t in texts)


def test_boxes_are_outlined_in_all_slices() -> None:
    box = np.array([[20.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]])
    truth = Boxes.one_frame(box, ["Sedan"])
    figure = draw.draw_slices(dataclasses.replace(SCENE, ground_truth=truth))
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
    without = draw.draw_slices(SCENE).axes[0]
    assert not [c for c in without.findobj(LineCollection) if len(c.get_segments())]


def test_there_is_no_slice_of_an_absent_axis() -> None:
    grid = small.uneven_grid()
    box = np.array([[10.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0]])
    truth = Boxes.one_frame(box, ["Sedan"])
    values = np.random.default_rng(0).uniform(size=grid.projection_shape)
    figure = draw.draw_slices(Scene(values, grid, ground_truth=truth))
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    assert [title.split(",")[0] for title in titles] == [
        "Range–azimuth",
        "Range–Doppler (aliased)",
    ]
    flat = small.uneven_grid(elevation_rad=np.array([0.1]), doppler_mps=np.array([]))
    scene = Scene(values[..., :1], flat, ground_truth=truth)
    power, elevation = planes(draw.draw_slices(scene))[:2]
    assert (power.shape, elevation.shape) == ((16, 14), (1, 14))


def test_edges_of_uneven_bins_are_between_their_centers():
    edges = draw.bin_edges(np.array([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(edges, [0.5, 1.5, 3.0, 5.0])
    np.testing.assert_allclose(draw.bin_edges(np.array([3.0])), [2.5, 3.5])
