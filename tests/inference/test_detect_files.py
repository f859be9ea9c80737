"""Frames in folders, their images, and the files of their boxes."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest

from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.kradar.radar_files import find_frames
from radejax.data.options import CameraOptions
from radejax.evaluation.files import Source
from radejax.evaluation.files import load as load_tables
from radejax.inference.detect_files import detect_files, find_inputs, front_images
from radejax.inference.detector import Detector
from radejax.models.options import DinoRadeOptions, ImageOptions
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset

from .. import small_models as small


def _write_projections(folder, names, frames):
    for name, frame in zip(names, frames, strict=True):
        path = folder / name.replace("/", "/DERA_tesseract/DERA_tesseract_")
        path = path.with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.moveaxis(frame, -1, 0))


def test_every_format_has_the_same_boxes(tmp_path):
    detector = small.detector(batch_sizes=(2,))
    frames, keys = small.projections(3), [f"7/0000{i}" for i in range(3)]
    _write_projections(tmp_path / "data", keys, frames)
    inputs = find_inputs(detector, [tmp_path / "data"])
    assert inputs.keys == keys
    expected = detector(frames).to_list()
    for file_format in ("json", "kitti", "csv"):
        out = tmp_path / file_format
        count, failed = detect_files(
            detector, inputs, out, batch_size=2, file_format=file_format
        )
        clipped = int(detector(frames).to_boxes().is_clipped.sum())
        num_boxes = sum(map(len, expected))
        truncated = int(detector(frames).num_truncated.sum())
        wanted = {"boxes": num_boxes, "clipped": clipped, "truncated": truncated}
        assert count == {"frames": 3, **wanted}
        assert truncated > 0
        assert failed == {}
    rows = [
        {"frame": key, **box}
        for key, boxes in zip(keys, expected, strict=True)
        for box in boxes
    ]
    files_of_frames = sorted((tmp_path / "json").iterdir())
    assert [path.name for path in files_of_frames] == [
        f"7_0000{i}.json" for i in range(3)
    ]
    assert [
        row for path in files_of_frames for row in json.loads(path.read_text())
    ] == rows
    with open(tmp_path / "csv" / "boxes.csv", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert table == [{name: str(x) for name, x in row.items()} for row in rows]
    # Either is scored against labels whose frames have the key of both sensors.
    table = {
        "frame": [4, 5],
        "sequence": [7, 7],
        "name": ["00002_00011", "00001_00010"],
    }
    files.write_json(tmp_path / "truth.json", [])
    files.write_json(tmp_path / "frames.json", table)
    source = Source(ground_truth=str(tmp_path / "truth.json"))
    _, found, *_ = load_tables(tmp_path / "json", source, detector.classes)
    counts = np.bincount(found.frame, minlength=6).tolist()
    assert counts == [0, 0, 0, 0, len(expected[2]), len(expected[1])]
    _, kitti, *_ = load_tables(tmp_path / "kitti", source, detector.classes)
    found, kitti = (boxes.take(np.argsort(boxes.score)) for boxes in (found, kitti))
    for name in ("frame", "box", "cls"):
        np.testing.assert_array_equal(getattr(found, name), getattr(kitti, name))


@pytest.mark.parametrize("file_format", ["json", "kitti", "csv"])
def test_a_frame_with_a_box_that_is_not_finite_fails(
    tmp_path, monkeypatch, file_format
):
    detector = small.detector(score_threshold=0.0)
    keys = [f"7/0000{i}" for i in range(3)]
    _write_projections(tmp_path / "data", keys, small.projections(3))
    inputs = find_inputs(detector, [tmp_path / "data"])
    out = tmp_path / "out"
    assert detect_files(detector, inputs, out, file_format=file_format)[1] == {}
    earlier = sorted(out.rglob("*"))

    def stream(self, frames):
        for item in frames:
            found = self(*item) if isinstance(item, tuple) else self(item)
            yield found.replace(boxes=found.boxes.at[1, 2, 3].set(np.nan))

    monkeypatch.setattr(Detector, "stream", stream)
    count, failed = detect_files(detector, inputs, out, file_format=file_format)
    assert count["frames"] == 2
    assert list(failed) == ["7/00001"]
    assert "row 2: l of the box is nan" in failed["7/00001"]
    left = set(earlier) - set(out.rglob("*"))
    names = {"json": ["7_00001.json"], "kitti": ["000001.txt"], "csv": []}
    assert [path.name for path in left] == names[file_format]
    if file_format == "csv":
        with open(out / "boxes.csv", encoding="utf-8") as file:
            found = {row["frame"] for row in csv.DictReader(file)}
        assert found == {"7/00000", "7/00002"}


def test_preceding_frames_of_files_are_of_their_sequence(tmp_path):
    """Frames 7, 8 and 10 of a sequence, and 11 of the next one."""
    detector = small.detector(num_frames=2, batch_sizes=(2,))
    frames = small.projections(4)
    _write_projections(
        tmp_path / "data", ("1/00007", "1/00008", "1/00010", "2/00011"), frames
    )
    inputs = find_inputs(detector, [tmp_path / "data"])
    expected = detector(np.stack([frames[[0, 0, 2, 3]], frames], 1)).to_list()
    for batch_size in (1, 2, 8):
        out = tmp_path / f"out{batch_size}"
        count, _ = detect_files(detector, inputs, out, batch_size=batch_size)
        assert (count["frames"], count["repeated"]) == (4, 3)
        for path, boxes in zip(sorted(out.iterdir()), expected, strict=True):
            scores = [box["score"] for box in json.loads(path.read_text())]
            assert scores == pytest.approx([box["score"] for box in boxes], abs=1e-5)


def test_two_frames_of_one_name_are_rejected(tmp_path):
    for disk in ("a", "b"):
        path = tmp_path / disk / "5" / "radar_tesseract" / "tesseract_00033.mat"
        path.parent.mkdir(parents=True)
        path.touch()
    with pytest.raises(UserError, match=r"a/5/.* and .*b/5/.* frame 5/00033"):
        find_inputs(small.detector(), [tmp_path / "a", tmp_path / "b"])


def test_images_of_simulated_folders_are_found(tmp_path):
    """Their labels are in `info_label_v2_1`."""
    options = SimulationOptions(
        output="projection", train_sequences=1, test_sequences=0, frames_per_sequence=1
    )
    root = simulate_dataset(options, tmp_path / "data", progress=False)
    (path,) = find_frames([root])
    detector = SimpleNamespace(
        model=models.build(DinoRadeOptions(image=ImageOptions(size=(180, 320)))),
        camera_options=CameraOptions(),
        saved=SimpleNamespace(config=Config()),
    )
    ((found, (image, camera)),) = front_images([path], detector).items()
    assert found == path.absolute()
    assert image.parent.name == "cam-front"
    assert camera.is_valid

    # K-Radar's disks have no camera calibration; its repository does.
    folder = (root / "calib").rename(tmp_path / "repository")
    with pytest.raises(
        UserError, match=r"1 no camera calib.*--camera-calibration FOLD"
    ):
        front_images([path], detector)
    known = front_images([path], detector, camera_calibration=folder)
    np.testing.assert_array_equal(known[found][1].intrinsics, camera.intrinsics)
    image.unlink()
    assert front_images([path], detector) == {}  # only the radar can be used
