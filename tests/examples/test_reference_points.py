"""Reference points of the radar on an image."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from reference_points import draw_reference_points

from .. import small_models as small

matplotlib.use("agg")


def test_valid_points_and_the_radar_are_drawn_in_pixels():
    # The radar lies 2 m ahead of the camera and 1 m below its axis.
    calibration = small.forward_camera(radar_from_lidar_m=(-2.0, 0.0, 1.0))
    points = np.zeros((2, 2, 1, 2), np.float32)
    points[0, 0, 0] = 0.25, 0.5
    points[1, 1, 0] = 0.5, 0.75
    is_valid = np.array([[[True], [False]], [[False], [True]]])
    ax = Figure().add_subplot()
    args = (ax, points, is_valid, calibration, np.array([5.0, 9.0]))
    drawn = draw_reference_points(*args, every=(1, 1, 1))
    np.testing.assert_allclose(drawn.get_array(), [5.0, 9.0])
    dots, radar = ax.collections
    np.testing.assert_allclose(dots.get_offsets(), [[24.5, 39.5], [49.5, 59.5]])
    np.testing.assert_allclose(radar.get_offsets(), [[49.5, 40 + 25 - 0.5]])
    # Every second range bin: only the first point.
    drawn = draw_reference_points(*args, every=(2, 1, 1))
    np.testing.assert_allclose(drawn.get_array(), [5.0])
