"""Averages of the camera's share count what the camera sees, and nothing else."""

import json
import pathlib

import numpy as np
import pytest
from radejax.runs.camera_share import average_by_group, write_camera_share

from radejax.geometry.radar_grid import RadarGrid


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
