"""Tests of `radejax.models.image`; weights/test_resnet.py has the definition of the ResNet."""

import chex
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np

from radejax.models import image as image_lib
from radejax.models.image import CameraNeck, TransposedConv

from ..small_models import drawn


def test_bytes_become_standardised_colors():
    image = jnp.asarray([[[[0, 255, 51]]]], jnp.uint8)
    expected = [-0.485 / 0.229, (1 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    np.testing.assert_allclose(image_lib.normalize(image)[0, 0, 0], expected, rtol=1e-6)
    scaled = image_lib.normalize(image, standardize=False)
    np.testing.assert_allclose(scaled[0, 0, 0], [0, 1, 0.2], rtol=1e-6)
    floats = jnp.full((1, 2, 2, 3), 0.3)  # are normalized already
    assert image_lib.normalize(floats) is floats


def test_a_trained_trunk_is_the_frozen_one_of_its_statistics():
    trained = image_lib.ResNetTrunk(4, (1, 2, 1), frozen=False)
    frozen = trained.copy(frozen=True)
    image = jax.random.normal(jax.random.key(1), (2, 32, 48, 3))

    @jax.jit
    def both(image):
        variables = trained.init(jax.random.key(0), image)
        _, stats = trained.apply(variables, image, True, mutable=["batch_stats"])
        variables = {**variables, **stats}
        flatten = flax.traverse_util.flatten_dict
        merged = flatten(variables["params"]) | flatten(variables["batch_stats"])
        params = flax.traverse_util.unflatten_dict(merged)
        expected = trained.apply(variables, image)
        return expected, frozen.apply({"params": params}, image), params

    expected, found, params = both(image)
    chex.assert_shape(found, (2, 2, 3, 64))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert float(jnp.std(found)) > 0
    shapes = jax.eval_shape(frozen.init, jax.random.key(0), image)["params"]
    chex.assert_trees_all_equal_shapes(params, shapes)
    # The statistics are those of the images, not those to start with.
    assert float(jnp.abs(params["stem_norm"]["mean"]).min()) > 0


def test_shapes_and_running_statistics():
    neck = CameraNeck(8)
    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((3, 2, 3, 5)).astype(np.float32)
    all_images = jnp.ones(3, bool)
    variables = jax.tree.map(jnp.asarray, drawn(neck, tokens, all_images))
    out = jax.jit(neck.apply)(variables, tokens, all_images)
    chex.assert_shape(out, (3, 8, 12, 8))
    assert float(out.min()) == 0  # ReLU
    train = jax.jit(lambda *a: neck.apply(*a, train=True, mutable="batch_stats"))
    out, state = train(variables, tokens, all_images)
    up = TransposedConv(8).apply(
        {"params": variables["params"]["up_1"]},
        jnp.asarray(tokens) @ variables["params"]["proj"]["kernel"]
        + variables["params"]["proj"]["bias"].reshape(1, 1, 1, -1),
    )
    before = variables["batch_stats"]["up_1_norm"]["mean"]
    mean = 0.1 * up.mean((0, 1, 2)) + 0.9 * before
    after = state["batch_stats"]["up_1_norm"]["mean"]
    np.testing.assert_allclose(after, mean, atol=1e-6)
    # A frame without an image has no part in the statistics.
    spoiled = tokens.copy()
    spoiled[1] = 100.0
    has_image = jnp.asarray([True, False, True])
    _, with_gap = train(variables, spoiled, has_image)
    _, without = train(variables, tokens[[0, 2]], jnp.ones(2, bool))
    chex.assert_trees_all_close(with_gap, without, atol=1e-5)
    chex.assert_tree_all_finite(train(variables, tokens, jnp.zeros(3, bool)))
