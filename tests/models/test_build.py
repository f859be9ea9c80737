"""Tests of `radejax.models`."""

import pytest

from radejax import models
from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid

from .. import small_models as small

GRID = RadarGrid.reduced(num_doppler=2, num_range=13, num_elevation=2, num_azimuth=11)


def test_map_grid_follows_padding_and_cropping() -> None:
    model = models.build(base_config().model)
    padded = models.map_grid(GRID, model.clone(crop_output=False), "true")
    assert (padded.num_range, padded.num_azimuth) == (16, 16)
    cropped = models.map_grid(GRID, model.clone(crop_output=True), "true")
    assert cropped == GRID
    stretched = models.map_grid(GRID, model.clone(crop_output=True), "stretched")
    assert stretched.num_azimuth == 11
    assert stretched.azimuth_step_rad < GRID.azimuth_step_rad
    assert not models.has_camera(model)


CHOICES = {
    "name": "radenet",
    "backbone": "unet",
    "neck": "dilated",
    "heads": "expanded",
    "cbam": "official",
    "dtype": "bfloat16",
    "remat": "blocks",
    "image.kind": "resnet50",
    "image.attention": "blocked",
    "fusion.weighting": "mlp",
    "fusion.gate": "bin",
    "fusion.out_of_view": "official",
}


@pytest.mark.parametrize("field", CHOICES)
def test_an_unknown_name_is_rejected_with_those_that_there_are(field: str) -> None:
    config = small.camera_config().model.to_dict()
    section, _, name = field.rpartition(".")
    (config[section] if section else config)[name] = "wide"
    words = rf"config.model.{field} is 'wide'.*'{CHOICES[field]}'"
    with pytest.raises(UserError, match=words):
        models.build(config)


def test_a_module_made_by_hand_is_checked() -> None:
    model = models.build(small.radar_config().model)
    with pytest.raises(UserError, match=r"model.neck is 'wide', expected .*'plain'"):
        model.clone(neck="wide")


def test_an_axis_may_have_no_channels_but_not_both() -> None:
    config = small.radar_config().model
    config.elevation_bins = 0
    assert models.build(config).elevation_bins == 0
    config.doppler_bins = 0
    with pytest.raises(UserError, match=r"elevation_bins is 0, expected above 0 if"):
        models.build(config)
    config.update(doppler_bins=-1, elevation_bins=3)
    with pytest.raises(UserError, match=r"doppler_bins is -1, expected an integer"):
        models.build(config)


def test_elevation_weights_need_elevation_channels() -> None:
    config = small.camera_config().model
    config.elevation_bins = 0
    with pytest.raises(UserError, match=r"weighting is 'mlp', expected 'off' without"):
        models.build(config)
    config.fusion.weighting = "off"
    assert models.build(config).elevation_bins == 0
