"""Frames on radar and camera, and in a recording."""

import pathlib
import shutil
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from PIL import Image

import radejax
from radejax.config import Config
from radejax.core.structures import Boxes
from radejax.data.kradar import KRadar
from radejax.detection.decode import DecodeOptions
from radejax.visualize import style

from .. import small_models as small
from ..commands import run


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """One simulated sequence of one frame."""
    sizes = {"train_sequences": 1, "test_sequences": 0, "frames_per_sequence": 1}
    folder = tmp_path_factory.mktemp("overlay") / "data"
    return small.simulate(folder, **sizes, output="tesseract")


@pytest.fixture
def drawn(monkeypatch):
    """Figures that commands draw, which are not written."""
    found = []
    monkeypatch.setattr(style, "save_figure", lambda figure, _: found.append(figure))
    return found


def _run(name, roots, *words, code=0):
    return run("overlay", name, "--data", roots, *words, code=code)


def test_frames_have_several_names(root, drawn):
    (name,) = (path.stem for path in (root / "1").glob("info_label*/*"))
    weather = (root / "1" / "description.txt").read_text().strip().split(",")[2]
    half = name.partition("_")[0]  # as files of `radejax detect` are named
    for given in ("1", f"1/{half}", f"1/{name}"):
        _run(given, root)
    _run("", root, "--weather", weather)
    assert len({figure.get_suptitle() for figure in drawn}) == 1
    assert len(drawn) == 4
    other = "rain" if weather == "fog" else "fog"
    for words, message in (
        (("first",), "expected sequence/radar_lidar"),
        (("",), "expected sequence/radar_lidar"),
        (("1/00000_00000",), "no frame 00000_00000 in sequence 1; there are"),
        (("7",), "of sequences [7]; there are [1]"),
        (("", "--sequences", 1, "--weather", other), "no frames of these sequences"),
    ):
        assert message in _run(words[0], root, *words[1:], code=2).output


def test_figures_slices_and_a_sequence_in_motion(root, tmp_path):
    sizes = []
    options = {"a.png": (), "slices.png": ("--slices",), "all.gif": ("--max-frames", 3)}
    for name, words in options.items():
        _run("1", root, "--out", tmp_path / name, *words)
        with Image.open(tmp_path / name) as picture:
            assert picture.format == name[-3:].upper()
            colors = picture.convert("RGB").getcolors(1 << 24)
            assert len(colors) > 50
            sizes.append(picture.size)
    assert sizes[0][1] > 300
    assert sizes[1][0] > 2.5 * sizes[1][1]  # three planes side by side


def test_boxes_that_cannot_be_drawn_on_the_image_are_reported(root, tmp_path, drawn):
    ignore = shutil.ignore_patterns("calib")  # as on K-Radar's disks
    disk = pathlib.Path(shutil.copytree(root, tmp_path / "disk", ignore=ignore))
    out, given = tmp_path / "a.png", ("--camera-calibration", root / "calib")
    no_calibration = "0 of 1 frames have no front image, 1 no camera calib"
    text = _run("1", disk, "--out", out).output
    assert no_calibration in text
    assert "--camera-calibration FOLDER" in text
    for place, words in ((root, ()), (disk, given), (disk, ("--slices",))):
        assert _run("1", place, "--out", out, *words).output == f"drew {out}\n"
    images = [next(ax for ax in figure.axes if ax.images) for figure in drawn[:3]]
    has_boxes = [bool(image.collections) for image in images]
    assert has_boxes == [False, True, True]
    (image,) = disk.glob("1/cam-front/*")
    image.unlink()
    text = _run("1", disk, "--out", out, *given).output
    assert "1 of 1 frames have no front image, 0 no camera calib" in text


def test_detections_of_a_run_are_drawn_beside_the_labels(root, drawn, monkeypatch):
    grid = KRadar([root]).grid
    found = Boxes.one_frame([[20.0, 0, 0, 4, 2, 1.5, 0]], ["Sedan"], [0.9])

    asked = []

    class Detector:
        takes_camera = False
        decode_options = DecodeOptions(score_threshold=0.25)
        saved = SimpleNamespace(config=Config())

        def __init__(self, _, score_threshold):
            self.grid = grid
            asked.append(score_threshold)

        def __call__(self, *_):
            return SimpleNamespace(to_boxes=lambda: found)

    monkeypatch.setattr(radejax.Detector, "from_workdir", Detector)
    _run("1", root, "--workdir", root, "--score-threshold", "0.3,Bicycle=0.1")
    assert asked == ["0.3,Bicycle=0.1"]
    texts = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert texts[4] == "false positive (1)"
    assert texts[-1] == "score ≥ 0.25, IoU > 0.3"
    assert "Sedan 0.90" in [text.get_text() for text in drawn[0].axes[0].texts]
    error = _run("1", root, "--workdir", root, "--slices", code=2).stderr
    assert "--slices shows no detections" in error
    error = _run("1", root, "--score-threshold", 0.3, code=2).stderr
    assert "--score-threshold selects detections: give --workdir RUN" in error


def test_lidar_points_are_drawn_in_the_radar_frame(root, tmp_path, monkeypatch, drawn):
    (frame,) = KRadar(root)
    name = f"os2-64_{frame.header.lidar:05d}.pcd"
    text = _run("1", root, "--lidar", code=2).output
    assert f"frame {frame.key}: no os2-64/{name} in any root" in text
    disk = tmp_path / "disk"  # the scans are on another disk
    (disk / "1" / "os2-64").mkdir(parents=True)
    header = "FIELDS x y z intensity\nPOINTS 1\nDATA ascii\n"
    (disk / "1" / "os2-64" / name).write_text(f"{header}30 2 1 0\n")
    draw = mock.Mock(wraps=radejax.draw_frame)
    monkeypatch.setattr(radejax, "draw_frame", draw)
    _run("1", f"{root},{disk}", "--lidar")
    (scene,) = draw.call_args.args
    np.testing.assert_allclose(scene.lidar_m, [[30 - 2.54, 2 + 0.3, 1]])
    assert frame.radar_from_lidar_m[:2] == (-2.54, 0.3)
    text = _run("1", f"{root},{disk}", "--lidar", "--slices", code=2).output
    assert "--slices shows no LiDAR points" in text
