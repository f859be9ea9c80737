"""Tests of `radejax.models.summary`."""

import pytest

from radejax.models.radenet import RadeNet, from_config
from radejax.models.summary import Cost, summarize, table


@pytest.fixture(scope="module")
def costs():
    return summarize(RadeNet(5))


def test_parameters_add_up_to_the_released_count(costs):
    assert sum(cost.num_parameters for cost in costs.values()) == 28_336_878


def test_start_convolution_by_hand(costs):
    start = costs["backbone/start"]
    assert start.num_parameters == 101 * 128 * 9 + 128
    assert start.flops == 2 * 256 * 112 * 128 * 9 * 101
    assert start.activation_bytes == 256 * 112 * 128 * 4


def test_upsampling_by_hand(costs):
    # Each of 256 x 112 bins is one product of a 128-vector with a 128 x 128 matrix.
    assert costs["backbone/upsample_3"].flops == 2 * 256 * 112 * 128 * 128


def test_batch_scales_everything_but_parameters(costs):
    double = summarize(RadeNet(5), batch=2)
    for part, cost in costs.items():
        expected = Cost(cost.num_parameters, 2 * cost.flops, 2 * cost.activation_bytes)
        assert double[part] == expected


def test_bfloat16_halves_the_maps(costs):
    narrow = summarize(RadeNet(5, dtype="bfloat16"))["backbone/encoder_1"]
    assert 2 * narrow.activation_bytes == costs["backbone/encoder_1"].activation_bytes


def test_every_variant_has_a_table(radenet_golden):
    for changes in radenet_golden["VARIANTS"].values():
        model = from_config(radenet_golden["SMALL"] | changes)
        text = table(summarize(model, num_range=16, num_azimuth=13))
        assert text.splitlines()[-1].startswith("total")


def test_table_ends_with_the_total(costs):
    assert "28,336,878" in table(costs).splitlines()[-1]
