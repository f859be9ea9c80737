"""Tests of `radejax.models.heads`: necks, then heads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.heads import NECKS, DilatedResidual, Heads

NAMES = {
    "conv_1/conv": "conv1.conv",
    "conv_1/norm": "conv1.gn",
    "conv_2": "conv2",
    "norm": "gn",
}


@pytest.mark.parametrize("dilation", [1, 2, 3])
def test_dilated_residual_equals_official(dilation, module_case, run_like_torch):
    x, expected = module_case(f"residual_block_dil{dilation}")
    actual = run_like_torch(DilatedResidual(dilation, 32), NAMES, x)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def reach(kind):
    """Bins around the center that a change of the center reaches through the convs."""
    x = jax.random.normal(jax.random.key(1), (1, 41, 41, 8))
    module = NECKS[kind](num_groups=8)
    params = module.init(jax.random.key(0), x)
    # The norms pass a little of every change to all bins: count where far more arrives.
    y = module.apply(params, x)
    changed = jnp.abs(module.apply(params, x.at[0, 20, 20].add(0.1)) - y).max(-1)[0]
    far = np.asarray(changed > 10 * np.median(changed))
    return np.abs(np.argwhere(far) - 20).max()


def test_dilated_neck_sees_farther():
    # Taps reach 1+1, 2+1 and 3+1 bins in the dilated neck, 1 three times in the plain.
    assert reach("plain") <= 3 < reach("dilated") <= 9


def test_untrained_confidence_is_near_the_prior():
    prior = 0.01
    heads = Heads(num_classes=5, kind="default", heatmap_prior=prior)
    x = jax.random.normal(jax.random.key(1), (1, 8, 8, 128))
    maps, _ = jax.jit(heads.init_with_output)(jax.random.key(0), x)
    median = np.median(jax.nn.sigmoid(maps.heatmap_logits))
    assert abs(np.log(median / (1 - median)) - np.log(prior / (1 - prior))) < 1.0


def test_maps_are_float32_in_bfloat16():
    heads = Heads(num_classes=5, dtype=jnp.bfloat16)
    x = jax.ShapeDtypeStruct((1, 4, 4, 128), jnp.bfloat16)
    maps, _ = jax.eval_shape(heads.init_with_output, jax.random.key(0), x)
    assert maps.heatmap_logits.dtype == maps.box_params.dtype == jnp.float32
