"""Tests of radejax.visualize.camera_share."""

import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.camera_share import draw_camera_share


@pytest.fixture
def grid():
    return RadarGrid.reduced(
        num_doppler=4, num_range=8, num_elevation=3, num_azimuth=6, max_range_m=60.0
    )


def test_panels_are_named_and_share_one_scale_without_what_is_not_in_view(grid):
    maps = {"all": np.full((8, 8), 0.5), "fog": np.full((8, 8), 0.2)}  # padded columns
    maps["all"][:, 0] = 0.0
    figure = draw_camera_share(maps, grid, counts={"all": 3, "fog": 1})
    panels = [ax for ax in figure.axes if ax.get_images()]
    assert [ax.get_title() for ax in panels] == [
        "all\nmean 0.50, 3 frames",
        "fog\nmean 0.20, 1 frames",
    ]
    for ax in panels:
        picture = ax.get_images()[0]
        assert picture.get_array().shape == (8, 6)
        assert picture.get_clim() == (0.2, 0.5)
    assert panels[0].get_images()[0].get_array().mask[:, 0].all()
    assert "camera" in figure.axes[-1].get_ylabel()


def test_no_bin_in_view(grid):
    figure = draw_camera_share({"all": np.zeros((8, 6))}, grid)
    assert figure.axes[0].get_images()[0].get_clim() == (0.0, 1.0)
    assert figure.axes[0].get_title() == "all\nnot in view"


def test_notebooks_show_it_once(grid):
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    draw_camera_share({"all": np.full((8, 6), 0.5)}, grid)
    assert plt.get_fignums() == before
