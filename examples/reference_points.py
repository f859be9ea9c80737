"""Draws the reference points of the radar queries and the labeled boxes on a camera image.

    python examples/reference_points.py cam-front_00001.png cam_front0.yml \\
        --label 00033_00001.txt --out reference_points.png

Repeats DinoRADE's Figure 2 for one image. The color of the reference points of every 16th range bin
and every second azimuth bin is their range, boxes of the label file are white, and the position of
the radar is blue if it is in view.
"""

import pathlib

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from radejax.cli import entry
from radejax.core.errors import DataError
from radejax.core.structures import Boxes
from radejax.data.cameras import read_left_image
from radejax.data.kradar import read_labels
from radejax.geometry.camera import RADAR_FROM_LIDAR_M, CameraCalibration
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.lifting import reference_points
from radejax.models.options import DinoRadeOptions
from radejax.visualize.camera import draw_camera
from radejax.visualize.style import new_figure, save_figure

RADAR_COLOR = "#2a6fdb"


def draw_reference_points(
    ax: Axes,
    points: np.ndarray,
    is_valid: np.ndarray,
    calibration: CameraCalibration,
    range_m: np.ndarray,
    *,
    every: tuple[int, int, int] = (16, 2, 1),
) -> PathCollection:
    """Draws valid reference points and the radar's position onto the axes of an image.

    Args:
        ax: Axes in pixels, for example from `radejax.visualize.camera.draw_camera`.
        points: `[R, A, E, 2]` (x, y) of one frame from 0 to 1 between the edges of the image,
            as in `radejax.models.lifting.ReferencePoints`.
        is_valid: `[R, A, E]` bool, True for points in the image.
        calibration: Calibration that the points were computed with.
        range_m: `[R]` range of the bins in meters, which colors the points.
        every: Steps in range, azimuth and elevation bins.

    Returns:
        The points that are drawn, for a color bar.

    References:
        DinoRADE, figure 2.
    """
    step = tuple(slice(None, None, n) for n in every)
    size = (calibration.width, calibration.height)
    is_shown = np.asarray(is_valid)[step]
    range_m = np.broadcast_to(
        np.asarray(range_m)[:: every[0], None, None], is_shown.shape
    )
    points = np.asarray(points)[step][is_shown] * size
    # Pixel centers are integers in imshow and half-integers in the calibration.
    points = points - 0.5
    options = {"s": 5.0, "cmap": "plasma", "linewidths": 0, "zorder": 2}
    drawn = ax.scatter(*points.T, c=range_m[is_shown], **options)
    pixel, depth = calibration.project_ego(np.zeros(3))
    if calibration.in_image(pixel, depth):
        ax.scatter(*(pixel - 0.5), s=40, color=RADAR_COLOR, edgecolor="white", zorder=4)
    return drawn


def draw(
    pixels: np.ndarray, camera: CameraCalibration, ground_truth: Boxes | None = None
) -> tuple[Figure, float, int]:
    """Draws an image with the reference points of K-Radar's grid and the boxes of labels.

    Returns:
        The figure, the fraction of the queries in view and the number of points drawn.
    """
    grid, model = RadarGrid.kradar(), DinoRadeOptions()
    shape = grid.num_range, grid.num_azimuth, model.fusion.num_elevation
    reference = reference_points(camera.camera(), model.query_grid, *shape)
    figure = new_figure(10.0, 5.4)
    ax = figure.add_axes((0.005, 0.0, 0.9, 0.94))
    draw_camera(pixels, camera, ground_truth=ground_truth, ax=ax)
    is_valid = reference.is_valid[0]
    drawn = draw_reference_points(
        ax, reference.points[0], is_valid, camera, grid.range_m
    )
    ax.set_title("reference points of the queries, and labels", fontsize=11)
    cax = ax.inset_axes((1.015, 0.0, 0.02, 1.0))
    figure.colorbar(drawn, cax=cax, label="range of the query [m]")
    return figure, float(np.mean(is_valid)), len(drawn.get_offsets())


def read_boxes(path: pathlib.Path, version: str) -> Boxes:
    """Returns the boxes of a label file in the radar frame."""
    try:
        labels = read_labels(path, version)
    except DataError as error:
        hint = "labels of another version need --version, such as v1.0"
        raise DataError(f"{error}; {hint}") from None
    shift = np.array([*RADAR_FROM_LIDAR_M, 0, 0, 0, 0])
    boxes = np.array([x.box for x in labels]).reshape(-1, 7) + shift
    return Boxes.one_frame(boxes, [x.cls for x in labels])


FILE = click.Path(exists=True, path_type=pathlib.Path)


@click.command()
@click.argument("image", type=FILE)
@click.argument("calibration", type=FILE)
@click.option("--label", type=FILE, help="Label file of the frame.")
@click.option(
    "--version", default="v2.1", show_default=True, help="Version of the label file."
)
@click.option("--out", default="reference_points.png", show_default=True)
def main(image, calibration, label, version, out):
    """Draw reference points and boxes on IMAGE with the camera of CALIBRATION."""
    with entry.exit_codes():
        ground_truth = None if label is None else read_boxes(label, version)
        camera = CameraCalibration.from_kradar(calibration)
        pixels = read_left_image(image, (camera.height, camera.width))
        figure, inside, count = draw(pixels, camera, ground_truth)
        save_figure(figure, out)
        click.echo(f"{inside:.1%} of the queries are in view; drew {count} in {out}")


if __name__ == "__main__":
    main()
