"""Frames in folders, their images, models of every kind, names of results."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest

from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.cameras import CameraOptions
from radejax.evaluation.files import Source
from radejax.evaluation.files import load as load_tables
from radejax.inference.detect_files import (
    detect_files,
    find_frames,
    front_images,
    key_of,
)
from radejax.inference.saved import load_model, save_model
from radejax.models.options import DinoRadeOptions, ImageOptions
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset

from .. import small_models as small


@pytest.fixture
def root(tmp_path):
    for name in (
        "5/radar_tesseract/tesseract_00033.mat",
        "5/radar_tesseract/tesseract_00034.mat",
        "5/DERA_tesseract/DERA_tesseract_00034.npy",
        "5/info_label/00033_00001.txt",
        "6/radar_tesseract/tesseract_00033.mat",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def test_every_frame_is_found_once_and_its_projection_preferred(root, monkeypatch):
    found = [path.relative_to(root).as_posix() for path in find_frames([root])]
    assert sorted(found) == [
        "5/DERA_tesseract/DERA_tesseract_00034.npy",
        "5/radar_tesseract/tesseract_00033.mat",
        "6/radar_tesseract/tesseract_00033.mat",
    ]
    assert find_frames([root, root / "5"]) == find_frames([root])
    monkeypatch.chdir(root)
    assert len(find_frames([root, "."])) == 3


def test_names_of_results_are_unique_among_sequences(root):
    names = {key_of(path).replace("/", "_") for path in find_frames([root])}
    assert names == {"5_00033", "5_00034", "6_00033"}


def test_a_part_of_the_frames(root):
    for sequence, weather in (("5", "fog"), ("6", "rain")):
        (root / sequence / "description.txt").write_text(f"urban,day,{weather}\n")
    assert [key_of(p) for p in find_frames([root], (6, 9))] == ["6/00033"]
    assert len(find_frames([root], weather=("fog",))) == 2
    with pytest.raises(UserError, match=r"no frames for .*, 5, rain: looked for"):
        find_frames([root], (5,), ("rain",))


def test_nothing_found_and_nothing_there(tmp_path):
    with pytest.raises(UserError, match=r"no frames for .*: looked for tesseract_\*"):
        find_frames([tmp_path])
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        find_frames([tmp_path / "gone"])


def test_boxes_of_an_exported_folder(tmp_path):
    detector = small.detector(batch_sizes=(2,))  # as below
    save_model(detector.saved, tmp_path / "packed")
    frames = small.projections(3)
    for i, frame in enumerate(frames):
        path = tmp_path / "data" / "7" / "DERA_tesseract" / f"DERA_tesseract_{i:05}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.moveaxis(frame, -1, 0))
    out = tmp_path / "out"
    count = detect_files(tmp_path / "packed", [tmp_path / "data"], out, batch_size=2)
    expected = detector(frames).to_list()
    assert count.pop("clipped") == detector(frames).num_clipped.sum()
    assert count == {"frames": 3, "boxes": sum(map(len, expected))}
    for i, boxes in enumerate(expected):
        found = json.loads((out / f"7_{i:05}.json").read_text())
        assert [b["cls"] for b in found] == [b["cls"] for b in boxes]
        assert [b["x"] for b in found] == pytest.approx(
            [b["x"] for b in boxes], abs=1e-5
        )
        assert all(b["frame"] == f"7/{i:05}" for b in found)
    model, data, text = tmp_path / "packed", [tmp_path / "data"], tmp_path / "k"
    detect_files(model, data, text, batch_size=2, file_format="kitti")
    detect_files(model, data, tmp_path / "t", batch_size=2, file_format="csv")
    with open(tmp_path / "t" / "boxes.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == [
        f"7/{i:05}" for i, boxes in enumerate(expected) for _ in boxes
    ]
    assert float(rows[0]["yaw"]) == pytest.approx(expected[0][0]["yaw"], abs=1e-5)
    # Either is scored against labels whose frames have the key of both sensors.
    table = {
        "frame": [4, 5],
        "sequence": [7, 7],
        "name": ["00002_00011", "00001_00010"],
    }
    files.write_json(tmp_path / "truth.json", [])
    files.write_json(tmp_path / "frames.json", table)
    source = Source(ground_truth=str(tmp_path / "truth.json"))
    _, found, *_ = load_tables(out, source, detector.classes)
    counts = np.bincount(found.frame, minlength=6).tolist()
    assert counts == [0, 0, 0, 0, len(expected[2]), len(expected[1])]
    _, kitti, *_ = load_tables(tmp_path / "k", source, detector.classes)
    found, kitti = (boxes.take(np.argsort(boxes.score)) for boxes in (found, kitti))
    for name in ("frame", "box", "cls"):
        np.testing.assert_array_equal(getattr(found, name), getattr(kitti, name))
    with pytest.raises(UserError, match=r"packed holds one model .* step=best"):
        load_model(tmp_path / "packed", step="best")


def test_preceding_frames_of_files_are_of_their_sequence(tmp_path):
    """Frames 7, 8 and 10 of a sequence, and 11 of the next one."""
    detector = small.detector(num_frames=2, batch_sizes=(2,))
    save_model(detector.saved, tmp_path / "packed")
    names = ("1/DERA_tesseract/DERA_tesseract_00007.npy",)
    names += ("1/DERA_tesseract/DERA_tesseract_00008.npy",)
    names += ("1/DERA_tesseract/DERA_tesseract_00010.npy",)
    names += ("2/DERA_tesseract/DERA_tesseract_00011.npy",)
    frames = small.projections(4)
    for name, frame in zip(names, frames, strict=True):
        path = tmp_path / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.moveaxis(frame, -1, 0))
    expected = detector(np.stack([frames[[0, 0, 2, 3]], frames], 1)).to_list()
    for batch_size in (1, 2, 8):
        out = tmp_path / f"out{batch_size}"
        count = detect_files(
            tmp_path / "packed", [tmp_path / "data"], out, batch_size=batch_size
        )
        assert (count["frames"], count["repeated"]) == (4, 3)
        for path, boxes in zip(sorted(out.iterdir()), expected, strict=True):
            found = json.loads(path.read_text())
            assert [b["score"] for b in found] == pytest.approx(
                [b["score"] for b in boxes], abs=1e-5
            )


def test_two_frames_of_one_name_are_rejected(tmp_path):
    for disk in ("a", "b"):
        path = tmp_path / disk / "5" / "radar_tesseract" / "tesseract_00033.mat"
        path.parent.mkdir(parents=True)
        path.touch()
    save_model(small.saved(), tmp_path / "model")
    with pytest.raises(UserError, match=r"a/5/.* and .*b/5/.* frame 5/00033"):
        detect_files(
            tmp_path / "model", [tmp_path / "a", tmp_path / "b"], tmp_path / "out"
        )


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
