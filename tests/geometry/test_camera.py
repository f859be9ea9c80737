"""Tests of radejax.geometry.camera."""

import json
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.geometry import camera as camera_lib
from radejax.geometry.camera import CameraCalibration

from ..small_models import forward_camera

# Of K-Radar's cameras.
DISTORTION = (-0.028873818, 0.0006023302, 0.0039573087, -0.0050471763, 0.0)


def of_lidar(camera, points):
    """Pixels and depths of points in the LiDAR's frame."""
    return camera.project_ego(points + camera.radar_from_lidar_m)


def test_a_camera_that_looks_ahead_by_hand():
    camera = forward_camera(radar_from_lidar_m=(-2.54, 0.3, 0.7))
    points = np.array([[10.0, 0, 0], [10, 2, 0], [10, 0, 3], [-5, 1, 1]])
    pixels, depth = of_lidar(camera, points)
    np.testing.assert_allclose(depth, [10, 10, 10, -5], atol=1e-12)
    # Left is towards smaller u, up towards smaller v.
    np.testing.assert_allclose(pixels[:3], [[50, 40], [40, 40], [50, 25]], atol=1e-12)
    assert camera.in_image(pixels, depth).tolist() == [True, True, True, False]
    resized, _ = of_lidar(camera.resized(25, 40), points)
    np.testing.assert_allclose(resized / [25, 40], pixels / [100, 80], atol=1e-12)
    borders = np.array([[0, 0], [-1e-9, 0], [99.999, 79.999], [100, 0], [0, 80]])
    inside = camera.in_image(borders, np.ones(5))
    assert inside.tolist() == [True, False, True, False, False]


def test_distortion_follows_the_brown_model():
    camera = forward_camera(distortion=(0.1, 0.02, 0.003, -0.004, 0.005))
    x, y = -0.3, -0.2  # y left 3 and z up 2 at depth 10
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 + 0.02 * r2**2 + 0.005 * r2**3
    u = x * radial + 2 * 0.003 * x * y - 0.004 * (r2 + 2 * x * x)
    v = y * radial + 0.003 * (r2 + 2 * y * y) + 2 * -0.004 * x * y
    point = np.array([10.0, 3, 2])
    pixel, _ = camera.project_ego(point)
    np.testing.assert_allclose(pixel, [50 * u + 50, 50 * v + 40], atol=1e-12)
    pixel, _ = camera.project_ego(point, "pinhole")
    np.testing.assert_allclose(pixel, [50 * x + 50, 50 * y + 40], atol=1e-12)


def test_points_past_the_fold_of_the_distortion_stay_outside():
    # r (1 - 0.2 r^2) turns back at r = 1.29 and would bring r = 2.2 back to 0.07.
    camera = forward_camera(distortion=(-0.2, 0, 0, 0, 0))
    pixel, depth = camera.project_ego(np.array([1.0, 2.2, 0]))
    assert not camera.in_image(pixel, depth)
    assert camera.camera().max_radius == pytest.approx(math.sqrt(1 / 0.6))
    # Coefficients next to nothing overflowed in the division by the first of them.
    for k1 in (0.0, 1e-320, 0.3):
        camera = forward_camera(distortion=(k1, 0, 0, 0, 0))
        assert camera.camera().max_radius == 1e6


def test_projection_of_a_real_frame(shared):
    folder = shared / "data" / "kradar"
    expected = json.loads((folder / "frame_example/projection_check.json").read_text())
    for name, case in expected.items():
        camera = CameraCalibration.from_kradar(folder / case["yml"])
        np.testing.assert_allclose(camera.rotation, case["R_ldr2cam"], atol=1e-9)
        behind = 0
        for thing in case["objects"]:
            lidar = np.array(thing["xyz_lidar"])
            pixels, depth = of_lidar(camera, lidar)
            np.testing.assert_allclose(depth, thing["xyz_cam"][2], atol=1e-8)
            if thing["uv_raw"] is None:
                behind += 1
                assert depth < 0
                continue
            np.testing.assert_allclose(pixels, thing["uv_raw"], atol=1e-6)
        assert behind == 1, name


def test_kradar_text_round_trip(tmp_path):
    angles = {"yaw_deg": 88.6, "pitch_deg": 0.6, "roll_deg": 89.6}
    fields = {"distortion": DISTORTION, "translation_m": (0.18, -0.13, 0.0)}
    camera = forward_camera(**fields, **angles)
    path = tmp_path / "cam_1.yml"
    path.write_text(camera.to_kradar_text())
    again = CameraCalibration.from_kradar(path)
    np.testing.assert_allclose(again.rotation, camera.rotation, atol=1e-15)
    for name in ("intrinsics", "distortion", "translation_m", "width", "height"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))


def test_box_edges_ahead_and_cut_at_the_near_plane():
    camera = forward_camera()
    ahead = np.array([10.0, 0, 0, 2, 4, 2, 0])
    around = np.array([0.0, 2, 0, 8, 1, 1, 0])  # reaches from 4 m behind to 4 m ahead
    behind = np.array([-10.0, 0, 0, 2, 4, 2, 0])
    edges, is_visible = camera.project_boxes(np.stack([ahead, around, behind]))
    chex.assert_shape(edges, (3, 12, 2, 2))
    assert is_visible[0].all()
    assert is_visible[1].sum() == 8  # all but the four edges of the rear face
    assert not is_visible[2].any()
    # The nearest face is at 9 m: half width 2 and half height 1 at focal length 50.
    ends, half = edges[0].reshape(-1, 2), np.array([100 / 9, 50 / 9])
    np.testing.assert_allclose(ends.min(0), np.array([50, 40]) - half)
    np.testing.assert_allclose(ends.max(0), np.array([50, 40]) + half)
    assert np.isfinite(edges).all()


@pytest.mark.parametrize("image", ["raw", "pinhole"])
def test_batches_of_cameras_under_jit(image):
    rng = np.random.default_rng(0)
    yaws = (88, 90, 93)
    calibrations = [forward_camera(yaw_deg=x, distortion=DISTORTION) for x in yaws]
    points = rng.uniform([5, -3, -2], [60, 3, 2], (3, 6, 3))
    batch = camera_lib.stack_cameras([c.camera(image) for c in calibrations])
    chex.assert_shape(batch.cam_from_ego, (3, 3, 4))
    pixels, depth = jax.jit(camera_lib.project)(jnp.asarray(points, jnp.float32), batch)
    for i, calibration in enumerate(calibrations):
        expected, expected_depth = calibration.project_ego(points[i], image)
        np.testing.assert_allclose(pixels[i], expected, atol=2e-4)
        np.testing.assert_allclose(depth[i], expected_depth, rtol=1e-6)


@pytest.mark.parametrize(
    ("key", "line", "message"),
    [
        ("fx", "fx= 1", r"1: expected 'key: number'"),
        ("k3", "", " camera calibration lacks k3"),
        ("img_size_w", "img_size_w: 0", " width is 0, expected 1 to 65536 pixels"),
        ("k1", "k1: nan", " k1 is nan, not a finite number"),
        ("k1", "k1: 1e308", r" k1 is 1e\+308"),
    ],
)
def test_calibration_files_that_cannot_be_used_are_named(tmp_path, key, line, message):
    path = tmp_path / "cam_1.yml"
    lines = forward_camera().to_kradar_text().splitlines()
    lines = [line if x.startswith(f"{key}:") else x for x in lines]
    path.write_text("\n".join(lines), errors="surrogateescape")
    with pytest.raises(DataError, match=rf"cam_1\.yml:{message}"):
        CameraCalibration.from_kradar(path)


def sideways(yaw_deg):
    forward_camera(yaw_deg=yaw_deg).require_view_ahead("cam.yml")


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: CameraCalibration.from_kradar("cam_9.yml"), "No such file.*cam_9"),
        (lambda: forward_camera().camera("fisheye"), "raw, pinhole"),
        (lambda: sideways(270), r"cam\.yml: not the calibration of a front"),
        (lambda: sideways(0), r"cam\.yml: not the calibration of a front"),
    ],
)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises((UserError, DataError, FileNotFoundError), match=message):
        call()


@pytest.mark.parametrize(
    ("center_px", "size_px", "is_fine"),
    [
        ((628.72, 369.31), (1280, 720), True),  # K-Radar
        ((341.74, 200.74), (1280, 720), False),  # of nearly the same aspect
        ((341.74, 200.74), (320, 180), False),
        ((628.72, -30.0), (1280, 320), False),
    ],
)
def test_intrinsics_and_size_are_of_the_same_image(center_px, size_px, is_fine):
    size = dict(zip(("width", "height"), size_px, strict=True))
    camera = forward_camera(intrinsics=(560.0, 560.0, *center_px), **size)
    if is_fine:
        camera.require_view_ahead("cam.yml")
        return
    message = r"cam\.yml: principal point .*, .* in an image of \d+ x \d+ pixels, exp"
    with pytest.raises(DataError, match=message):
        camera.require_centered("cam.yml")
    with pytest.raises(DataError, match=message):
        camera.require_view_ahead("cam.yml")


def test_angles_of_the_calibration_tool_are_relative(tmp_path):
    # K-Radar's cam_calib/from_gui_tool/cam_front0.yml; the second pose is the same in the
    # angles of cam_calib/common/cam_front0.yml.
    given = {"yaw_deg": 0.6, "pitch_deg": 1.4, "roll_deg": -0.4}
    same = {"yaw_deg": 88.59992326, "pitch_deg": 0.59982089, "roll_deg": 89.61465984}
    path = tmp_path / "cam_front0.yml"
    numbers = dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "z_ldr2cam"), 0.0)
    numbers |= {"fx": 567.72, "fy": 577.21, "px": 628.72, "py": 369.31}
    numbers |= {"x_ldr2cam": 0.18, "y_ldr2cam": -0.13}
    numbers |= {k.replace("_deg", "_ldr2cam"): value for k, value in given.items()}
    path.write_text("\n".join(f"{name}: {value}" for name, value in numbers.items()))
    found = CameraCalibration.from_kradar(path)
    wanted = forward_camera(**same)
    np.testing.assert_allclose(found.rotation, wanted.rotation, atol=1e-9)
    _, depth_m = found.project_ego(np.array([20.0, 0.0, 0.0]))
    assert depth_m == pytest.approx(22.53, abs=0.01)
    found.require_view_ahead(path)
