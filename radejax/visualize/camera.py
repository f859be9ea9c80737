"""Boxes on the camera image.

Boxes come in the ego frame, in which models are trained and scored; the calibration
takes them to pixels. Whoever has boxes as the label files hold them (LiDAR frame) adds
the sensor offset first: the usual reason for boxes drawn beside their cars.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from radejax.core.errors import UserError
from radejax.geometry.boxes import corners
from radejax.geometry.camera import CameraCalibration, ImageKind
from radejax.visualize.canvas import (
    Objects,
    Style,
    label_texts,
    new_figure,
    styled_sets,
)
from radejax.visualize.label_placement import Label, draw_labels

_FRONT = [0, 3, 7, 4]  # of geometry.boxes.corners
_FONT_SIZE_PT = 6.5
_LEAST_HEIGHT_PT = 12.0  # on paper, of a box that gets a label
_NEAR_M = 0.5


def draw_camera(
    image: Any,
    calibration: CameraCalibration,
    *,
    ground_truth: Any = None,
    predictions: Any = None,
    class_names: Sequence[str] | None = None,
    image_kind: ImageKind = "raw",
    ax: Axes | None = None,
    show_labels: bool = True,
    title: str | None = None,
) -> Axes:
    """Draws 3D boxes on an image: edges, and the front face tinted.

    Args:
        image: `[H, W, 3]` uint8, or float in [0, 1]; of the calibration's size.
        calibration: The camera, with its ego-from-LiDAR offset.
        ground_truth: Boxes with classes in the ego frame; see `canvas.as_objects`.
        predictions: Boxes with scores and classes in the ego frame.
        class_names: Names of class indices; see `canvas.as_objects`.
        image_kind: "raw" as recorded, or how the image was undistorted.
        ax: Where to draw; a new figure by default.
        show_labels: Write class and score at the boxes.
        title: Title of the axes.

    Returns:
        The axes, in pixels of the image.

    Raises:
        UserError: Image and calibration differ in size, or boxes are malformed.
    """
    image = np.asarray(image)
    expected = (calibration.height, calibration.width, 3)
    if image.shape != expected:
        raise UserError(
            f"image has shape {image.shape}, the calibration is for {expected}; "
            "K-Radar's front images are stereo pairs of which the left half is meant "
            "(radejax.data.images.read_left_image), and CameraCalibration.resized "
            "follows a resized image"
        )
    aspect = _pixel_aspect(calibration)
    if ax is None:
        width = 9.0
        height = width * aspect * calibration.height / calibration.width
        total = height + (0.35 if title else 0.0)
        ax = new_figure(width, total).add_axes((0, 0, 1, height / total))
    ax.imshow(image, interpolation="bilinear", aspect=aspect)
    ax.set_axis_off()
    # Pixel centers are whole numbers in imshow, half numbers in the calibration.
    ax.set(xlim=(-0.5, calibration.width - 0.5), ylim=(calibration.height - 0.5, -0.5))
    ax.apply_aspect()
    labels = []
    for style, objects in styled_sets(ground_truth, predictions, class_names):
        if len(objects.boxes):
            hulls = _draw_boxes(ax, calibration, objects, image_kind, style)
            texts = label_texts(objects)
            labels += [
                Label(hull, texts[i], style.text_color, "above")
                for i, hull in hulls.items()
            ]
    # Near boxes first. Far ones stand close together: texts on them would be a heap.
    scale = _points_per_pixel(ax, calibration)
    labels.sort(key=lambda label: -np.ptp(label.outline[:, 1]))
    labels = [
        label
        for label in labels
        if np.ptp(label.outline[:, 1]) * scale >= _LEAST_HEIGHT_PT
    ]
    if show_labels:
        draw_labels(ax, labels, font_size=_FONT_SIZE_PT, keep_boxes_clear=False)
    if title:
        ax.set_title(title)
    return ax


def _draw_boxes(
    ax: Axes,
    calibration: CameraCalibration,
    objects: Objects,
    kind: ImageKind,
    style: Style,
) -> dict[int, Float[np.ndarray, "_ 2"]]:
    """Draws what is in front of the camera; points by index of the box."""
    segments, is_visible = calibration.project_boxes(objects.boxes, kind, _NEAR_M)
    segments = segments - 0.5
    # Wild pixels far outside the image confuse the renderer's clipping.
    limit = 20 * calibration.width
    is_visible = is_visible & (np.abs(segments) < limit).all((-1, -2))
    points, depth = calibration.project_ego(corners(objects.boxes), kind)
    drawn = [i for i in range(len(objects.boxes)) if is_visible[i].any()]
    fronts = [
        points[i, _FRONT] - 0.5 for i in drawn if (depth[i, _FRONT] > _NEAR_M).all()
    ]
    ax.add_collection(
        PolyCollection(
            fronts, facecolors=style.color, alpha=0.25, linewidths=0, zorder=3
        ),
        autolim=False,
    )
    hulls = [segments[i][is_visible[i]].reshape(-1, 2) for i in drawn]
    lines = [line for i in drawn for line in segments[i][is_visible[i]]]
    heights = [np.repeat(np.ptp(hull[:, 1]), len(hull) // 2) for hull in hulls]
    # Lines of a small box are thinner, or they would fill it.
    height_px = np.concatenate([*heights, np.zeros(0)])
    thickness = np.clip(height_px * _points_per_pixel(ax, calibration) / 24.0, 0.4, 1.0)
    for stroke, extra, order in (("black", 1.0, 4), (style.color, 0.0, 4.1)):
        collection = LineCollection(
            lines,
            colors=stroke,
            linewidths=(style.image_width + extra) * thickness,
            capstyle="round",
            zorder=order,
        )
        ax.add_collection(collection, autolim=False)
    return dict(zip(drawn, hulls, strict=True))


def _points_per_pixel(ax: Axes, calibration: CameraCalibration) -> float:
    """Points on paper of a pixel's height."""
    width = ax.get_window_extent().width / calibration.width * 72 / ax.figure.dpi
    return width * _pixel_aspect(calibration)


def _pixel_aspect(calibration: CameraCalibration) -> float:
    """Height over width of a pixel drawn so that squeezed images look natural."""
    focal_x, focal_y = np.asarray(calibration.intrinsics)[:2]
    return float(focal_x / focal_y)
