"""Tests of radejax.models.dinorade."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.config import load_config
from radejax.core.errors import UserError
from radejax.data.projection import stack_frames
from radejax.geometry.camera import stack_cameras
from radejax.models import build, lifting
from radejax.models.lifting import ReferencePoints

from .. import small_models
from ..small_models import calibration, drawn

B, R, A, SIZE = 2, 6, 7, small_models.IMAGE_SIZE


def small(**changes):
    """A model of a few thousand parameters; `changes` by dotted name."""
    options = small_models.camera_config().model.replace(
        num_classes=2, query_grid={"range_m": (2.0, 5.0), "azimuth_deg": (-45.0, 15.0)}
    )
    return build(options.with_fields(changes))


def references(model, camera, num_range=8):
    options = model.options
    bins = num_range, 8, options.fusion.num_elevation
    return lifting.reference_points(camera, options.query_grid, *bins)


def batch(*, valid=(True, True), yaws=(90.0, 80.0)):
    rng = np.random.default_rng(0)
    calibrations = [calibration(yaw_deg=yaw) for yaw in yaws]
    views = zip(calibrations, valid, strict=True)
    camera = stack_cameras([one.camera(is_valid=ok) for one, ok in views])
    projection = jnp.asarray(rng.random((B, R, A, 5)), jnp.float32)
    image = jnp.asarray(rng.integers(0, 256, (B, *SIZE, 3)), jnp.uint8)
    return projection, image, camera


@functools.cache
def model_and_variables():
    """Away from the initial values, at which attention does not depend on the query."""
    model = small()
    return model, drawn(model, *batch())


@functools.cache
def applied():
    model, _ = model_and_variables()
    return jax.jit(model.apply)


def test_elevation_weights_are_those_of_the_last_frame():
    detector = small_models.detector("camera", num_frames=2)
    model, variables = detector.model, detector.variables
    image = jnp.asarray(small_models.images(1))
    camera = stack_cameras([calibration().camera()])

    @jax.jit
    def apply(stacked):
        inputs = stacked[None], image, camera
        _, found = model.apply(variables, *inputs, capture_intermediates=True)
        found = found["intermediates"]
        weights = found["image_fusion"]["weighting"]["__call__"][0]
        return weights, found["backbone"]["__call__"][0]

    def weighting(*frames):
        return apply(stack_frames(frames, model.options.doppler_bins))

    a, b, c = small_models.projections(3)
    weights, features = weighting(a, b)
    other_weights, other_features = weighting(c, b)
    np.testing.assert_array_equal(weights, other_weights)
    assert np.abs(features - other_features).max() > 1e-3
    assert np.abs(weighting(a, c)[0] - weights).max() > 1e-3


def test_the_camera_changes_the_prediction_and_each_frame_uses_its_own():
    _, variables = model_and_variables()
    projection, image, camera = batch()
    first = applied()(variables, projection, image, camera).heatmap_logits
    other_image = image.at[1].set(255 - image[1])
    second = applied()(variables, projection, other_image, camera).heatmap_logits
    np.testing.assert_allclose(second[0], first[0], atol=1e-5)
    assert np.abs(second[1] - first[1]).max() > 1e-3
    turned = batch(yaws=(90.0, 95.0))[2]
    third = applied()(variables, projection, image, turned).heatmap_logits
    np.testing.assert_allclose(third[0], first[0], atol=1e-5)
    assert np.abs(third[1] - first[1]).max() > 1e-4


def test_what_is_computed_before_gives_the_same_prediction():
    model, variables = model_and_variables()
    projection, image, camera = batch(yaws=(90.0, 90.0))
    expected = applied()(variables, projection, image, camera)
    reference = references(model, calibration().camera())
    assert 0.05 < reference.is_valid.mean() < 0.95
    found = applied()(variables, projection, image, reference)
    chex.assert_trees_all_close(found, expected, atol=1e-5)
    params = dict(variables["params"])
    backbone = {"params": {"image_backbone": params.pop("image_backbone")}}
    features = jax.jit(functools.partial(model.apply, method="embed"))(backbone, image)
    chex.assert_shape(features, (B, *model.options.image.feature_shape))
    found = applied()(variables | {"params": params}, projection, features, camera)
    chex.assert_trees_all_close(found, expected, atol=2e-6)


def test_frames_without_an_image_fall_back_to_the_radar():
    _, variables = model_and_variables()
    projection, image, camera = batch(valid=(True, False))
    image = image.at[1].set(0)
    maps = applied()(variables, projection, image, camera).heatmap_logits
    whole = applied()(variables, *batch()).heatmap_logits
    alone = applied()(variables, projection).heatmap_logits
    np.testing.assert_allclose(maps[0], whole[0], atol=1e-5)
    np.testing.assert_allclose(maps[1], alone[1], atol=1e-5)
    assert np.abs(whole[1] - alone[1]).max() > 1e-3


@pytest.mark.parametrize("is_frozen", [True, False])
def test_only_a_frozen_backbone_has_no_gradient(is_frozen):
    _, variables = model_and_variables()
    model = small(**{"image.freeze": is_frozen})
    params = {"image_backbone": variables["params"]["image_backbone"]}

    @jax.jit
    @jax.grad
    def gradient(params):
        features = model.apply({"params": params}, batch()[1], method="embed")
        return jnp.sum(features**3)

    grads = jax.tree.leaves(gradient(params))
    assert all((np.abs(g).max() > 0) != is_frozen for g in grads)
    assert model.is_frozen("image_backbone/norm/scale") == is_frozen
    assert not model.is_frozen("image_neck/proj/kernel")
    assert not model.is_frozen("backbone/stem/mix/conv/kernel")


@pytest.mark.parametrize(
    ("variant", "trained", "frozen"),
    [
        ("official", 31_059_193, 21_596_160),
        ("rcw_resnet50", 45_545_448, 8_573_888),
    ],
)
def test_parameters_at_full_size(variant, trained, frozen):
    model = build(load_config(f"dinorade:{variant}").model)
    bins = 1, 256, 112, 10
    reference = ReferencePoints(jnp.zeros((*bins, 2)), jnp.zeros(bins, bool))
    image = jnp.zeros((1, 720, 1280, 3), jnp.uint8)
    inputs = jnp.zeros((1, 256, 107, 101)), image, reference
    variables = jax.eval_shape(model.init, jax.random.key(0), *inputs)
    sizes = jax.tree.map(lambda x: x.size, variables["params"])
    assert sum(jax.tree.leaves(sizes.pop("image_backbone"))) == frozen
    assert sum(jax.tree.leaves(sizes)) == trained


@pytest.mark.wrong_types
def test_images_of_another_size_are_rejected():
    model, variables = model_and_variables()
    projection, image, camera = batch()
    short = references(model, calibration().camera(), 4)
    for message, arguments in (
        (r"\(2, 32, 32, 3\), expected \('B', 32, 48", (image[:, :, :32], camera)),
        ("image and camera belong together", (None, camera)),
        ("image and camera belong together", (image,)),
        (r"reference points are \(1, 4, 8, 3\), expected", (image, short)),
    ):
        with pytest.raises(UserError, match=message):
            jax.eval_shape(model.apply, variables, projection, *arguments)
