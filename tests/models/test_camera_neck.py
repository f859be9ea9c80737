"""Tests of radejax.models.camera_neck."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from radejax.models.camera_neck import CameraNeck, TransposedConv


def scattered(x, kernel, bias):
    """The definition: every input spreads its 4x4 kernel, two outputs apart."""
    b, height, width, _ = x.shape
    out = np.zeros((b, 2 * height + 2, 2 * width + 2, kernel.shape[-1]))
    for i in range(height):
        for j in range(width):
            spread = np.einsum("bc,klcd->bkld", x[:, i, j], kernel)
            out[:, 2 * i : 2 * i + 4, 2 * j : 2 * j + 4] += spread
    return out[:, 1:-1, 1:-1] + bias  # padding 1 cuts the border


def test_transposed_convolution_follows_its_definition():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 3, 4, 5)).astype(np.float32)
    kernel = rng.standard_normal((4, 4, 5, 6)).astype(np.float32)
    bias = rng.standard_normal(6).astype(np.float32)
    params = {"kernel": kernel, "bias": bias}
    out = jax.jit(TransposedConv(6).apply)({"params": params}, x)
    np.testing.assert_allclose(out, scattered(x, kernel, bias), atol=1e-5)


def test_the_gradient_is_made_of_matrix_products():
    """A convolution of this shape takes a CPU seconds by its kernel's gradient."""
    module, x = TransposedConv(6), jnp.ones((1, 3, 4, 5))
    variables = module.init(jax.random.key(0), x)
    gradient = jax.grad(lambda *args: module.apply(*args).sum(), (0, 1))
    program = jax.jit(gradient).lower(variables, x).as_text()
    assert "dot_general" in program
    assert "convolution" not in program


def test_shapes_and_running_statistics():
    neck = CameraNeck(8)
    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((3, 2, 3, 5)).astype(np.float32)
    all_images = jnp.ones(3, bool)
    variables = jax.jit(neck.init)(jax.random.key(0), tokens, all_images)
    out = jax.jit(neck.apply)(variables, tokens, all_images)
    chex.assert_shape(out, (3, 8, 12, 8))
    assert float(out.min()) == 0  # ReLU
    train = jax.jit(lambda *a: neck.apply(*a, train=True, mutable="batch_stats"))
    out, state = train(variables, tokens, all_images)
    up = TransposedConv(8).apply(
        {"params": variables["params"]["up_1"]},
        tokens @ variables["params"]["proj"]["kernel"]
        + variables["params"]["proj"]["bias"].reshape(1, 1, 1, -1),
    )
    mean = 0.1 * up.mean((0, 1, 2))  # a tenth of the batch's, the rest of zero
    np.testing.assert_allclose(
        state["batch_stats"]["up_1_norm"]["mean"], mean, atol=1e-6
    )
    # A frame without an image has no part in the statistics.
    spoiled = tokens.copy()
    spoiled[1] = 100.0
    has_image = jnp.asarray([True, False, True])
    _, with_gap = train(variables, spoiled, has_image)
    _, without = train(variables, tokens[[0, 2]], jnp.ones(2, bool))
    chex.assert_trees_all_close(with_gap, without, atol=1e-5)


def test_a_batch_without_any_image_stays_finite():
    neck = CameraNeck(4)
    tokens = jnp.zeros((2, 2, 2, 3))
    none = jnp.zeros(2, bool)
    variables = neck.init(jax.random.key(0), tokens, none)
    out, state = neck.apply(variables, tokens, none, train=True, mutable="batch_stats")
    chex.assert_tree_all_finite((out, state))
