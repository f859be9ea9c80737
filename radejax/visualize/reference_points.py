"""Where the radar's queries look in the camera image, as in the DinoRADE paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from radejax.geometry.calibration import CameraCalibration, ImageKind

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINT_COLOR = "#d03b3b"
RADAR_COLOR = "#2a6fdb"


def draw_reference_points(
    ax: Axes,
    points: np.ndarray,
    is_valid: np.ndarray,
    calibration: CameraCalibration,
    *,
    image_kind: ImageKind = "raw",
    every: tuple[int, int, int] = (16, 2, 1),
) -> int:
    """Draws valid reference points and the radar's place onto axes with an image.

    Args:
        ax: Axes in pixels, e.g. from `radejax.visualize.camera.draw_camera`.
        points: `[R, A, E, 2]` (x, y) in 0..1 from edge to edge of the image, as in
            `radejax.models.lifting.ReferencePoints`, of one frame.
        is_valid: `[R, A, E]` bool, True for points that lie in the image.
        calibration: The camera they were computed with.
        image_kind: As they were computed with; for the radar's place.
        every: Draw each so many bins of range, azimuth and elevation.

    Returns:
        Number of points drawn.

    References:
        DinoRADE, figure 2: points red, radar blue.
    """
    step = tuple(slice(None, None, n) for n in every)
    size = (calibration.width, calibration.height)
    points = np.asarray(points)[step][np.asarray(is_valid)[step]] * size
    # Pixel centers are whole numbers in imshow, half numbers in the calibration.
    points = points - 0.5
    ax.scatter(*points.T, s=2.0, color=POINT_COLOR, linewidths=0, alpha=0.7, zorder=2)
    pixel, depth = calibration.project_ego(np.zeros(3), image_kind)
    if calibration.in_image(pixel, depth):
        ax.scatter(*(pixel - 0.5), s=40, color=RADAR_COLOR, edgecolor="white", zorder=4)
    return len(points)
