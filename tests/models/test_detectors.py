"""Tests of `radejax.models.detectors`."""

from radejax import models
from radejax.core.config import base_config
from radejax.geometry.radar_grid import RadarGrid

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
