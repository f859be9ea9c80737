"""Tests of radejax.visualize.camera_share."""

import json
import pathlib

import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.camera_share import (
    average_by_group,
    draw_camera_share,
    write_camera_share,
)


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
        "all\nmean 0.500, 3 frames",
        "fog\nmean 0.200, 1 frames",
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


def test_bins_out_of_view_and_frames_without_image_do_not_count(
    tmp_path: pathlib.Path,
) -> None:
    grid = RadarGrid.reduced(
        num_doppler=2, num_range=2, num_elevation=2, num_azimuth=2, max_range_m=20.0
    )
    first = np.array([[0.0, 0.2], [0.4, 0.0]])
    second = np.array([[0.0, 0.6], [0.0, 0.0]])
    nothing = np.zeros((2, 2))
    shares = [("fog", first), ("rain", second), ("fog", nothing), ("snow", nothing)]
    maps, counts = average_by_group(shares)
    assert list(maps) == ["all", "fog", "rain", "snow"]
    assert counts == {"all": 2, "fog": 1, "rain": 1, "snow": 0}
    np.testing.assert_allclose(maps["all"], [[0.0, 0.4], [0.4, 0.0]])
    np.testing.assert_allclose(maps["fog"], first)
    padded = {
        name: np.pad(share, (0, 3), constant_values=1) for name, share in maps.items()
    }
    write_camera_share(tmp_path, padded, counts, grid)
    summary = json.loads((tmp_path / "camera_share.json").read_text())
    assert summary["all"] == {"mean": pytest.approx(0.4), "frames": 2}
    assert summary["fog"] == {"mean": pytest.approx(0.3), "frames": 1}
    assert summary["snow"] == {"mean": None, "frames": 0}
    assert (tmp_path / "camera_share.png").is_file()
