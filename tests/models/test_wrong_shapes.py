"""Arrays that do not fit together are named while a function is traced."""

import jax
import jax.numpy as jnp
import pytest

from radejax.detection.nms import match_boxes, rotated_nms
from radejax.geometry.camera import Camera, project
from radejax.geometry.radar_grid import RadarGrid
from radejax.geometry.rotated_iou import bev_iou
from radejax.losses.focal import focal_loss, gaussian_heatmap
from radejax.models.convolution import conv2d

pytestmark = pytest.mark.wrong_types

GRID = RadarGrid.reduced(num_doppler=2, num_range=8, num_elevation=2, num_azimuth=4)
CAMERA = Camera(
    cam_from_ego=jnp.zeros((2, 3, 4)),
    intrinsics=jnp.ones((2, 4)),
    distortion=jnp.zeros((2, 5)),
    max_radius=jnp.ones(2),
    size_px=jnp.ones((2, 2)),
    is_valid=jnp.ones(2, bool),
)


def zeros(*shape: int) -> jax.Array:
    return jnp.zeros(shape)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bev_iou(zeros(2, 5, 7), zeros(3, 5, 7)), r"\(2,\), \(3,\)"),
        (lambda: rotated_nms(zeros(4, 7), zeros(3) == 0, 0.3), r"\(4, 4\)"),
        (
            lambda: match_boxes(zeros(4, 7), zeros(4) == 0, zeros(2, 7), zeros(4) == 0),
            r"\(4,\) but expected \(2\)",
        ),
        (lambda: GRID.boxes_at(zeros(2, 3, 8), zeros(2, 4, 2)), r"\(2, 4, 8\)"),
        (lambda: focal_loss(zeros(2, 8, 4, 5), zeros(2, 8, 4, 1)), r"\(2, 8, 4, 1\)"),
        (
            lambda: gaussian_heatmap(
                zeros(3, 8), zeros(2), zeros(3) == 0, GRID, num_classes=2
            ),
            r"\(3,\), \(2,\)",
        ),
        (lambda: conv2d(zeros(1, 8, 8, 3), zeros(3, 3, 4, 2)), r"\(3, 3, 4, 2\)"),
        (lambda: project(zeros(3, 6, 3), CAMERA), r"\(3, 6, 3\)"),
    ],
)
def test_wrong_shapes_are_named(call, message):
    with pytest.raises(AssertionError, match=message):
        jax.eval_shape(call)
