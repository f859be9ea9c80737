import json

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.camera import CameraCalibration
from radejax.visualize import camera

from .. import small_models as small

# Looks along +x from the ego origin: u = 64 - 100 y / x, v = 36 - 100 z / x.
INTRINSICS = (100.0, 100.0, 64.0, 36.0)
CALIBRATION = small.forward_camera(intrinsics=INTRINSICS, width=128, height=72)
IMAGE = np.zeros((72, 128, 3), np.uint8)
BOX = [12.0, 1.0, 0.0, 4.0, 2.0, 1.0, 0.0]
BEHIND = [-12.0, *BOX[1:]]
FAR = [60.0, *BOX[1:]]  # 2 of 72 pixels high


def segments_of(ax):
    lines = [c for c in ax.collections if hasattr(c, "get_segments")]
    return np.array(lines[-1].get_segments())


def test_boxes_are_drawn_on_their_pixels():
    truth = Boxes.one_frame([FAR, BOX, BEHIND], ["Sedan", "Bicycle", "Sedan"])
    found = Boxes.one_frame([[*BOX[:6], np.pi]], ["Bus or Truck"], [0.5])
    ax = camera.draw_camera(IMAGE, CALIBRATION, ground_truth=truth, predictions=found)
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
    # Far boxes get no label, and boxes behind the camera are not drawn.
    texts = {text.get_text() for text in ax.texts}
    assert texts == {"Bicycle", "Bus or Truck 0.50"}
    segments = segments_of(ax)
    assert segments.shape == (12, 2, 2)
    # The rear face, at 10 m, spans y 0..2 and z +-0.5: 64..44 and 31..41.
    # Pixel centers are at half numbers; imshow puts them on whole ones.
    np.testing.assert_allclose(segments.reshape(-1, 2).max(0), [63.5, 40.5])
    np.testing.assert_allclose(segments.reshape(-1, 2).min(0), [43.5, 30.5])


@pytest.mark.parametrize(("yaw", "left"), [(0.0, 63.5 - 200 / 14), (np.pi, 43.5)])
def test_the_tinted_face_is_the_front(yaw, left):
    truth = Boxes.one_frame([*BOX[:6], yaw], ["Sedan"])
    ax = camera.draw_camera(IMAGE, CALIBRATION, ground_truth=truth)
    face = ax.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose(face[:, 0].min(), left)


def test_a_box_around_the_camera_is_cut_at_the_near_plane():
    truth = Boxes.one_frame([0.0, 0.0, 0.0, 20.0, 2.0, 1.0, 0.0], ["Sedan"])
    segments = segments_of(camera.draw_camera(IMAGE, CALIBRATION, ground_truth=truth))
    assert np.isfinite(segments).all()
    assert len(segments) == 8  # the far face and the four edges towards us


def test_stereo_pair_is_rejected_with_advice():
    with pytest.raises(UserError, match="read_left_image"):
        camera.draw_camera(np.zeros((72, 256, 3), np.uint8), CALIBRATION)


def test_real_frame(shared):
    """The van of sequence 11 is drawn in the left third of the image."""
    folder = shared / "data/kradar"
    check = json.loads((folder / "frame_example/projection_check.json").read_text())
    calibration = CameraCalibration.from_kradar(folder / "calib/common/cam_front0.yml")
    van = next(o for o in check["front0"]["objects"] if o["id"] == 101)
    center = np.array(van["xyz_lidar"]) + calibration.radar_from_lidar_m
    truth = Boxes.one_frame([*center, 4.9, 1.9, 2.2, 0.0], ["Bus or Truck"])
    image = np.zeros((720, 1280, 3), np.uint8)
    ax = camera.draw_camera(image, calibration, ground_truth=truth)
    points = segments_of(ax).reshape(-1, 2)
    low, high = points.min(0), points.max(0)
    assert (low < van["uv_raw"]).all()
    assert (high > van["uv_raw"]).all()
    assert (high - low < 200).all()
