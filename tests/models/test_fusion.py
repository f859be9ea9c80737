"""Tests of radejax.models.fusion."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.fusion import Fusion
from radejax.models.lifting import ReferencePoints
from radejax.models.options import FusionOptions

from .plain_attention import plain_attention

B, R, A, C, E, D, H, W = 2, 4, 3, 8, 3, 5, 6, 7
SIZES = {"num_heads": 2, "num_points": 3, "num_elevation": E, "chunk_size": 5}
SMALL = FusionOptions(necks=False, **SIZES)


def fusion(**changes):
    return Fusion(SMALL.replace(**changes), num_groups=4)


def inputs(seed=0, batch_geometry=True):
    rng = np.random.default_rng(seed)
    n = B if batch_geometry else 1
    is_valid = rng.random((n, R, A, E)) > 0.4
    is_valid[:, 1, 1] = False  # a bin that sees nothing
    is_valid[:, 0, 0] = True
    normal = lambda *s: rng.standard_normal(s).astype(np.float32)  # noqa: E731
    points = rng.random((n, R, A, E, 2)).astype(np.float32)
    reference = ReferencePoints(points, is_valid)
    maps = normal(B, R, A, C), rng.random((B, R, A, D)), normal(B, H, W, C)
    return (*map(jnp.asarray, maps), reference)


def variables_of(module, args):
    """Random parameters: the initial ones leave offsets and logits at zero."""
    shapes = jax.eval_shape(module.init, jax.random.key(0), *args)
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda x: jnp.asarray(0.4 * rng.standard_normal(x.shape), jnp.float32), shapes
    )


def by_the_formulas(module, variables, radar, elevation, camera, reference):
    """Query by query through the plain attention, then the paper's equations."""
    params = jax.tree.map(np.asarray, variables["params"])
    radar, elevation, camera = map(np.asarray, (radar, elevation, camera))
    dense = lambda x, p: x @ p["kernel"] + p["bias"]  # noqa: E731
    weights = np.ones((B, R, A, E))
    if module.options.weighting == "mlp":
        hidden = np.maximum(dense(elevation, params["weighting"]["hidden"]), 0)
        weights = np.exp(dense(hidden, params["weighting"]["out"]))
        weights /= weights.sum(-1, keepdims=True)
    is_valid = np.broadcast_to(reference.is_valid, (B, R, A, E))
    points = np.broadcast_to(reference.points, (B, R, A, E, 2))
    query = (weights * is_valid)[..., None] * radar[:, :, :, None]
    attended, _, _ = plain_attention(
        params["attention"],
        jnp.asarray(query.reshape(B, -1, C), jnp.float32),
        jnp.asarray(points.reshape(B, -1, 1, 2)),
        jnp.asarray(camera.reshape(B, H * W, C)),
        [(H, W)],
        (module.options.num_heads, module.options.num_points),
    )
    attended = np.asarray(attended).reshape(B, R, A, E, C)
    if module.options.out_of_view == "official":
        seen, has_camera = attended.mean(3), np.ones((B, R, A, 1), bool)
    else:
        count = is_valid.sum(-1)[..., None]
        seen = (attended * is_valid[..., None]).sum(3) / np.maximum(count, 1)
        has_camera = count > 0
    joined = np.concatenate([radar, seen], -1)
    hidden = np.maximum(dense(joined, params["gate_hidden"]), 0)
    gate = 1 / (1 + np.exp(-dense(hidden, params["gate_out"])))
    if module.options.gate == "channel":
        fused = gate * radar + (1 - gate) * seen
    else:
        fused = gate * seen + (1 - gate) * radar
    return np.where(has_camera, fused, radar)


@pytest.mark.parametrize(
    ("weighting", "gate", "out_of_view", "batch_geometry"),
    [
        ("mlp", "channel", "drop", True),
        ("mlp", "bin", "official", False),
        ("off", "channel", "drop", False),
    ],
)
def test_fusion_follows_the_equations(weighting, gate, out_of_view, batch_geometry):
    module = fusion(weighting=weighting, gate=gate, out_of_view=out_of_view)
    args = inputs(batch_geometry=batch_geometry)
    variables = variables_of(module, args)
    fused = jax.jit(module.apply)(variables, *args)
    expected = by_the_formulas(module, variables, *args)
    np.testing.assert_allclose(fused, expected, atol=2e-5)
    gate_width = C if gate == "channel" else 1
    assert variables["params"]["gate_out"]["bias"].shape == (gate_width,)


@pytest.mark.parametrize("necks", [False, True])
def test_a_missing_image_leaves_the_radar_alone(necks):
    module = fusion(necks=necks, out_of_view="official")
    radar, elevation, camera, reference = inputs()
    variables = variables_of(module, (radar, elevation, camera, reference))
    reference = reference.replace(has_image=np.array([True, False]))
    apply = functools.partial(module.apply, mutable="intermediates")
    fused, state = jax.jit(apply)(variables, radar, elevation, camera, reference)
    alone, _ = jax.jit(apply)(variables, radar, elevation, None, None)
    np.testing.assert_allclose(fused[1], alone[1], atol=1e-6)
    assert np.abs(fused[0] - alone[0]).max() > 0.1
    (share,) = state["intermediates"]["camera_share"]
    chex.assert_shape(share, (B, R, A))
    assert not share[1].any()
    assert ((share[0] > 0) & (share[0] < 1)).all()
    if not necks:
        np.testing.assert_array_equal(alone, radar)


def test_dropout_drops_in_training_only():
    module = fusion(dropout=0.5)
    args = inputs()
    variables = variables_of(module, args)
    plain = jax.jit(module.apply)(variables, *args)
    rngs = {"dropout": jax.random.key(3)}
    train = functools.partial(module.apply, train=True)
    dropped = jax.jit(train)(variables, *args, rngs=rngs)
    share = np.mean(np.asarray(dropped) == 0)
    assert 0.3 < share < 0.7
    kept = np.asarray(dropped) != 0
    np.testing.assert_allclose(dropped[kept], 2 * np.asarray(plain)[kept], rtol=1e-5)
