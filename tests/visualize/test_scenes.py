"""Scenes side by side: one colour scale, boxes in all, magnified views where asked."""

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.animate import render
from radejax.visualize.canvas import Scene
from radejax.visualize.scenes import ZOOM_COLOR, draw_scenes

GRID = RadarGrid.reduced(
    num_doppler=3, num_range=32, num_elevation=3, num_azimuth=24, max_range_m=60.0
)
BOX = np.array([[30.0, 2.0, 0.5, 4.5, 2.0, 1.6, 0.2]])


def _scene(level: float, **fields) -> Scene:
    projection = np.full(GRID.projection_shape, level, np.float32)
    projection[10, 5] = level + 0.1
    return Scene(projection, GRID, ground_truth=(BOX, ["Sedan"]), **fields)


def _has_color(pixels: np.ndarray, color: str) -> bool:
    rgb = np.round(255 * np.array(matplotlib.colors.to_rgb(color)))
    return bool((np.abs(pixels - rgb).max(-1) < 8).sum() > 50)


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
    assert len(figure.axes) == 4  # image and map, map, colour bar
    assert "power" in figure.axes[-1].get_xlabel()
    meshes = [
        m for ax in figure.axes for m in ax.collections if m.get_array() is not None
    ]
    assert len({mesh.get_clim() for mesh in meshes if mesh.get_array().size > 99}) == 1
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["ground truth", "region of interest"]
    assert not _has_color(render(figure).astype(int), ZOOM_COLOR)


def test_one_strong_echo_does_not_darken_the_maps() -> None:
    scene = _scene(0.2)
    scene.projection[..., :] += np.linspace(0, 0.2, 24)[None, :, None]
    scene.projection[3, 3] = 5.0
    figure = draw_scenes([scene])
    (mesh,) = [m for m in figure.axes[0].collections if isinstance(m, QuadMesh)]
    assert mesh.get_clim()[1] < 0.5


def test_a_magnified_view_is_framed_in_orange() -> None:
    figure = draw_scenes([_scene(0.2, zoom=(30.0, 2.0))])
    assert _has_color(render(figure).astype(int), ZOOM_COLOR)


def test_no_scenes() -> None:
    with pytest.raises(UserError, match="no scenes"):
        draw_scenes([])
