import concurrent.futures
import dataclasses
import itertools
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection, QuadMesh

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import draw, style
from radejax.visualize.style import COLOR_MAP, Scene, save_figure

from .. import small_models as small

GRID = RadarGrid.reduced(num_doppler=4, num_range=60, num_elevation=3, num_azimuth=54)
ROI = (0.0, 72.0, -16.0, 16.0, -2.0, 7.6)


def scene(range_idx=20, azimuth_idx=20, **fields):
    """Scene with one echo."""
    projection = np.full(GRID.projection_shape, 0.2, np.float32)
    projection[range_idx, azimuth_idx, 2] = 0.6
    return Scene(projection, GRID, **fields)


def brightest_tile(figure, ax):
    """Center, in display coordinates, of the pixels in the strongest color."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(int)
    frame = np.round(ax.get_window_extent().extents).astype(int)
    inside = image[frame[1] : frame[3], frame[0] : frame[2]]
    color = np.round(255 * np.array(COLOR_MAP(1.0)[:3])).astype(int)
    rows, columns = np.nonzero((np.abs(inside - color) <= 2).all(-1))
    assert rows.size > 10
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]) + frame[:2]


@pytest.mark.parametrize(("range_idx", "azimuth_idx"), [(20, 5), (30, 27), (33, 44)])
def test_box_is_drawn_on_its_echo(range_idx, azimuth_idx):
    drawn = scene(range_idx, azimuth_idx)
    x, y = GRID.bin_to_ego(range_idx, azimuth_idx)
    _, polar = draw.draw_frame(drawn).axes
    ax = draw.draw_bev(drawn)
    outline = draw.to_polar(np.array([x, y]))
    # At 5 pixels a meter a bin is 10 pixels deep; its center is hit to one pixel.
    for axes, point in ((ax, (y, x)), (polar, outline)):
        tile = brightest_tile(axes.figure, axes)
        np.testing.assert_allclose(tile, axes.transData.transform(point), atol=1.0)


def test_a_scan_of_360_degrees_is_drawn_whole():
    azimuth_rad = np.linspace(-np.pi, np.pi, 36, endpoint=False)
    fov = {"fov_azimuth_rad": np.pi, "fov_range_m": 118.0}
    grid = dataclasses.replace(GRID, azimuth_rad=azimuth_rad, **fov)
    truth = Boxes.one_frame([-15.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], ["Sedan"])
    projection = np.zeros(grid.projection_shape, np.float32)
    drawn = Scene(projection, grid, ground_truth=truth)
    bev, polar = draw.draw_frame(drawn).axes
    assert bev.get_ylim()[0] == pytest.approx(-bev.get_ylim()[1])
    FigureCanvasAgg(bev.figure).draw()
    assert "−100" in [t.get_text() for t in bev.get_yticklabels()]
    (bar,) = bev.child_axes
    labels = [ax.yaxis.label for ax in (bev, bar, polar)]
    x_m, power, range_m = (label.get_window_extent() for label in labels)
    assert x_m.x0 > 0
    assert power.x1 < range_m.x0
    lines = [c for c in polar.collections if isinstance(c, LineCollection)]
    widths = [np.ptp(p.vertices[:, 0]) for c in lines for p in c.get_paths()]
    assert max(widths) < 20.0  # degrees, although the box is on both sides of 180


def test_bev_shows_boxes_headings_region_and_legend():
    truth = Boxes.one_frame([10.0, 3.0, 0.0, 4.0, 2.0, 1.5, np.pi / 2], ["Sedan"])
    found = Boxes.one_frame([20.0, -3.0, 0, 4, 2, 1.5, 0], ["Bus or Truck"], [0.875])
    boxes = {"ground_truth": truth, "predictions": found, "score_threshold": 0.3}
    ax = draw.draw_bev(scene(roi=ROI, **boxes))
    to_display = ax.transData.transform
    assert to_display((5.0, 20.0))[0] < to_display((-5.0, 20.0))[0]  # left is left
    assert to_display((0.0, 30.0))[1] > to_display((0.0, 10.0))[1]  # ahead is up
    lines = [c for c in ax.collections if hasattr(c, "get_segments")]
    one, other = (c.get_segments() for c in lines[1::2])  # each over its rim
    # Turned by 90 degrees: 4 m along y, 2 m along x. Axes hold (y, x).
    assert [*one[0].min(0), *one[0].max(0)] == pytest.approx([1, 9, 5, 11])
    assert [*other[0].min(0), *other[0].max(0)] == pytest.approx([-4, 18, -2, 22])
    # Heading marks leave through the front: +y (left) and +x (up).
    assert one[1][:, 0] == pytest.approx([5.0, 6.4])
    assert other[1][:, 1] == pytest.approx([22.0, 23.4])
    assert {t.get_text() for t in ax.texts} == {"Sedan", "Bus or Truck 0.88"}
    legend = [t.get_text() for t in ax.get_legend().get_texts()]
    expected = ["ground truth (1)", "prediction (1)", "wide region", "score ≥ 0.3"]
    assert legend == expected
    y, x = next(line for line in ax.lines if line.is_dashed()).get_data()
    assert (min(x), max(x), min(y), max(y)) == pytest.approx(ROI[:4])
    assert "[m]" in ax.get_xlabel()
    labels = [a.get_ylabel() for a in [*ax.figure.axes, *ax.child_axes]]
    assert draw.POWER_LABEL in labels


@pytest.mark.parametrize(
    ("score", "expected"),
    [(0.07, "score ≥ 0.07"), (0.15, "score ≥ 0.15"), (0.9, "0.15")],
)
def test_the_legend_is_true_of_the_boxes_that_are_drawn(score, expected):
    found = Boxes.one_frame([20.0, -3.0, 0, 4, 2, 1.5, 0], ["Sedan"], [score])
    figure = draw.draw_frame(scene(predictions=found, score_threshold=0.15))
    *_, last = figure.legends[0].get_texts()
    assert last.get_text().endswith(expected)


def test_outcomes_have_their_own_colors_and_labels_do_not_overlap():
    x_m = np.array([10.0, 16.0, 22.0, 30.0])
    box = np.tile([0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], (4, 1))
    box[:, 0] = x_m
    truth = Boxes.one_frame(box, ["Sedan"] * 4)
    found = Boxes.one_frame(box, ["Bus or Truck"] * 4, [0.9, 0.8, 0.7, 0.6])
    matches = style.Matches(np.array([1, 0, 0, -1]), np.array([1, 0, 0, 0]), 0.3)
    drawn = scene(ground_truth=truth, predictions=found, matches=matches)
    counts = {look.name: len(boxes) for look, boxes in drawn.sets}
    assert counts == {
        "not evaluated": 1,
        "object, found": 1,
        "object, missed": 2,
        "true positive": 1,
        "false positive": 3,
    }
    colors = [look.color for look, _ in drawn.sets]
    assert len(set(colors)) == len(colors)
    ax = draw.draw_bev(drawn)
    assert len(ax.texts) == 6  # of what is missed and predicted
    FigureCanvasAgg(ax.figure).draw()
    extents = [text.get_window_extent() for text in ax.texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(extents, 2))
    legend = [t.get_text() for t in ax.get_legend().get_texts()]
    assert "object, missed (2)" in legend
    assert legend[-1] == "IoU > 0.3"


def test_drawing_leaves_pyplot_alone_and_works_in_threads(tmp_path):
    image = np.zeros((72, 128, 3), np.uint8)
    none = Boxes.one_frame([], [], [])
    shown = scene(roi=ROI, predictions=none, image=image, title="sequence 1")

    def draw_one(i):
        figure = draw.draw_frame(shown)
        save_figure(figure, tmp_path / f"{i}.png")
        return figure

    with concurrent.futures.ThreadPoolExecutor(2) as threads:
        figure, _ = threads.map(draw_one, range(2))
    assert len(list(tmp_path.iterdir())) == 2
    assert figure.get_suptitle() == "sequence 1"
    assert [bool(ax.images) for ax in figure.axes].count(True) == 1
    assert len(figure.axes) == 3  # camera, bird's-eye and polar view
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()


def test_lidar_points_are_drawn_on_their_pixels():
    points_m = np.array([[10.0, 1.0, 0.5], [-10.0, 0, 0], [10.0, 90.0, 0]])
    image = np.zeros((72, 128, 3), np.uint8)
    size = {"width": 128, "height": 72}
    camera = small.forward_camera(intrinsics=(100.0, 100.0, 64.0, 36.0), **size)
    shown = scene(image=image, camera=camera, lidar_m=points_m)
    (ax,) = (ax for ax in draw.draw_frame(shown).axes if ax.images)
    (scatter,) = (x for x in ax.collections if isinstance(x, PathCollection))
    # u = 64 - 100 / 10, v = 36 - 50 / 10; the others are behind the camera or beside it.
    np.testing.assert_allclose(scatter.get_offsets(), [[53.5, 30.5]])


def test_map_shows_every_bin_of_a_partial_extent():
    """Bins that are omitted for speed must lie outside the axes."""
    extent = (30.0, 60.0, -20.0, 5.0)
    values = np.arange(60.0)[:, None] + np.arange(54.0)[None] / 100
    ax = draw.draw_map(values, GRID, extent=extent, label="gate")
    mesh = ax.collections[0]
    shown = set(np.round(mesh.get_array().ravel().astype(float), 2))
    centers = GRID.bin_centers_ego()
    inside = ((centers >= extent[::2]) & (centers <= extent[1::2])).all(-1)
    assert set(np.round(values[inside], 2)) <= shown
    assert len(shown) < values.size
    with pytest.raises(UserError, match=r"\(64, 56\).*\(60, 54\)"):
        draw.draw_map(np.zeros((64, 56)), GRID)


# Slices -------------------------------------------------------------------------------

SMALL = RadarGrid.reduced(num_doppler=4, num_range=6, num_elevation=3, num_azimuth=5)
# The digits of a value are its place: range, azimuth, channel.
PROJECTION = np.einsum("irac,i->rac", np.indices((6, 5, 7)), [0.1, 0.01, 0.001])
SLICED = Scene(PROJECTION.astype(np.float32), SMALL)


def planes(figure):
    return [ax.findobj(QuadMesh)[0].get_array() for ax in figure.axes[:3]]


def test_slices_are_the_named_bins():
    figure = draw.draw_slices(SLICED, range_idx=2)
    power, doppler, elevation = planes(figure)
    np.testing.assert_allclose(power[2, 3], 0.236, atol=1e-6)
    assert (doppler.shape, elevation.shape) == ((6, 4), (3, 5))
    np.testing.assert_allclose(doppler[5, 2], 0.542, atol=1e-6)
    np.testing.assert_allclose(elevation[0, 4], 0.244, atol=1e-6)
    _, _, elevation = planes(draw.draw_slices(SLICED))
    np.testing.assert_allclose(elevation[0, 4], 0.544, atol=1e-6)
    assert figure.axes[1].get_xlabel() == "Doppler (aliased) [m/s]"
    assert "at 47.2 m" in figure.axes[2].get_title()


def test_boxes_are_outlined_in_all_slices():
    box = np.array([[20.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]])
    truth = Boxes.one_frame(box, ["Sedan"])
    figure = draw.draw_slices(dataclasses.replace(SLICED, ground_truth=truth))
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


def test_there_is_no_slice_of_an_absent_axis():
    grid = small.uneven_grid()
    truth = Boxes.one_frame([10.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0], ["Sedan"])
    values = np.random.default_rng(0).uniform(size=grid.projection_shape)
    figure = draw.draw_slices(Scene(values, grid, ground_truth=truth))
    titles = [ax.get_title().split(",")[0] for ax in figure.axes if ax.get_title()]
    assert titles == ["Range–azimuth", "Range–Doppler (aliased)"]
    flat = small.uneven_grid(elevation_rad=np.array([0.1]), doppler_mps=np.array([]))
    flat_scene = Scene(values[..., :1], flat, ground_truth=truth)
    power, elevation = planes(draw.draw_slices(flat_scene))[:2]
    assert (power.shape, elevation.shape) == ((16, 14), (1, 14))
