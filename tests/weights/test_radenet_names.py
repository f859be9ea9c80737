"""Tests of `radejax.weights.radenet_names`."""

import json

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.models.radenet import RadeNet
from radejax.weights.radenet_names import (
    from_torch_layout,
    to_torch_layout,
    torch_names,
    torch_shapes,
)

VARIANTS = {
    "default": {},
    "stem": {"input_stem": True},
    "expand256": {"decoder_width": 256},
    "default_heads": {"heads": "default"},
    "default_neck": {"neck": "plain"},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_names_and_shapes_are_the_official_ones(variant, shared):
    listing = json.loads(
        (shared / f"fixtures/radenet/{variant}_params.json").read_text()
    )
    expected = {e["name"]: tuple(e["shape"]) for e in listing["tensors"]}
    assert torch_shapes(RadeNet(5, **VARIANTS[variant])) == expected


@pytest.mark.parametrize("part", ["backbone", "neck", "heads"])
def test_parts_that_were_never_released_have_no_names(part):
    with pytest.raises(UserError, match=rf"{part} 'wide' has no names in the released"):
        torch_names(RadeNet(5, **{part: "wide"}))


def test_names_by_hand():
    names = torch_names(RadeNet(5))
    assert len(names) == len(set(names.values())) == 176
    conv = ("backbone", "encoder_2", "conv_1", "conv", "kernel")
    assert names[conv] == "backbone.encoder_block_2.double_conv.0.single_conv.0.weight"
    norm = ("heads", "box", "conv_3", "norm", "scale")
    assert names[norm] == "head.reg_head.head.7.weight"
    shortcut = ("backbone", "decoder_1", "shortcut", "bias")
    assert names[shortcut] == "backbone.decoder_block_1.adjust_input.bias"


@pytest.mark.parametrize(
    ("name", "ours", "theirs"),
    [
        ("backbone.start_conv.weight", (3, 3, 5, 7), (7, 5, 3, 3)),
        ("backbone.upsample_1.upsample.weight", (2, 2, 5, 7), (5, 7, 2, 2)),
        ("backbone.cbam_1.channel_attention.fc1.weight", (5, 7), (7, 5)),
        ("neck.neck.0.gn.weight", (5,), (5,)),
    ],
)
def test_layouts(name, ours, theirs):
    value = np.arange(np.prod(ours)).reshape(ours)
    converted = to_torch_layout(name, value)
    assert converted.shape == theirs
    np.testing.assert_array_equal(from_torch_layout(name, converted), value)
