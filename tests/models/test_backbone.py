"""Tests of `radejax.models.backbone`; the whole is checked in test_radenet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax.models.backbone import (
    CBAM,
    Backbone,
    ChannelAttention,
    InputStem,
    SpatialAttention,
)

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


def test_skips_are_joined_after_the_upsampled_map():
    # decoder_1 reads [upsampled 32, skip 32]: zeroing its first 32 input channels must
    # hide the bottleneck and leave the skip.
    backbone = Backbone(8, (16, 32), decoder_width=16, num_groups=8, cbam="off")
    x = jax.random.normal(jax.random.key(1), (1, 8, 8, 13))
    variables = backbone.init(jax.random.key(0), x)
    decoder = variables["params"]["decoder_1"]
    cut = jnp.arange(64) >= 32
    for conv in (decoder["conv_1"]["conv"], decoder["shortcut"]):
        conv["kernel"] = conv["kernel"] * cut[None, None, :, None]
    y = backbone.apply(variables, x)
    variables["params"]["bottleneck_2"] = jax.tree.map(
        jnp.zeros_like, variables["params"]["bottleneck_2"]
    )
    variables["params"]["upsample_1"]["bias"] += 5.0
    np.testing.assert_array_equal(backbone.apply(variables, x), y)


STEM = {
    f"{part}/{ours}": f"{part}_conv.{theirs}"
    for part in ("doppler", "elevation", "mix")
    for ours, theirs in (("conv", "0"), ("norm", "1"))
}
CHANNEL = {"squeeze": "fc1", "excite": "fc2"}
BLOCK = {
    "channel/squeeze": "channel_attention.fc1",
    "channel/excite": "channel_attention.fc2",
    "spatial/conv": "spatial_attention.convolution",
    "start/conv": "start_conv.single_conv.0",
    "start/norm": "start_conv.single_conv.1",
    "end/conv": "end_conv.single_conv.0",
    "end/norm": "end_conv.single_conv.1",
}


@pytest.mark.parametrize(
    ("case", "module", "names"),
    [
        ("input_stem", InputStem(128, 64, 32), STEM),
        ("channel_attention", ChannelAttention(), CHANNEL),
        ("channel_attention_small", ChannelAttention(), CHANNEL),
        ("spatial_attention", SpatialAttention(), {"conv": "convolution"}),
        ("cbam_block", CBAM("official", 32), BLOCK),
    ],
)
def test_parts_equal_the_official_ones(
    case, module, names, module_case, run_like_torch
):
    x, expected = module_case(case)
    actual = run_like_torch(module, names, x)
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
    windows = np.lib.stride_tricks.sliding_window_view(pooled, (7, 7), (0, 1))
    attention = np.einsum("ijckl,klc->ij", windows, conv["kernel"][..., 0])
    expected = y * sigmoid(attention + conv["bias"])[None, ..., None]
    assert set(p) == {"channel", "spatial"}  # no convolutions of the map
    found = module.apply(variables, jnp.asarray(x))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("doppler_bins", "there"), [(0, "elevation"), (3, "doppler")])
def test_the_stem_encodes_no_half_without_channels(doppler_bins, there):
    stem = InputStem(8, doppler_bins, 4)
    x = jnp.ones((1, 4, 4, 3))
    variables = small.drawn(stem, x)
    assert set(variables["params"]) == {there, "mix"}
    assert stem.apply(variables, x).shape == (1, 4, 4, 8)
