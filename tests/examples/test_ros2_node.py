"""Conversions of the ROS 2 node, without ROS."""

import numpy as np
import ros2_node

from radejax.core.structures import Detections
from radejax.data.points import Points


def test_boxes_have_the_yaw_as_a_quaternion():
    boxes = np.array([[[9.0, 1, 0.5, 4, 2, 1, 2.5], [20, -3, 0, 1, 1, 2, -0.4]]])
    detections = Detections(
        boxes=boxes,
        scores=np.array([[0.9, 0.25]]),
        classes=np.array([[0, 2]]),
        is_valid=np.array([[True, True]]),
        num_truncated=np.zeros(1, int),
    )
    rows = list(ros2_node.box_fields(detections, 0.7))
    assert [row[3:] for row in rows] == [("Sedan", 0.9), ("Pedestrian", 0.25)]
    for box, (position, quaternion, size, _, _) in zip(boxes[0], rows, strict=True):
        shifted = box[:6] + np.array([0, 0, 0.7, 0, 0, 0])
        np.testing.assert_allclose([*position, *size], shifted)
        half = box[6] / 2
        np.testing.assert_allclose(quaternion, [0, 0, np.sin(half), np.cos(half)])


def test_points_are_float32_one_after_the_other():
    columns = np.arange(10.0).reshape(5, 2)
    names, data = ros2_node.point_bytes(Points(*columns, *np.zeros((3, 2), int)))
    assert len(data) == 2 * 4 * len(names)
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(2, 5), columns.T)
