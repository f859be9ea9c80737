"""Conversions of the ROS 2 node, without ROS."""

import numpy as np
import pytest
import ros2_node

from radejax.data.points import Points

from .. import small_models as small


def test_boxes_have_the_yaw_as_a_quaternion():
    detector, projection = small.detector(), small.projections(1)
    detections = detector(projection)
    rows = list(ros2_node.box_fields(detections, 0.7))
    assert len(rows) == int(detections.is_valid.sum()) > 0
    for row, (position, quaternion, size, cls, score) in enumerate(rows):
        box = np.asarray(detections.boxes[0, row])
        raised = [*position[:2], position[2] - 0.7]
        np.testing.assert_allclose([*raised, *size], box[:6], rtol=1e-6, atol=1e-6)
        x, y, z, w = quaternion
        assert (x, y) == (0.0, 0.0)
        assert z * z + w * w == pytest.approx(1.0)
        assert np.sin(2 * np.arctan2(z, w) - box[6]) == pytest.approx(0.0, abs=1e-6)
        assert cls == detector.classes[int(detections.classes[0, row])]
        assert score == pytest.approx(float(detections.scores[0, row]))


def test_points_are_float32_one_after_the_other():
    columns = np.arange(10.0).reshape(5, 2)
    names, data = ros2_node.point_bytes(Points(*columns, *np.zeros((3, 2), int)))
    assert len(data) == 2 * 4 * len(names)
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(2, 5), columns.T)
