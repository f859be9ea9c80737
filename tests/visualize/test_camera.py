import json

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.camera import CameraCalibration
from radejax.visualize import camera

# Looks along +x from the ego origin: u = 64 - 100 y / x, v = 36 - 100 z / x.
CALIBRATION = CameraCalibration(
    intrinsics=np.array([100.0, 100.0, 64.0, 36.0]),
    distortion=np.zeros(5),
    rotation=np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    translation_m=np.zeros(3),
    width=128,
    height=72,
    radar_from_lidar_m=np.zeros(3),
)
IMAGE = np.zeros((72, 128, 3), np.uint8)
BOX = [12.0, 1.0, 0.0, 4.0, 2.0, 1.0, 0.0]


def drawn(box: list, names: tuple = ("Sedan",)):
    """Axes of ground truth on an image."""
    truth = Boxes.one_frame(box, names)
    return camera.draw_camera(IMAGE, CALIBRATION, ground_truth=truth)


def texts_of(ax) -> list[str]:
    return [text.get_text() for text in ax.texts]


def segments_of(ax) -> np.ndarray:
    lines = [c for c in ax.collections if hasattr(c, "get_segments")]
    return np.array(lines[-1].get_segments())


def test_edges_by_hand():
    ax = drawn(BOX)
    segments = segments_of(ax)
    assert segments.shape == (12, 2, 2)
    # The rear face, at 10 m, spans y 0..2 and z +-0.5: 64..44 and 31..41.
    # Pixel centers are at half numbers; imshow puts them on whole ones.
    np.testing.assert_allclose(segments.reshape(-1, 2).max(0), [63.5, 40.5])
    np.testing.assert_allclose(segments.reshape(-1, 2).min(0), [43.5, 30.5])
    assert texts_of(ax) == ["Sedan"]
    assert ax.get_ylim()[0] > ax.get_ylim()[1]


def test_squeezed_images_are_shown_undistorted():
    squeezed, image = CALIBRATION.resized(128, 18), np.zeros((18, 128, 3), np.uint8)
    sizes = []
    for given in ((IMAGE, CALIBRATION), (image, squeezed)):
        ax = camera.draw_camera(*given, title="frame")
        sizes.append([*ax.figure.get_size_inches(), *ax.get_window_extent().size])
    np.testing.assert_allclose(*sizes, rtol=1e-6)


def test_tinted_face_is_the_front():
    ax = drawn(BOX)
    face = ax.collections[0].get_paths()[0].vertices
    # The front, at 14 m: 64 - 100 * 2 / 14 .. 64.
    np.testing.assert_allclose(face[:, 0].min(), 64 - 200 / 14 - 0.5)
    turned = [*BOX[:6], np.pi]
    ax = drawn(turned)
    face = ax.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose(face[:, 0].min(), 43.5)


def test_boxes_behind_the_camera_are_not_drawn():
    behind = [-12.0, *BOX[1:]]
    ax = drawn(behind)
    assert not segments_of(ax).size
    assert not ax.texts


def test_box_around_the_camera_is_cut_at_the_near_plane():
    around = [0.0, 0.0, 0.0, 20.0, 2.0, 1.0, 0.0]
    ax = drawn(around)
    segments = segments_of(ax)
    assert np.isfinite(segments).all()
    assert len(segments) == 8  # the far face and the four edges towards us


def test_predictions_carry_scores():
    ax = camera.draw_camera(
        IMAGE, CALIBRATION, predictions=Boxes.one_frame(BOX, ["Bus or Truck"], [0.5])
    )
    assert texts_of(ax) == ["Bus or Truck 0.50"]


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
    box = [*center, 4.9, 1.9, 2.2, 0.0]
    image = np.zeros((720, 1280, 3), np.uint8)
    ax = camera.draw_camera(
        image, calibration, ground_truth=Boxes.one_frame(box, ["Bus or Truck"])
    )
    points = segments_of(ax).reshape(-1, 2)
    low, high = points.min(0), points.max(0)
    assert (low < van["uv_raw"]).all()
    assert (high > van["uv_raw"]).all()
    assert (high - low < 200).all()


def test_far_boxes_get_no_label():
    far = [60.0, 1.0, 0.0, 4.0, 2.0, 1.0, 0.0]  # 2 of 72 pixels high
    ax = drawn([far, BOX], ("Sedan", "Bicycle"))
    assert texts_of(ax) == ["Bicycle"]
    assert len(segments_of(ax)) == 24


def test_lidar_points_in_the_image_are_drawn():
    points_m = np.array([[10.0, 1.0, 0.5], [-10.0, 0, 0], [10.0, 90.0, 0]])
    ax = camera.draw_camera(IMAGE, CALIBRATION, lidar_m=points_m)
    (scatter,) = ax.collections
    # u = 64 - 100 / 10, v = 36 - 50 / 10; the others are behind the camera or beside it.
    np.testing.assert_allclose(scatter.get_offsets(), [[53.5, 30.5]])
