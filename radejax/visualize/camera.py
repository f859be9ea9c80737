"""Drawing of boxes on the camera image.

Boxes are in the radar frame, in which models are trained and evaluated, and are projected
to pixels with the calibration. The sensor offset must be added to boxes of label files
(LiDAR frame) first; otherwise they are drawn next to their objects.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import ArrayLike

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.boxes import corners
from radejax.geometry.camera import CameraCalibration
from radejax.visualize import style

_FRONT = [0, 3, 7, 4]  # front face in geometry.boxes.corners
_MIN_LABEL_HEIGHT_PT = 12.0  # height of a box in the figure
_NEAR_M = 0.5


def draw_camera(
    image: ArrayLike,
    calibration: CameraCalibration,
    *,
    ground_truth: Boxes | None = None,
    predictions: Boxes | None = None,
    ax: Axes | None = None,
    show_labels: bool = True,
    title: str = "",
    matches: style.Matches | None = None,
) -> Axes:
    """Draws the edges and the tinted front faces of 3D boxes on an image.

    Args:
        image: `[H, W, 3]` uint8, or float in [0, 1], with the size of the calibration.
        calibration: Calibration of the camera, with the offset from LiDAR to radar.
        ground_truth: Boxes in the radar frame, or None.
        predictions: Boxes with scores in the radar frame, or None.
        ax: Axes to draw on; a new figure by default.
        show_labels: Whether to write class and score at the boxes.
        title: Title of the axes.
        matches: Matches of ground truth and predictions, or None.

    Returns:
        The axes, in pixels of the image.

    Raises:
        UserError: The image does not have the size of the calibration.
    """
    image = np.asarray(image)
    expected = (calibration.height, calibration.width, 3)
    if image.shape != expected:
        raise UserError(
            f"image has shape {image.shape}, the calibration is for {expected}; use "
            "the left half of K-Radar's stereo pairs (radejax.data.cameras."
            "read_left_image) and CameraCalibration.resized for a resized image"
        )
    focal_x, focal_y = np.asarray(calibration.intrinsics)[:2]
    aspect = float(focal_x / focal_y)  # undoes a non-uniform resize
    if ax is None:
        width = 9.0
        height = width * aspect * calibration.height / calibration.width
        total = height + (0.35 if title else 0.0)
        ax = style.new_figure(width, total).add_axes((0, 0, 1, height / total))
    ax.imshow(image, interpolation="bilinear", aspect=aspect)
    ax.set_axis_off()
    # Pixel centers are integers in imshow and half-integers in the calibration.
    ax.set(xlim=(-0.5, calibration.width - 0.5), ylim=(calibration.height - 0.5, -0.5))
    ax.apply_aspect()
    labels = []
    for look, boxes in style.styled_sets(ground_truth, predictions, matches):
        labels += _draw_boxes(ax, calibration, boxes, look)
    if show_labels:  # near boxes first
        labels.sort(key=lambda label: -np.ptp(label.outline[:, 1]))
        style.draw_labels(ax, labels, 6.5)
    ax.set_title(title)
    return ax


def _draw_boxes(
    ax: Axes, calibration: CameraCalibration, boxes: Boxes, look: style.Style
) -> list[style.Label]:
    """Draws the boxes in front of the camera; returns labels of boxes that are large enough."""
    segments, is_visible = calibration.project_boxes(boxes.box, near_m=_NEAR_M)
    segments = segments - 0.5
    # The renderer does not clip lines correctly that end far outside the image.
    limit = 20 * calibration.width
    is_visible = is_visible & (np.abs(segments) < limit).all((-1, -2))
    points, depth = calibration.project_ego(corners(boxes.box))
    drawn = np.flatnonzero(is_visible.any(1))
    fronts = [
        points[i, _FRONT] - 0.5 for i in drawn if (depth[i, _FRONT] > _NEAR_M).all()
    ]
    tint = PolyCollection(fronts, facecolors=look.color, alpha=0.25, lw=0, zorder=3)
    ax.add_collection(tint, autolim=False)
    hulls = [segments[i][is_visible[i]].reshape(-1, 2) for i in drawn]
    widths = np.repeat(style.line_scales(ax, hulls, 18.0), is_visible[drawn].sum(1))
    lines = [line for i in drawn for line in segments[i][is_visible[i]]]
    style.draw_lines(ax, lines, look.color, 0.9 * look.width * widths)
    texts = style.label_texts(boxes)
    side = "above" if boxes.score is None else "below"
    labels = []
    for i, hull in zip(drawn, hulls, strict=True):
        height_px = np.ptp(ax.transData.transform(hull)[:, 1])
        if look.side and height_px * 72 / ax.figure.dpi >= _MIN_LABEL_HEIGHT_PT:
            labels.append(style.Label(hull, texts[i], look.color, side))
    return labels
