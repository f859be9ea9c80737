import sys
import threading

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import draw
from radejax.visualize.draw import draw_scenes
from radejax.visualize.style import COLOR_MAP, Scene, footprints, save_figure

GRID = RadarGrid.reduced(num_doppler=4, num_range=60, num_elevation=3, num_azimuth=54)
ROI = (0.0, 72.0, -16.0, 16.0, -2.0, 7.6)


def blob_at(range_idx: int, azimuth_idx: int) -> np.ndarray:
    projection = np.full(GRID.projection_shape, 0.2, np.float32)
    projection[range_idx, azimuth_idx, 2] = 0.6
    return projection


def pixels_of(figure) -> np.ndarray:
    """`[H, W, 3]`, row 0 at the bottom as in display coordinates."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(int)


def brightest_tile(figure, ax) -> np.ndarray:
    """Center, in display coordinates, of the pixels in the strongest color."""
    image = pixels_of(figure)
    frame = np.round(ax.get_window_extent().extents).astype(int)
    inside = image[frame[1] : frame[3], frame[0] : frame[2]]
    color = np.round(255 * np.array(COLOR_MAP(1.0)[:3])).astype(int)
    rows, columns = np.nonzero((np.abs(inside - color) <= 2).all(-1))
    assert rows.size > 10
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]) + frame[:2]


@pytest.mark.parametrize(("range_idx", "azimuth_idx"), [(20, 5), (30, 27), (33, 44)])
def test_box_is_drawn_on_its_echo(range_idx, azimuth_idx):
    scene = Scene(blob_at(range_idx, azimuth_idx), GRID)
    x, y = GRID.bin_to_ego(range_idx, azimuth_idx)
    _, polar = draw.draw_frame(scene).axes
    ax = draw.draw_bev(scene)
    outline = draw.to_polar(np.array([x, y]))
    # At 5 pixels a meter a bin is 10 pixels deep; its center is hit to one pixel.
    for axes, point in ((ax, (y, x)), (polar, outline)):
        tile = brightest_tile(axes.figure, axes)
        np.testing.assert_allclose(tile, axes.transData.transform(point), atol=1.0)


def test_left_is_left_and_ahead_is_up():
    ax = draw.draw_bev(Scene(blob_at(3, 3), GRID, roi=ROI))
    to_display = ax.transData.transform
    left, right = to_display((5.0, 20.0)), to_display((-5.0, 20.0))
    assert left[0] < right[0]
    assert to_display((0.0, 30.0))[1] > to_display((0.0, 10.0))[1]
    assert ax.get_aspect() == 1.0
    assert "[m]" in ax.get_xlabel()
    assert "[m]" in ax.get_ylabel()


def test_boxes_are_drawn_where_they_are():
    truth = Boxes.one_frame([10.0, 3.0, 0.0, 4.0, 2.0, 1.5, np.pi / 2], ["Sedan"])
    found = Boxes.one_frame([20.0, -3.0, 0, 4, 2, 1.5, 0], ["Bus or Truck"], [0.875])
    boxes = {"ground_truth": truth, "predictions": found, "score_threshold": 0.3}
    ax = draw.draw_bev(Scene(blob_at(3, 3), GRID, roi=ROI, **boxes))
    boxes = [c for c in ax.collections if hasattr(c, "get_segments")]
    boxes = boxes[1::2]  # each over its rim
    first, second = (c.get_segments()[0] for c in boxes)
    # Turned by 90 degrees: 4 m along y, 2 m along x. Axes hold (y, x).
    assert first.min(0) == pytest.approx([1.0, 9.0])
    assert first.max(0) == pytest.approx([5.0, 11.0])
    assert second.min(0) == pytest.approx([-4.0, 18.0])
    assert second.max(0) == pytest.approx([-2.0, 22.0])
    # Heading marks leave through the front: +y (left) and +x (up).
    assert boxes[0].get_segments()[1][:, 0] == pytest.approx([5.0, 6.4])
    assert boxes[1].get_segments()[1][:, 1] == pytest.approx([22.0, 23.4])
    texts = {t.get_text() for t in ax.texts}
    assert texts == {"Sedan", "Bus or Truck 0.88"}
    legend = [t.get_text() for t in ax.get_legend().get_texts()]
    found = "prediction (1), score ≥ 0.3"
    assert legend == ["ground truth (1)", found, "wide region"]


def test_roi_is_a_dashed_rectangle():
    ax = draw.draw_bev(Scene(blob_at(3, 3), GRID, roi=ROI))
    line = next(line for line in ax.lines if line.is_dashed())
    y, x = line.get_data()
    assert (min(x), max(x), min(y), max(y)) == pytest.approx(ROI[:4])


def test_color_bar_names_unit_and_reduction():
    ax = draw.draw_bev(Scene(blob_at(3, 3), GRID))
    labels = [a.get_ylabel() for a in [*ax.figure.axes, *ax.child_axes]]
    assert draw.POWER_LABEL in labels


def test_frame_has_radar_camera_and_polar_view():
    scene = Scene(
        blob_at(20, 20),
        GRID,
        predictions=Boxes.one_frame([], [], []),
        image=np.zeros((72, 128, 3), np.uint8),
        title="sequence 1",
    )
    figure = draw.draw_frame(scene)
    assert len(figure.axes) == 3
    assert figure.get_suptitle() == "sequence 1"
    assert any(ax.images for ax in figure.axes)
    assert len(draw.draw_frame(Scene(blob_at(20, 20), GRID)).axes) == 2


def test_padded_maps_need_the_padded_grid():
    values = np.zeros((64, 56))
    with pytest.raises(UserError, match=r"\(64, 56\).*\(60, 54\)"):
        draw.draw_map(values, GRID)
    draw.draw_map(values, GRID.padded(8), color_limits=(0, 1), label="gate")


def test_drawing_leaves_pyplot_alone_and_works_in_threads(tmp_path):
    errors = []

    def draw_one(i):
        try:
            figure = draw.draw_frame(Scene(blob_at(20, 20), GRID, roi=ROI))
            save_figure(figure, tmp_path / f"{i}.png")
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=draw_one, args=(i,)) for i in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert len(list(tmp_path.iterdir())) == 3
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()


def test_map_shows_every_bin_of_a_partial_extent():
    """Bins that are omitted for speed must lie outside the axes."""
    extent = (30.0, 60.0, -20.0, 5.0)
    values = np.arange(60.0)[:, None] + np.arange(54.0)[None] / 100
    ax = draw.draw_map(values, GRID, extent=extent)
    mesh = ax.collections[0]
    shown = set(np.round(mesh.get_array().ravel().astype(float), 2))
    centers = GRID.bin_centers_ego()
    inside = ((centers >= extent[::2]) & (centers <= extent[1::2])).all(-1)
    assert set(np.round(values[inside], 2)) <= shown
    assert len(shown) < values.size


def test_footprint_of_a_turned_box():
    outline = footprints(np.array([[1.0, 2.0, 0.0, 4.0, 2.0, 1.0, np.pi / 2]]))[0]
    # Front left corner first: ahead is +y, left is -x.
    np.testing.assert_allclose(
        outline, [[0, 4], [0, 0], [2, 0], [2, 4], [0, 4]], atol=1e-12
    )


def _scene(level: float, **fields) -> Scene:
    projection = np.full(GRID.projection_shape, level, np.float32)
    projection[10, 5] = level + 0.1
    truth = Boxes.one_frame([30.0, 2.0, 0.5, 4.5, 2.0, 1.6, 0.2], ["Sedan"])
    return Scene(projection, GRID, ground_truth=truth, **fields)


def test_scenes_share_a_scale_and_have_an_image_above_a_map() -> None:
    image = np.full((90, 160, 3), 128, np.uint8)
    roi = (0, 50, -10, 10, -2, 6)
    scenes = [
        _scene(0.2, title="fog", image=image, roi=roi),
        _scene(0.6, title="rain", roi=roi),
    ]
    figure = draw_scenes(scenes)
    titles = [ax.get_title() for ax in figure.axes]
    assert [title for title in titles if title] == ["fog", "rain"]
    assert len(figure.axes) == 4  # image and map, map, color bar
    assert "power" in figure.axes[-1].get_xlabel()
    maps = [mesh for ax in figure.axes[1:3] for mesh in ax.findobj(QuadMesh)]
    assert len({mesh.get_clim() for mesh in maps}) == 1 < len(maps)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["ground truth", "region of interest"]


def test_one_strong_echo_does_not_darken_the_maps() -> None:
    scene = _scene(0.2)
    scene.projection[..., :] += np.linspace(0, 0.2, 54)[None, :, None]
    scene.projection[3, 3] = 5.0
    figure = draw_scenes([scene])
    (mesh,) = figure.axes[0].findobj(QuadMesh)
    assert mesh.get_clim()[1] < 0.5


def test_a_comparison_shows_maps_on_one_scale_and_the_strongest_echo_of_each() -> None:
    first = np.random.default_rng(0).normal(100.0, 0.2, GRID.projection_shape[:2])
    second = first + 3.0
    second[40, 20] = 130.0
    figure = draw.draw_comparison({"recorded": first, "simulated": second}, GRID)
    maps = [ax for ax in figure.axes if ax.get_title() in ("recorded", "simulated")]
    scales = {ax.collections[0].get_clim() for ax in maps}
    assert len(maps) == 2
    assert len(scales) == 1
    profile, beams = (
        ax for ax in figure.axes if ax.get_xlabel().startswith(("range", "azimuth"))
    )
    low, high = (np.median(line.get_ydata()) for line in profile.lines)
    assert high - low == pytest.approx(3.0)
    row = beams.lines[1].get_ydata()
    assert (row.argmax(), row.max()) == (20, 0.0)
