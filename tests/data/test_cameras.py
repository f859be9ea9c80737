"""Tests of radejax.data.cameras."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import DataError, UserError
from radejax.data.cameras import IMAGE_SIZE, camera_inputs, front_view, read_left_image
from radejax.data.kradar import Frame
from radejax.data.options import CameraOptions
from radejax.geometry.camera import CameraCalibration, project
from radejax.simulation.camera.renderer import stereo_calibration
from radejax.simulation.config import FULL_SIZE, SimulationOptions

CALIBRATION = CameraCalibration.from_angles(
    intrinsics=(60.0, 58.0, 32.0, 16.0),
    distortion=(-0.03, 0.001, 0.0, 0.0, 0.0),
    yaw_deg=90,
    pitch_deg=0,
    roll_deg=90,
    translation_m=(0.2, -0.1, 0.0),
    width=64,
    height=32,
)


@dataclasses.dataclass
class _Frame:
    key: str
    camera_path: str | None
    camera_calibration_path: str | None
    radar_from_lidar_m: tuple = (-2.54, 0.3, 0.0)
    radar_from_lidar_z_m: float = 0.7

    read_calibration = Frame.read_calibration


def frame_cameras(frames, image_size, **options):
    options = CameraOptions(**{"allow_missing": False, **options})
    return camera_inputs(frames, image_size, options).cameras


@pytest.fixture
def frames(tmp_path):
    path = tmp_path / "cam_front0.yml"
    path.write_text(CALIBRATION.to_kradar_text())
    return [_Frame(f"1/{i}", "x.png", str(path)) for i in range(3)]


def test_cameras_project_as_their_calibration(frames):
    frames[1].radar_from_lidar_m = (1.0, 2.0, 0.0)
    frames[1].radar_from_lidar_z_m = 3.0
    cameras = frame_cameras(frames, (32, 64))
    for frame, camera in zip(frames, cameras, strict=True):
        shift = (*frame.radar_from_lidar_m[:2], frame.radar_from_lidar_z_m)
        wanted = dataclasses.replace(CALIBRATION, radar_from_lidar_m=shift).camera()
        np.testing.assert_allclose(camera.cam_from_ego, wanted.cam_from_ego)
        np.testing.assert_allclose(camera.distortion, wanted.distortion)
        assert camera.is_valid
    fixed = frame_cameras(frames, (32, 64), radar_from_lidar_m=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(fixed[0].cam_from_ego, cameras[1].cam_from_ego)


def test_a_calibration_for_images_of_twice_the_size_is_named(frames, monkeypatch):
    """By any reader, before its image is read."""
    double = dataclasses.replace(CALIBRATION, width=128, height=64)
    monkeypatch.setattr(_Frame, "read_calibration", lambda frame, shift=None: double)
    message = r"cam_front0\.yml: principal point 32, 16 in an image of 128 x 64 pix"
    with pytest.raises(DataError, match=message):
        front_view(frames[0])
    with pytest.raises(DataError, match=message):
        frame_cameras(frames, (32, 64))


def test_boxes_have_no_say_in_the_height_that_queries_start_at(frames):
    """How far too high they would look without it, in pixels of K-Radar's image."""
    calibration = stereo_calibration(SimulationOptions(**FULL_SIZE))[0]
    with open(frames[0].camera_calibration_path, "w") as file:
        file.write(calibration.to_kradar_text())
    ahead = np.array([[10.0, 0.0, 0.0], [20.0, 0.0, 0.0]])

    def rows(**options):
        camera = frame_cameras(frames[:1], (720, 1280), **options)[0]
        return project(ahead, camera)[0][:, 1]

    np.testing.assert_allclose(rows(), rows(radar_from_lidar_z_m=0.7))
    before = {"radar_from_lidar_z_m": 0.0}
    np.testing.assert_allclose(rows() - rows(**before), [32, 18], atol=1)
    frames[0].radar_from_lidar_z_m = 0.0
    np.testing.assert_allclose(rows(), rows(**before))


def test_another_size_is_an_error_or_resized(frames):
    with pytest.raises(UserError, match=r"calibration of 64 x 32 images.* 128 x 64"):
        frame_cameras(frames, (64, 128))
    camera = frame_cameras(frames, (64, 128), resize=True)[0]
    np.testing.assert_allclose(camera.intrinsics, 2 * CALIBRATION.intrinsics)
    assert camera.size_px.tolist() == [128, 64]


@pytest.mark.parametrize("field", ["camera_path", "camera_calibration_path"])
def test_missing_ones_are_an_error_or_counted(frames, field, caplog):
    setattr(frames[2], field, None)
    with pytest.raises(UserError, match=r"1 of 3 frames .* the first is 1/2"):
        frame_cameras(frames, (32, 64))
    cameras = frame_cameras(frames, (32, 64), allow_missing=True)
    assert [bool(c.is_valid) for c in cameras] == [True, True, False]
    assert "1 of 3 frames" in caplog.text
    assert np.isfinite(cameras[2].cam_from_ego).all()


def test_left_half_of_the_stereo_pair(tmp_path):
    height, width = IMAGE_SIZE
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (height, 2 * width, 3), np.uint8)
    path = tmp_path / "a.png"
    for shown in (pixels[:, :width], pixels):
        Image.fromarray(shown).save(path, compress_level=1)
        np.testing.assert_array_equal(read_left_image(path), pixels[:, :width])
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"no image"):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"a\.png: corrupted"):
            read_left_image(path)
    Image.fromarray(pixels[:50, :70]).save(path)
    with pytest.raises(DataError, match=r"a\.png: 70 x 50 pixels, expected 2560 x 720"):
        read_left_image(path)
    Image.new("L", (4, 4)).save(path)
    path.write_bytes(path.read_bytes()[:44])
    with pytest.raises(DataError, match=r"a\.png: corrupted"):
        read_left_image(path, resize=True)


def test_a_calibration_of_images_of_another_shape_is_named(tmp_path):
    path = tmp_path / "a.png"
    sizes = {"resize": True, "calibrated_size": (36, 64)}
    for width in (128, 256):  # one image, and a pair
        Image.new("RGB", (width, 72)).save(path)
        assert read_left_image(path, (18, 32), **sizes).shape == (18, 32, 3)
    Image.new("RGB", (96, 72)).save(path)
    with pytest.raises(DataError, match=r"96 x 72 pixels, .* is for 64 x 36, of"):
        read_left_image(path, (18, 32), **sizes)


@pytest.mark.parametrize("is_pair", [False, True])
def test_the_size_of_the_calibration_tells_pairs_from_wide_images(tmp_path, is_pair):
    lens = np.array([600.0, 600.0, 704.0, 188.0])
    wide = dataclasses.replace(CALIBRATION, intrinsics=lens, width=1408, height=376)
    (tmp_path / "cam.yml").write_text(wide.to_kradar_text())
    pixels = np.zeros((376, 1408 * (1 + is_pair), 3), np.uint8)
    pixels[:, :704] = 255  # half of a single image
    Image.fromarray(pixels).save(tmp_path / "a.png")
    frame = _Frame("1/0", tmp_path / "a.png", tmp_path / "cam.yml")
    inputs = camera_inputs([frame], (47, 176), CameraOptions(resize=True))
    assert inputs.image(0).mean(axis=(0, 2)).tolist() == [255.0] * 88 + [0.0] * 88
    assert inputs.cameras[0].size_px.tolist() == [176, 47]
