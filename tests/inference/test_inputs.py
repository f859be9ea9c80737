"""Images and calibrations of every kind become the same arrays; what lacks is counted."""

import jax
import numpy as np
import pytest

from radejax import Detector, UserError
from radejax.core.structures import Batch
from radejax.data.options import CameraOptions, DataOptions
from radejax.geometry import camera as camera_lib
from radejax.geometry.camera import stack_cameras
from radejax.inference.inputs import InputReader

from .. import small_models as small


@pytest.fixture(scope="module")
def fusion():
    return small.detector("camera")


def _read_cameras(fusion, *arguments, **options):
    data = DataOptions(camera=CameraOptions(**options))
    return InputReader(fusion.model, fusion.grid, data).read_cameras(*arguments)


def _equal(a, b):
    assert np.asarray(a.is_valid).any()
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), a, b)


def _differs(a, b):
    return not np.allclose(a.scores, b.scores, atol=1e-4)


@pytest.mark.slow
def test_every_form_of_a_camera_gives_the_same(fusion, tmp_path):
    projection, image = small.projections(2), small.images(2)
    # A path says nothing about the radar's place: it has K-Radar's.
    ground = camera_lib.RADAR_FROM_LIDAR_M[:2]
    shift = (*ground, camera_lib.KRADAR_RADAR_FROM_LIDAR_Z_M)
    calibration = small.calibration(radar_from_lidar_m=shift)
    path = tmp_path / "cam_front0.yml"
    path.write_text(calibration.to_kradar_text())
    camera = calibration.camera("raw")
    expected = fusion(projection, image, calibration)
    stacked = stack_cameras([camera, camera])
    for given in (path, [calibration, path], camera, [camera, calibration], stacked):
        _equal(fusion(projection, image, given), expected)
    one = fusion(projection[:1], image[:1], camera)
    _equal(fusion(projection[0], image[0], camera), one)
    batch = Batch(projection, None, None, None, None, image, stacked)
    _equal(fusion(batch), expected)
    assert _differs(fusion(projection, image[::-1], calibration), expected)
    turned = small.calibration(yaw_deg=70.0, radar_from_lidar_m=shift)
    assert _differs(fusion(projection, image, turned), expected)
    assert _differs(fusion(projection), expected)


def test_missing_images_are_predicted_from_the_radar_and_counted(fusion):
    projection, image = small.projections(3), small.images(3)
    calibration = small.calibration()
    whole = fusion(projection, image, calibration)
    alone = fusion(projection)
    before = fusion.num_radar_only
    some = fusion(projection, [image[0], None, image[2]], calibration)
    assert fusion.num_radar_only == before + 1
    other = fusion(projection, image, [calibration, None, calibration])
    assert fusion.num_radar_only == before + 2
    for i, expected in enumerate((whole, alone, whole)):
        row = jax.tree.map(lambda x, i=i: x[i], expected)
        _equal(jax.tree.map(lambda x, i=i: x[i], some), row)
        _equal(jax.tree.map(lambda x, i=i: x[i], other), row)
    strict = Detector(small.saved("camera", data__camera__allow_missing=False))
    with pytest.raises(UserError, match=r"1 of 3 frames .* the first is frame 1"):
        strict(projection, [image[0], None, image[2]], calibration)
    with pytest.raises(UserError, match="3 of 3 frames"):
        strict(projection)


def _without_backbone(variables):
    params = {k: v for k, v in variables["params"].items() if k != "image_backbone"}
    return {**variables, "params": params}


@pytest.mark.slow
def test_embedded_images_and_weights_without_the_backbone(fusion):
    projection, image = small.projections(1), small.images(1)
    expected = fusion(projection, image, small.calibration())
    features = fusion.model.apply(fusion.variables, image, method="embed")
    _equal(fusion(projection, features, small.calibration()), expected)
    lean = fusion.replace(variables=_without_backbone(fusion.variables))
    _equal(lean(projection, features, small.calibration()), expected)
    with pytest.raises(UserError, match="without the image backbone: give"):
        lean(projection, image, small.calibration())
    with pytest.raises(UserError, match="without the image backbone"):
        lean(Batch(projection, None, None, None, None, image))


def test_a_stream_of_frames_with_images(fusion):
    projection, image = small.projections(3), small.images(3)
    calibration = small.calibration()
    items = [(projection[i], image[i], calibration) for i in range(3)]
    for i, found in enumerate(fusion.stream(items)):
        expected = fusion(projection[i], image[i], calibration)
        _equal(found, expected)
    assert fusion.warmup(1) is fusion
    size = fusion._run._cache_size()
    fusion(*items[0])
    assert fusion._run._cache_size() == size


@pytest.mark.parametrize(
    ("image", "camera", "message"),
    [
        (small.images(2), None, "belong together: give both"),
        (small.images(3), small.calibration(), "3 images and 2 cameras for 2"),
        (small.images(2)[:, :8], small.calibration(), r"\[2, 8, 48, 3\], expected"),
        (small.images(2), "nowhere.yml", "No such file.*nowhere.yml"),
    ],
)
def test_what_does_not_fit_is_named(image, camera, message, fusion):
    with pytest.raises((UserError, FileNotFoundError), match=message):
        _read_cameras(fusion, image, camera, 2)


def test_the_height_of_the_radar_is_the_models_or_kradars(fusion, tmp_path):
    path = tmp_path / "cam_front0.yml"
    path.write_text(small.calibration().to_kradar_text())

    def shift(camera, **options):
        _, camera, _ = _read_cameras(fusion, small.images(1), camera, 1, **options)
        return -small.calibration().rotation.T @ camera.cam_from_ego[0, :, 3]

    own = small.calibration(radar_from_lidar_m=(1.0, 2.0, 3.0))
    for camera, options, expected in (
        (str(path), {}, (-2.54, 0.3, 0.7)),
        (str(path), {"radar_from_lidar_z_m": 0.0}, (-2.54, 0.3, 0.0)),
        (own, {}, (1, 2, 3)),
        (own, {"radar_from_lidar_z_m": 0.5}, (1, 2, 0.5)),
    ):
        np.testing.assert_allclose(shift(camera, **options), expected, atol=1e-6)
