"""Draws the reference points of the radar queries and the labeled boxes on a camera image.

    python examples/reference_points.py cam-front_00001.png cam_front0.yml \\
        --label 00033_00001.txt --out reference_points.png

Repeats DinoRADE's Figure 2 for one image. Reference points of every 16th range bin and every second
azimuth bin are red, boxes of the label file are white, and the position of the radar is blue if it
is in view.
"""

import pathlib

import click
import numpy as np
from matplotlib.axes import Axes

from radejax.cli import entry
from radejax.core.structures import Boxes
from radejax.data.cameras import read_left_image
from radejax.data.kradar import read_labels
from radejax.geometry.camera import RADAR_FROM_LIDAR_M, CameraCalibration
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.lifting import reference_points
from radejax.models.options import DinoRadeOptions
from radejax.visualize.camera import draw_camera
from radejax.visualize.style import save_figure

POINT_COLOR = "#d03b3b"
RADAR_COLOR = "#2a6fdb"


def draw_reference_points(
    ax: Axes,
    points: np.ndarray,
    is_valid: np.ndarray,
    calibration: CameraCalibration,
    *,
    every: tuple[int, int, int] = (16, 2, 1),
) -> int:
    """Draws valid reference points and the radar's position onto the axes of an image.

    Args:
        ax: Axes in pixels, for example from `radejax.visualize.camera.draw_camera`.
        points: `[R, A, E, 2]` (x, y) of one frame from 0 to 1 between the edges of the image,
            as in `radejax.models.lifting.ReferencePoints`.
        is_valid: `[R, A, E]` bool, True for points in the image.
        calibration: Calibration that the points were computed with.
        every: Steps in range, azimuth and elevation bins.

    Returns:
        The number of points drawn.

    References:
        DinoRADE, figure 2.
    """
    step = tuple(slice(None, None, n) for n in every)
    size = (calibration.width, calibration.height)
    points = np.asarray(points)[step][np.asarray(is_valid)[step]] * size
    # Pixel centers are integers in imshow and half-integers in the calibration.
    points = points - 0.5
    ax.scatter(*points.T, s=2.0, color=POINT_COLOR, linewidths=0, alpha=0.7, zorder=2)
    pixel, depth = calibration.project_ego(np.zeros(3))
    if calibration.in_image(pixel, depth):
        ax.scatter(*(pixel - 0.5), s=40, color=RADAR_COLOR, edgecolor="white", zorder=4)
    return len(points)


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
        camera = CameraCalibration.from_kradar(calibration)
        pixels = read_left_image(image, (camera.height, camera.width))
        grid, model = RadarGrid.kradar(), DinoRadeOptions()
        shape = grid.num_range, grid.num_azimuth, model.fusion.num_elevation
        reference = reference_points(camera.camera(), model.query_grid, *shape)
        ground_truth = None
        if label is not None:
            labels = read_labels(label, version)
            shift = np.array([*RADAR_FROM_LIDAR_M, 0, 0, 0, 0])
            boxes = np.array([x.box for x in labels]).reshape(-1, 7) + shift
            ground_truth = Boxes.one_frame(boxes, [x.cls for x in labels])
        ax = draw_camera(pixels, camera, ground_truth=ground_truth)
        count = draw_reference_points(
            ax, reference.points[0], reference.is_valid[0], camera
        )
        save_figure(ax.figure, out)
        inside = float(np.mean(reference.is_valid))
        click.echo(f"{inside:.1%} of the queries are in view; drew {count} in {out}")


if __name__ == "__main__":
    main()
