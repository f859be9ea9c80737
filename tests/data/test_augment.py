import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from radejax.core.errors import UserError
from radejax.data import augment as augmentation
from radejax.data.augment import Augmentation, Sample, mirror
from radejax.data.cameras import read_left_image
from radejax.data.projection import LOG_SCALE_DB, decode, encode
from radejax.geometry.camera import CameraCalibration, project
from radejax.geometry.radar_grid import RadarGrid

from .. import small_models as small

GRID = RadarGrid.reduced(num_doppler=6, num_range=16, num_elevation=5, num_azimuth=12)
CAMERA = CameraCalibration.from_angles(
    intrinsics=(560.0, 570.0, 600.0, 370.0),
    distortion=(-0.03, 0.001, 0.004, -0.005, 0.0),
    yaw_deg=88.6,
    pitch_deg=0.6,
    roll_deg=89.6,
    translation_m=(0.2, -0.1, -0.02),
)


def sample(boxes, dtype=np.float16, seed=0):
    """A frame whose projection has a blob at the nearest bin of every box."""
    rng = np.random.default_rng(seed)
    projection = rng.uniform(0.1, 0.3, GRID.projection_shape)
    for x, y in boxes[:, :2]:
        r, a = GRID.nearest_bin(x, y)
        projection[r, a] = 0.9
    classes = np.zeros(len(boxes), np.int32)
    return Sample(encode(projection, np.dtype(dtype).name), boxes, classes)


box = st.tuples(
    st.floats(5, 60),  # x
    st.floats(-40, 40),
    st.floats(-2, 2),
    *(st.floats(0.5, 9),) * 3,
    st.floats(-1, 1),
    st.floats(-1, 1),
)
point = st.tuples(st.floats(5, 80), st.floats(-30, 30), st.floats(-2, 4))
boxes_st = st.lists(box, min_size=1, max_size=4).map(lambda b: np.array(b, np.float64))


@settings(deadline=None, max_examples=30)
@given(boxes=boxes_st, seed=st.integers(0, 9))
def test_mirrored_boxes_and_maps_stay_in_register(boxes, seed):
    before = sample(boxes, seed=seed)
    after = mirror(before)
    for old, new in zip(boxes, after.boxes, strict=True):
        (r, a), (r2, a2) = GRID.nearest_bin(*old[:2]), GRID.nearest_bin(*new[:2])
        assert r == r2
        assert abs((GRID.num_azimuth - 1 - a) - a2) <= 1  # halves round to even
        found = after.projection[r, GRID.num_azimuth - 1 - a]
        np.testing.assert_array_equal(found, before.projection[r, a])
        # Heading (cos, sin) mirrors with the position.
        np.testing.assert_array_equal(new[[7, 6]], old[[7, 6]] * (1, -1))
        np.testing.assert_array_equal(new[[0, 2, 3, 4, 5]], old[[0, 2, 3, 4, 5]])
    twice = mirror(after)
    np.testing.assert_array_equal(twice.projection, before.projection)
    np.testing.assert_array_equal(twice.boxes, boxes)


@settings(deadline=None, max_examples=30)
@given(
    points=st.lists(point, min_size=1, max_size=5),
    kind=st.sampled_from(["raw", "pinhole"]),
)
def test_mirrored_camera_sees_the_mirrored_world_in_the_mirrored_image(points, kind):
    points = np.array(points)
    camera = CAMERA.camera(kind)
    before, depth = project(points, camera)
    mirrored = augmentation.mirror_camera(camera)
    after, depth_after = project(points * (1, -1, 1), mirrored)
    np.testing.assert_allclose(depth_after, depth, rtol=1e-12)
    np.testing.assert_allclose(after[:, 1], before[:, 1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after[:, 0], 1280 - before[:, 0], rtol=1e-9, atol=1e-9)


def test_image_is_mirrored_with_its_camera():
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    boxes = np.array([[10.0, 1, 0, 4, 2, 1, 0, 1]])
    before = dataclasses.replace(sample(boxes), image=image, camera=CAMERA.camera())
    after = mirror(before)
    np.testing.assert_array_equal(after.image, image[:, ::-1])
    assert after.camera.intrinsics[2] == 1280 - 600
    assert before.camera.intrinsics[2] == 600
    assert mirror(sample(boxes)).image is None


def test_a_point_has_its_color_in_the_resized_and_the_mirrored_image(tmp_path):
    """Read as the model samples: pixel i has its center at i + 1/2."""
    ramp = np.full((64, 128, 3), 2 * np.arange(128)[:, None], np.uint8)
    Image.fromarray(ramp).save(tmp_path / "a.png")
    fields = {"intrinsics": (60.0, 60.0, 55.0, 30.0), "width": 128, "height": 64}
    calibration = dataclasses.replace(CAMERA, **fields)
    points = np.array([[20.0, 3.0, 0.0], [30.0, -8.5, 0.0], [15.0, 2.25, 1.0]])
    colors = []
    for scale in (1, 2):
        width, height = 128 // scale, 64 // scale
        image = read_left_image(tmp_path / "a.png", (height, width), resize=True)
        camera = calibration.resized(width, height).camera()
        before = sample(np.zeros((1, 8)))
        before = dataclasses.replace(before, image=image, camera=camera)
        for frame, sign in ((before, 1), (mirror(before), -1)):
            (pixels, _) = project(points * (1, sign, 1), frame.camera)
            row = frame.image[0, :, 0].astype(float)
            colors.append(np.interp(pixels[:, 0] - 0.5, np.arange(width), row))
    for found in colors[1:]:
        np.testing.assert_allclose(found, colors[0], atol=1e-6)


def test_augmentation_is_a_function_of_its_seed():
    augment = Augmentation(GRID, 0.5)
    before = sample(np.array([[20.0, 3, 0, 4, 2, 1, 0.6, 0.8]]))
    outcomes = {}
    for seed in range(40):
        one = augment(before, np.random.default_rng(seed))
        two = augment(before, np.random.default_rng(seed))
        np.testing.assert_array_equal(one.projection, two.projection)
        outcomes[one.boxes[0, 1]] = outcomes.get(one.boxes[0, 1], 0) + 1
    assert set(outcomes) == {3.0, -3.0}
    assert 10 <= outcomes[3.0] <= 30
    np.testing.assert_array_equal(before.boxes[0, 1], 3.0)


def test_padding_stays_zero_and_off_is_off():
    padded = np.zeros((3, 8), np.float32)
    before = dataclasses.replace(sample(padded), classes=np.full(3, -1))
    boxes = mirror(before).boxes
    np.testing.assert_array_equal(boxes, padded)
    assert boxes.dtype == np.float32
    skewed = dataclasses.replace(GRID, azimuth_rad=GRID.azimuth_rad + 0.1)
    assert Augmentation(skewed)(before, np.random.default_rng(0)) is before


@pytest.mark.parametrize("sign", [1, -1])
def test_uneven_azimuths_are_mirrored_if_they_are_symmetric(sign):
    grid = small.uneven_grid()
    azimuth = sign * grid.azimuth_rad
    even = dataclasses.replace(grid, azimuth_rad=azimuth)
    assert Augmentation(even, 0.5).mirror_probability == 0.5
    tilted = dataclasses.replace(grid, azimuth_rad=azimuth + 0.01)
    with pytest.raises(UserError, match="are not symmetric"):
        Augmentation(tilted, 0.5)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint8])
def test_gain_shifts_all_levels_by_the_same_decibels(dtype):
    before = sample(np.zeros((0, 8)), dtype)
    after = augmentation.change_gain(before, 18.43)  # a tenth of the scale
    assert after.projection.dtype == dtype
    shift = decode(after.projection) - decode(before.projection)
    np.testing.assert_allclose(shift, 0.1, atol=0.002)
    augment = Augmentation(GRID, random_gain_db=6.0)
    rng = np.random.default_rng(0)
    changed = [decode(augment(before, rng).projection).mean() for _ in range(40)]
    shifts_db = (np.array(changed) - decode(before.projection).mean()) * LOG_SCALE_DB
    assert -6.3 < min(shifts_db) < -3.0 < 3.0 < max(shifts_db) < 6.3
