"""Tests of `radejax.models.backbone`; weights/test_radenet_torch.py has torch's numbers."""

import jax
import jax.numpy as jnp
import pytest

from radejax.models.backbone import Backbone, InputStem

from .. import small_models as small


@pytest.mark.parametrize("widths", [(16,), (16, 32), (16, 32, 48, 64)])
def test_any_number_of_levels(widths):
    backbone = Backbone(8, widths, decoder_width=24, num_groups=8)
    x = jnp.zeros((1, 32, 16, 13))
    variables = jax.eval_shape(backbone.init, jax.random.key(0), x)
    assert jax.eval_shape(backbone.apply, variables, x).shape == (1, 32, 16, 24)
    names = [
        f"{part}_{i + 1}"
        for part in ("encoder", "decoder", "cbam")
        for i in range(len(widths))
    ]
    assert set(names) <= set(variables["params"])


@pytest.mark.parametrize(("doppler_bins", "there"), [(0, "elevation"), (3, "doppler")])
def test_the_stem_encodes_no_half_without_channels(doppler_bins, there):
    stem = InputStem(8, doppler_bins, 4)
    x = jnp.ones((1, 4, 4, 3))
    variables = small.drawn(stem, x)
    assert set(variables["params"]) == {there, "mix"}
    assert stem.apply(variables, x).shape == (1, 4, 4, 8)
