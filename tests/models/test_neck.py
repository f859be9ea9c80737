"""Tests of `radejax.models.neck`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.neck import NECKS, DilatedResidual

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
    module = NECKS[kind](8)
    params = module.init(jax.random.key(0), x)
    # The norms pass a little of every change to all bins: count where far more arrives.
    y = module.apply(params, x)
    changed = jnp.abs(module.apply(params, x.at[0, 20, 20].add(0.1)) - y).max(-1)[0]
    far = np.asarray(changed > 10 * np.median(changed))
    return np.abs(np.argwhere(far) - 20).max()


def test_dilated_neck_sees_farther():
    # Taps reach 1+1, 2+1 and 3+1 bins in the dilated neck, 1 three times in the plain.
    assert reach("plain") <= 3 < reach("dilated") <= 9


def test_kinds_have_their_blocks():
    def blocks(kind):
        x = jnp.zeros((1, 8, 8, 16))
        return NECKS[kind](8).init(jax.random.key(0), x)["params"]

    assert set(blocks("plain")["block_3"]) == {"conv", "norm"}
    assert set(blocks("dilated")["block_3"]) == {"conv_1", "conv_2", "norm"}
