"""Tests of `radejax.models`."""

import pytest

from radejax import models
from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.options import DinoRadeOptions, RadeNetOptions
from radejax.models.radenet import RadeNet

GRID = RadarGrid.reduced(num_doppler=2, num_range=13, num_elevation=2, num_azimuth=11)


def test_map_grid_follows_padding_and_cropping():
    model = models.build(RadeNetOptions())
    whole = models.build(RadeNetOptions(crop_output=False))
    padded = models.map_grid(GRID, whole, "true")
    assert (padded.num_range, padded.num_azimuth) == (16, 16)
    cropped = models.map_grid(GRID, model, "true")
    assert cropped == GRID
    stretched = models.map_grid(GRID, model, "stretched")
    assert stretched.num_azimuth == 11
    assert stretched.azimuth_step_rad < GRID.azimuth_step_rad
    assert not models.has_camera(model)


def test_options_of_another_model_are_rejected():
    with pytest.raises(UserError, match=r"'RadeNetOptions', expected DinoRadeOptions"):
        models.build(RadeNetOptions(name="dinorade"))
    assert models.options_class("radenet") is RadeNetOptions
    assert models.options_class("dinorade") is DinoRadeOptions
    assert models.options_class(f"{__name__}:Own") is OwnOptions


class OwnOptions(RadeNetOptions):
    exponent: float = 2.0


class Own(RadeNet):
    options: OwnOptions
