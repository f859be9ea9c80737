"""One frame on radar and camera."""

import pathlib

import numpy as np
import pytest
from PIL import Image

from radejax.cli.overlay import draw_overlay
from radejax.core.errors import UserError
from radejax.simulation.dataset import default_config, simulate_dataset


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """One simulated sequence of one frame."""
    folder = tmp_path_factory.mktemp("overlay") / "data"
    config = default_config()
    config.update(train_sequences=1, test_sequences=0, frames_per_sequence=1)
    return simulate_dataset(config, folder, progress=False)


def test_the_first_frame_of_a_sequence_is_drawn(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    draw_overlay("1", [root], tmp_path / "first.png")
    picture = np.asarray(Image.open(tmp_path / "first.png").convert("RGB"))
    assert picture.shape[0] > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("first", "expected sequence/radar_lidar"),
        ("1/00000_00000", "no frame 00000_00000 in sequence 1; there are"),
        ("7", r"no labels of sequences \[7\]"),
    ],
)
def test_a_frame_that_is_not_there_is_named(
    name: str, message: str, root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    with pytest.raises(UserError, match=message):
        draw_overlay(name, [root], tmp_path / "none.png")


def test_slices_and_a_sequence_in_motion(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    assert draw_overlay("1", [root], tmp_path / "slices.png", slices=True) == 1
    with Image.open(tmp_path / "slices.png") as picture:
        width, height = picture.size
    assert width > 2.5 * height  # three planes side by side
    assert draw_overlay("1", [root], tmp_path / "all.gif", max_frames=3) == 1
    with Image.open(tmp_path / "all.gif") as picture:
        assert picture.format == "GIF"
