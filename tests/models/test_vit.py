"""Tests of radejax.models.vit."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models import vit
from radejax.models.options import ViTOptions
from radejax.models.vit import ViT

from ..small_models import drawn

TINY = ViTOptions(
    hidden_size=16, num_layers=2, num_heads=2, mlp_dim=32, patch_size=4, num_registers=2
)


def softmax_attention(*arrays):
    """The formula in NumPy, one head after another."""
    query, key, value = (a.astype(np.float64) for a in arrays)
    out = np.zeros_like(query)
    for b in range(query.shape[0]):
        for h in range(query.shape[2]):
            scores = query[b, :, h] @ key[b, :, h].T / np.sqrt(query.shape[-1])
            weights = np.exp(scores - scores.max(-1, keepdims=True))
            weights /= weights.sum(-1, keepdims=True)
            out[b, :, h] = weights @ value[b, :, h]
    return out


def random_qkv(tokens, dtype=np.float32, heads=3, head_dim=8):
    rng = np.random.default_rng(0)
    shape = (2, tokens, heads, head_dim)
    return [rng.standard_normal(shape).astype(dtype) * 2 for _ in range(3)]


@pytest.mark.parametrize("kind", ["blocked", "xla"])
@pytest.mark.parametrize("tokens", [17, 700])  # below and above one block
def test_attention_follows_the_formula(kind, tokens):
    query, key, value = random_qkv(tokens)
    actual = jax.jit(vit.attend, static_argnums=3)(query, key, value, kind)
    np.testing.assert_allclose(actual, softmax_attention(query, key, value), atol=1e-5)


def test_blocked_attention_has_the_gradients_of_the_plain_one():
    arrays = random_qkv(530)

    def loss(kind, *arrays):
        return jnp.sum(jnp.sin(vit.attend(*arrays, kind)))

    gradient = jax.jit(jax.grad(loss, (1, 2, 3)), static_argnums=0)
    plain, blocked = gradient("xla", *arrays), gradient("blocked", *arrays)
    # Values reach 35; each form is within 2e-5 of float64.
    chex.assert_trees_all_close(blocked, plain, atol=5e-5)


def test_images_are_resized_to_the_nearest_multiples_of_the_patch_size():
    model = ViT(TINY.replace(position_grid=4))
    assert TINY.grid(8, 12) == (2, 3)
    assert TINY.grid(9, 10) == (2, 3)  # half rounds up
    # K-Radar's images for DINOv2: 714 x 1274 pixels.
    assert TINY.replace(patch_size=14).grid(720, 1280) == (51, 91)
    variables = drawn(model, jnp.zeros((1, 8, 8, 3)))
    ramp = np.linspace(-1, 1, 90, dtype=np.float32).reshape(1, 9, 10, 1)
    image = np.repeat(ramp, 3, -1)
    resized = jax.image.resize(image, (1, 8, 12, 3), "linear")
    apply = jax.jit(model.apply)
    found, expected = apply(variables, image), apply(variables, resized)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("new", [3, 7, 12])
def test_bicubic_weights_are_those_of_torch(golden, new, antialias):
    expected = np.load(golden / "backbones.npz")[f"bicubic__{new}__{antialias}"]
    weights = vit.bicubic_weights(7, new, antialias=antialias)
    np.testing.assert_allclose(weights, expected, atol=1e-6)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)


def test_bfloat16_stays_close():
    image = np.random.default_rng(0).standard_normal((1, 16, 16, 3)).astype(np.float32)
    variables = drawn(ViT(TINY), image)
    exact = jax.jit(ViT(TINY).apply)(variables, image)
    half = jax.jit(ViT(TINY, dtype=jnp.bfloat16).apply)(variables, image)
    assert half.dtype == jnp.float32
    assert 0 < np.abs(half - exact).max() < 0.1
