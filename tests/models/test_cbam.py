"""Tests of `radejax.models.cbam`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.cbam import CBAM, ChannelAttention, SpatialAttention
from radejax.weights.radenet_torch import cbam_names

NAMES = {k[2:]: v[2:] for k, v in cbam_names("m", "m").items()}


@pytest.mark.parametrize("case", ["channel_attention", "channel_attention_small"])
def test_channel_attention_equals_official(case, module_case, run_like_torch):
    x, expected = module_case(case)
    names = {"squeeze": "fc1", "excite": "fc2"}
    actual = run_like_torch(ChannelAttention(), names, x)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_spatial_attention_equals_official(module_case, run_like_torch):
    x, expected = module_case("spatial_attention")
    actual = run_like_torch(SpatialAttention(), {"conv": "convolution"}, x)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_official_block_equals_official(module_case, run_like_torch):
    x, expected = module_case("cbam_block")
    actual = run_like_torch(CBAM("official", 32), NAMES, x)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_paper_block_is_equations_6_to_9():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1, 9, 8, 32)).astype(np.float32)
    module = CBAM("paper", 8)
    variables = module.init(jax.random.key(0), jnp.asarray(x))
    p = jax.tree.map(lambda v: np.asarray(v, np.float64), variables["params"])

    def sigmoid(v):
        return 1 / (1 + np.exp(-v))

    def mlp(v):
        squeeze, excite = p["channel"]["squeeze"], p["channel"]["excite"]
        hidden = np.maximum(v @ squeeze["kernel"] + squeeze["bias"], 0)
        return hidden @ excite["kernel"] + excite["bias"]

    y = x * sigmoid(mlp(x.mean((1, 2))) + mlp(x.max((1, 2))))[:, None, None]
    pooled = np.pad(np.stack([y.mean(-1), y.max(-1)], -1)[0], ((3, 3), (3, 3), (0, 0)))
    conv = p["spatial"]["conv"]
    attention = np.array(
        [
            [
                (pooled[i : i + 7, j : j + 7, :, None] * conv["kernel"]).sum()
                for j in range(8)
            ]
            for i in range(9)
        ]
    )
    expected = y * sigmoid(attention + conv["bias"])[None, ..., None]
    found = module.apply(variables, jnp.asarray(x))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_paper_block_has_no_convolutions_of_the_map():
    variables = CBAM("paper", 8).init(jax.random.key(0), jnp.zeros((1, 8, 8, 32)))
    assert set(variables["params"]) == {"channel", "spatial"}
