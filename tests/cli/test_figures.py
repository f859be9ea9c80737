"""Frames on radar and camera, and in a recording."""

import pathlib
import shutil

import click.testing
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import radejax
from radejax.cli.figures import overlay, viewer_scenes
from radejax.data.kradar import KRadar
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.visualize import style

ONE_FRAME = SimulationOptions(
    train_sequences=1, test_sequences=0, frames_per_sequence=1
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """One simulated sequence of one frame."""
    folder = tmp_path_factory.mktemp("overlay") / "data"
    return simulate_dataset(ONE_FRAME, folder, progress=False)


@pytest.fixture
def without_calibration(root: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
    """A copy of the sequence, as on K-Radar's disks."""
    ignore = shutil.ignore_patterns("calib")
    return pathlib.Path(shutil.copytree(root, tmp_path / "disk", ignore=ignore))


def _run(name: str, root: object, *arguments: object) -> click.testing.Result:
    words = [name, "--data", str(root), *map(str, arguments)]
    return click.testing.CliRunner().invoke(overlay, words)


def test_the_first_frame_of_a_sequence_is_drawn(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    done = _run("1", root, "--out", tmp_path / "first.png")
    assert done.exit_code == 0, done.output
    (name,) = (path.stem for path in (root / "1").glob("info_label*/*"))
    half = name.partition("_")[0]  # as files of `radejax detect` are named
    done = _run(f"1/{half}", root, "--out", tmp_path / "half.png")
    assert done.exit_code == 0, done.output
    first = (tmp_path / "first.png").read_bytes()
    assert first == (tmp_path / "half.png").read_bytes()
    picture = np.asarray(Image.open(tmp_path / "first.png").convert("RGB"))
    assert picture.shape[0] > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("first", "expected sequence/radar_lidar"),
        ("1/00000_00000", "no frame 00000_00000 in sequence 1; there are"),
        ("7", "of sequences [7]; there are [1]"),
        ("", "expected sequence/radar_lidar"),
    ],
)
def test_a_frame_that_is_not_there_is_named(
    name: str, message: str, root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    done = _run(name, root, "--out", tmp_path / "none.png")
    assert done.exit_code == 2
    assert message in done.output


def test_slices_and_a_sequence_in_motion(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    slices = tmp_path / "slices.png"
    assert _run("1", root, "--out", slices, "--slices").exit_code == 0
    with Image.open(slices) as picture:
        width, height = picture.size
    assert width > 2.5 * height  # three planes side by side
    done = _run("1", root, "--out", tmp_path / "all.gif", "--max-frames", 3)
    assert done.exit_code == 0, done.output
    with Image.open(tmp_path / "all.gif") as picture:
        assert picture.format == "GIF"


def test_boxes_that_cannot_be_drawn_on_the_image_are_reported(
    root: pathlib.Path, without_calibration: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out, given = tmp_path / "a.png", ("--camera-calibration", root / "calib")
    done = _run("1", root, "--out", out)
    assert done.output == f"drew {out}\n"
    complete = out.read_bytes()
    done = _run("1", without_calibration, "--out", out)
    assert done.exit_code == 0, done.output
    assert "0 of 1 frames have no front image, 1 no camera calib" in done.output
    assert "--camera-calibration FOLDER" in done.output
    assert out.read_bytes() != complete
    done = _run("1", without_calibration, "--out", out, *given)
    assert done.output == f"drew {out}\n"
    assert out.read_bytes() == complete
    (image,) = without_calibration.glob("1/cam-front/*")
    image.unlink()
    done = _run("1", without_calibration, "--out", out, *given)
    assert "1 of 1 frames have no front image, 0 no camera calib" in done.output
    done = _run("1", without_calibration, "--out", out, "--slices")
    assert done.output == f"drew {out}\n"


def test_a_part_of_the_data_is_drawn(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    weather = (root / "1" / "description.txt").read_text().strip().split(",")[2]
    done = _run("", root, "--weather", weather, "--out", tmp_path / "part.png")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "part.png").is_file()
    other = "rain" if weather == "fog" else "fog"
    done = _run("", root, "--sequences", 1, "--weather", other)
    assert done.exit_code == 2
    assert "no frames of these sequences and weathers" in done.output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "narrow region"),
        (("--roi", "wide"), "wide region"),
        (("--roi=none",), None),
    ],
)
def test_the_region_is_that_of_the_evaluation_and_named(
    arguments: tuple[str, ...],
    expected: str | None,
    root: pathlib.Path,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = []
    monkeypatch.setattr(style, "save_figure", lambda figure, _: drawn.append(figure))
    assert _run("1", root, "--out", tmp_path / "a.png", *arguments).exit_code == 0
    texts = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert texts[1:] == ([expected] if expected else [])


def test_frames_with_projections_only_are_shown(tmp_path: pathlib.Path) -> None:
    options = ONE_FRAME.replace(output="projection")
    root = simulate_dataset(options, tmp_path / "data", progress=False)
    frames = KRadar([root], visibility=None)
    (shown,) = viewer_scenes(frames, frames.grid)
    stored = np.load(frames[0].projection_path)
    np.testing.assert_allclose(shown.projection, np.moveaxis(stored, 0, -1))


def test_lidar_points_are_drawn_in_the_radar_frame(
    root: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = _run("1", root, "--lidar", "--out", tmp_path / "lidar.png")
    assert done.exit_code == 2
    (frame,) = data = KRadar(root)
    name = f"os2-64_{frame.header.lidar:05d}.pcd"
    assert f"frame {frame.key}: no os2-64/{name} in any root" in done.output
    disk = tmp_path / "disk"  # the scans are on another disk
    (disk / "1" / "os2-64").mkdir(parents=True)
    header = "FIELDS x y z intensity\nPOINTS 1\nDATA ascii\n"
    (disk / "1" / "os2-64" / name).write_text(f"{header}30 2 1 0\n")
    drawn = []

    def draw(scene: style.Scene) -> Figure:
        drawn.append(scene.lidar_m)
        return draw_frame(scene)

    draw_frame = radejax.draw_frame
    monkeypatch.setattr(radejax, "draw_frame", draw)
    roots = f"{root},{disk}"
    done = _run("1", roots, "--lidar", "--out", tmp_path / "lidar.png")
    assert done.exit_code == 0, done.output
    np.testing.assert_allclose(drawn[0], [[30 - 2.54, 2 + 0.3, 1]])
    assert data[0].radar_from_lidar_m[:2] == (-2.54, 0.3)
    done = _run("1", roots, "--lidar", "--slices", "--out", tmp_path / "lidar.png")
    assert done.exit_code == 2
    assert "--slices shows no LiDAR points" in done.output
