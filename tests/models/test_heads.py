"""Tests of `radejax.models.heads`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.heads import Heads


def params_of(**fields):
    heads = Heads(num_classes=5, **fields)
    return heads.init(jax.random.key(0), jnp.zeros((1, 4, 4, 128)))["params"]


def test_expanded_heads_keep_the_width_three_times():
    params = params_of(kind="expanded")
    shapes = [params["box"][f"conv_{i}"]["conv"]["kernel"].shape for i in (1, 2, 3)]
    assert shapes == [(3, 3, 128, 128)] * 3
    assert params["box"]["out"]["kernel"].shape == (1, 1, 128, 8)
    assert params["heatmap"]["out"]["kernel"].shape == (1, 1, 128, 5)


def test_default_heads_have_one_convolution_to_64():
    params = params_of(kind="default")
    assert set(params["heatmap"]) == {"conv_1", "out"}
    assert params["heatmap"]["conv_1"]["conv"]["kernel"].shape == (3, 3, 128, 64)


@pytest.mark.parametrize("prior", [0.5, 0.01])
def test_untrained_confidence_is_near_the_prior(prior):
    heads = Heads(num_classes=5, heatmap_prior=prior)
    x = jax.random.normal(jax.random.key(1), (1, 8, 8, 128))
    maps = heads.apply(heads.init(jax.random.key(0), x), x)
    median = np.median(jax.nn.sigmoid(maps.heatmap_logits))
    assert abs(np.log(median / (1 - median)) - np.log(prior / (1 - prior))) < 1.0


def test_maps_are_float32_in_bfloat16():
    heads = Heads(num_classes=5, dtype=jnp.bfloat16)
    x = jnp.zeros((1, 4, 4, 128), jnp.bfloat16)
    maps, _ = heads.init_with_output(jax.random.key(0), x)
    assert maps.heatmap_logits.dtype == maps.box_params.dtype == jnp.float32
