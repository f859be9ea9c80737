"""Tests of `radejax.models.backbone`; weights/test_radenet_torch.py has torch's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.models.backbone import Backbone, InputStem, SkipAttention
from radejax.models.options import RadeNetOptions

from .. import small_models as small


class Double(SkipAttention):
    """An attention that is no attention."""

    def __call__(self, x):
        return 2 * x


def test_skips_have_the_attention_of_the_config():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(1, 8, 8, 3)), jnp.float32)
    own = f"{__name__}:Double"
    found = {}
    for cbam in ("off", own):
        backbone = Backbone(3, (8,), decoder_width=8, num_groups=4, cbam=cbam)
        variables = small.drawn(backbone, x)
        assert "cbam_1" not in variables["params"]
        variables = jax.tree.map(jnp.asarray, variables)
        found[cbam] = backbone.apply(variables, x)
    assert np.abs(found["off"] - found[own]).max() > 0.1
    with pytest.raises(UserError, match="cbam is 'x', expected 'official' or 'paper'"):
        RadeNetOptions(cbam="x")


@pytest.mark.parametrize(("doppler_bins", "there"), [(0, "elevation"), (3, "doppler")])
def test_the_stem_encodes_no_half_without_channels(doppler_bins, there):
    stem = InputStem(8, doppler_bins, 4)
    x = jnp.ones((1, 4, 4, 3))
    variables = small.drawn(stem, x)
    assert set(variables["params"]) == {there, "mix"}
    assert stem.apply(variables, x).shape == (1, 4, 4, 8)
