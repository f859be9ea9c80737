"""Frames in folders, their images, and the files of their boxes."""

import csv
import json
import os
import pathlib
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.manifest import add
from radejax.data.kradar.radar_files import find_frames
from radejax.data.options import CameraOptions
from radejax.evaluation.files import Source
from radejax.evaluation.files import load as load_tables
from radejax.inference.detect_files import (
    FrameInputs,
    detect_files,
    find_inputs,
    front_images,
)
from radejax.inference.detector import Detector
from radejax.models.options import DinoRadeOptions, ImageOptions

from .. import small_models as small


def _write_projections(folder, names, frames):
    for name, frame in zip(names, frames, strict=True):
        path = folder / name.replace("/", "/DERA_tesseract/DERA_tesseract_")
        path = path.with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.moveaxis(frame, -1, 0))


def test_own_outputs_are_columns_of_the_table(tmp_path, caplog):
    detector = small.detector_with_output()
    frames, keys = small.projections(2), ["7/00000", "7/00001"]
    _write_projections(tmp_path / "data", keys, frames)
    inputs = find_inputs(detector, [tmp_path / "data"])
    expected = detector(frames).to_boxes().extras["velocity"]
    assert len(expected) > 0
    detect_files(detector, inputs, tmp_path / "csv", file_format="csv")
    with open(tmp_path / "csv" / "boxes.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = [[float(row[f"velocity_{i}"]) for i in (0, 1)] for row in rows]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    detect_files(detector, inputs, tmp_path / "json")
    boxes = files.read_json(tmp_path / "json" / "7_00000.json")
    np.testing.assert_allclose(boxes[0]["velocity"], expected[0], rtol=1e-5)
    detect_files(detector, inputs, tmp_path / "kitti", file_format="kitti")
    assert "kitti has no columns for velocity: not written" in caplog.text


def test_every_format_has_the_same_boxes(tmp_path):
    detector = small.detector()
    frames, keys = small.projections(3), [f"7/0000{i}" for i in range(3)]
    _write_projections(tmp_path / "data", keys, frames)
    inputs = find_inputs(detector, [tmp_path / "data"])
    assert inputs.keys == keys
    expected = detector(frames).to_list()
    counts = {
        "frames": 3,
        "done": 0,
        "boxes": sum(map(len, expected)),
        "clipped": detector(frames).to_boxes().is_clipped.sum(),
        "truncated": detector(frames).num_truncated.sum(),
    }
    assert counts["truncated"] > 0
    for kind in ("json", "kitti", "csv"):
        options = {"batch_size": 2, "file_format": kind}
        found = detect_files(detector, inputs, tmp_path / kind, **options)
        assert found == (counts, {})
    rows = []
    for key, boxes in zip(keys, expected, strict=True):
        path = tmp_path / "json" / f"{key.replace('/', '_')}.json"
        rows += [{"frame": key, **box} for box in boxes]
        assert json.loads(path.read_text()) == rows[-len(boxes) :]
    assert len(list((tmp_path / "json").glob("7_*.json"))) == 3
    with open(tmp_path / "csv" / "boxes.csv", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert table == [{name: str(x) for name, x in row.items()} for row in rows]
    # Either is scored against labels whose frames have the key of both sensors.
    names = ["00002_00011", "00001_00010"]
    table = {"frame": [4, 5], "sequence": [7, 7], "name": names}
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


@pytest.fixture(scope="module")
def detected(tmp_path_factory):
    """Detector of three frames, and a folder with `data` and the boxes of every format."""
    folder = tmp_path_factory.mktemp("detected")
    keys = [f"7/0000{i}" for i in range(3)]
    _write_projections(folder / "data", keys, small.projections(3))
    detector = small.detector()
    inputs = find_inputs(detector, [folder / "data"])
    for kind in ("json", "kitti", "csv"):
        detect_files(detector, inputs, folder / kind, batch_size=2, file_format=kind)
    return detector, folder


def _texts(folder):
    paths = [path for path in folder.rglob("*[0-9x].*") if "manifest" not in path.name]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in paths}


@pytest.mark.parametrize("file_format", ["json", "kitti", "csv"])
def test_a_frame_with_a_box_that_is_not_finite_fails(
    detected, tmp_path, monkeypatch, file_format
):
    detector, folder = detected
    shutil.copytree(folder / "data", tmp_path / "data")
    inputs = find_inputs(detector, [tmp_path / "data"])
    out = pathlib.Path(shutil.copytree(folder / file_format, tmp_path / "out"))
    earlier = sorted(out.rglob("*"))
    for path in inputs.paths:  # so that they are detected in again
        os.utime(path, ns=(0, 0))

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


@pytest.mark.parametrize(
    ("kind", "lost", "done"),
    [("json", ["7_00001.json"], 2), ("kitti", ["preds/000001.txt"], 2), ("csv", [], 0)],
)
def test_a_file_that_cannot_be_read_fails_alone_and_a_second_call_continues(
    detected, tmp_path, kind, lost, done
):
    detector, folder = detected
    shutil.copytree(folder / "data", tmp_path / "data")
    inputs = find_inputs(detector, [tmp_path / "data"])
    content = inputs.paths[1].read_bytes()
    inputs.paths[1].write_bytes(content[:-7])
    out = tmp_path / "out"
    count, failed = detect_files(detector, inputs, out, file_format=kind)
    assert (count["frames"], count["done"], list(failed)) == (2, 0, ["7/00001"])
    assert f"{inputs.paths[1]}: corrupted" in failed["7/00001"]
    expected = _texts(folder / kind)
    assert sorted(expected.keys() - _texts(out)) == lost
    inputs.paths[1].write_bytes(content)
    count, failed = detect_files(detector, inputs, out, batch_size=2, file_format=kind)
    assert (count["frames"], count["done"], failed) == (3 - done, done, {})
    assert _texts(out) == expected


def _check_scores(paths, expected):
    for path, boxes in zip(sorted(paths), expected, strict=True):
        scores = [box["score"] for box in json.loads(path.read_text())]
        assert scores == pytest.approx([box["score"] for box in boxes], abs=1e-5)


def test_an_image_that_cannot_be_read_fails_alone(tmp_path):
    detector = small.detector("camera")
    images = [tmp_path / f"{i}.png" for i in range(3)]
    for path, image in zip(images, small.images(3), strict=True):
        Image.fromarray(image).save(path)
    camera = small.calibration().camera()
    frames = small.projections(3)
    keys, views = ["1/0", "1/1", "1/2"], [(path, camera) for path in images]
    inputs = FrameInputs(keys, [None] * 3, frames.__getitem__, views)
    images[1].write_bytes(images[1].read_bytes()[:-60])
    count, failed = detect_files(detector, inputs, tmp_path / "out", batch_size=2)
    assert (count["frames"], count["radar_only"], list(failed)) == (2, 0, ["1/1"])
    expected = detector(frames[[0, 2]], small.images(3)[[0, 2]], small.calibration())
    _check_scores((tmp_path / "out").glob("1_*.json"), expected.to_list())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("threshold", r"decode\.score_threshold is 0\.1 there and 0\.3 here; choose"),
        ("weights", r"options\.weights is '\w{16}' there and '\w{16}' here; choose"),
        ("frames", r"options\.frames is \['7/00000', .* there and \['7/00000'\] here;"),
        ("format", r"options\.format is 'json' there and 'kitti' here"),
        ("manifest", r"7_0000\d\.json is there, but no manifest\.json"),
    ],
)
def test_boxes_of_another_detection_are_not_mixed(detected, tmp_path, change, message):
    detector, folder = detected
    shutil.copytree(folder / "json", tmp_path / "out")
    paths = [folder / "data"]
    if change == "threshold":
        detector = small.detector(score_threshold=0.3)
    elif change == "weights":
        doubled = jax.tree.map(lambda x: 2 * x, detector.variables)
        detector = detector.replace(variables=doubled)
    elif change == "frames":
        paths = sorted(folder.rglob("*_00000.npy"))
    elif change == "manifest":
        (tmp_path / "out" / "manifest.json").unlink()
    inputs = find_inputs(detector, paths)
    kind = "kitti" if change == "format" else "json"
    before = _texts(tmp_path / "out")
    with pytest.raises(UserError, match=message):
        detect_files(detector, inputs, tmp_path / "out", file_format=kind)
    assert _texts(tmp_path / "out") == before


def _score(detector, path, num_frames=3):
    """Load boxes with a ground truth that has an object in each of the frames."""
    frames = range(num_frames)
    names = [f"0000{i}_0001{i}" for i in frames]
    table = {"frame": [*frames], "sequence": [7] * num_frames, "name": names}
    box = [20.0, 0, 0, 4, 2, 1.5, 0]
    rows = [{"frame": i, "cls": "Sedan", "box": box} for i in frames]
    files.write_json(path.parent / "frames.json", table)
    files.write_json(path.parent / "truth.json", rows)
    source = Source(ground_truth=str(path.parent / "truth.json"))
    return load_tables(path, source, detector.classes)


@pytest.mark.parametrize(
    ("kind", "removed", "added", "message"),
    [
        ("json", ["7_00001.json"], [], "a partial copy, without 1 of 3 files, such as 7_0"),
        ("json", ["manifest.*.jsonl", "7_00001.json"], [], "an interrupted job, which did n"),
        ("json", [], ["7_00009.json"], "1 files that are not of the job that wrote the oth"),
        ("json", ["manifest*", "7_00001.json"], [], "1 of 3 frames have no file, such as 7/"),
        ("kitti", ["preds/000001.txt"], [], "a partial copy, without 1 of 4 files"),
        ("kitti", ["frames.json"], [], "an interrupted job, .* such as frames.json"),
        ("kitti", ["manifest*", "preds/*2.txt"], [], "1 of 3 frames have no file, such as 7/"),
        ("kitti", ["manifest*"], ["preds/000003.txt"], "not the names of all files in preds"),
        ("csv", [], [], "3 of 3 frames have no file"),
    ],
)  # fmt: skip
def test_an_incomplete_folder_has_no_score(
    detected, tmp_path, kind, removed, added, message
):
    detector, folder = detected
    out = tmp_path / "boxes"
    shutil.copytree(folder / kind, out)
    for path in (path for pattern in removed for path in out.glob(pattern)):
        path.unlink()
    for name in added:
        (out / name).write_text("[]" if kind == "json" else "dummy")
    with pytest.raises(DataError, match=message):
        _score(detector, out)


@pytest.mark.parametrize("kind", ["json", "kitti"])
def test_frames_that_failed_are_left_out_and_counted(detected, tmp_path, kind):
    detector, folder = detected
    out = tmp_path / "boxes"
    shutil.copytree(folder / kind, out)
    _, found, frames, counts = _score(detector, out)
    assert frames["frame"].tolist() == [0, 1, 2]
    name = {"json": "7_00001.json", "kitti": "preds/000001.txt"}[kind]
    (out / name).unlink()
    add(out, name, None)
    truth, left, frames, counts = _score(detector, out)
    assert counts == {"frames left out: `radejax detect` failed": 1}
    assert frames["frame"].tolist() == truth.frame.tolist() == [0, 2]
    assert len(left) == np.count_nonzero(found.frame != 1) < len(found)
    with pytest.raises(DataError, match="1 of 4 frames have no file, such as 7/00003_"):
        _score(detector, out, 4)


def test_preceding_frames_of_files_are_of_their_sequence(tmp_path):
    """Frames 7, 8 and 10 of a sequence, and 11 of the next one."""
    detector = small.detector(num_frames=2)
    frames = small.projections(4)
    keys = ("1/00007", "1/00008", "1/00010", "2/00011")
    _write_projections(tmp_path / "data", keys, frames)
    inputs = find_inputs(detector, [tmp_path / "data"])
    expected = detector(np.stack([frames[[0, 0, 2, 3]], frames], 1)).to_list()
    for batch_size in (1, 2, 8):
        out = tmp_path / f"out{batch_size}"
        count, _ = detect_files(detector, inputs, out, batch_size=batch_size)
        assert (count["frames"], count["repeated"]) == (4, 3)
        _check_scores(out.glob("[12]_*.json"), expected)


@pytest.mark.parametrize(
    ("keys", "parts"),
    [
        (["1/10", "1/11", "1/8", "1/9"], [[2, 3, 0, 1]]),
        (["1/1", "2/1", "1/2", "2/2"], [[0, 2], [1, 3]]),
        (["1/1", "1/2_a", "1/2_b", "1/3"], [[0, 1], [2, 3]]),
    ],
)
def test_parts_are_consecutive_frames_in_any_order_of_the_keys(keys, parts):
    inputs = FrameInputs(keys, [], [].__getitem__, [])
    assert inputs.parts(2) == parts
    assert inputs.parts(1) == [[0], [1], [2], [3]]


def test_a_frame_after_one_that_cannot_be_read_has_no_preceding_one(tmp_path):
    detector = small.detector(num_frames=2)
    frames = small.projections(4)
    keys = ("1/00007", "1/00008", "1/00009", "1/00010")
    _write_projections(tmp_path / "data", keys, frames)
    inputs = find_inputs(detector, [tmp_path / "data"])
    content = inputs.paths[1].read_bytes()
    expected = detector(np.stack([frames[[0, 2, 2]], frames[[0, 2, 3]]], 1)).to_list()
    for batch_size in (1, 2, 8):
        inputs.paths[1].write_bytes(content[:-7])
        out = tmp_path / f"out{batch_size}"
        count, failed = detect_files(detector, inputs, out, batch_size=batch_size)
        assert (count["frames"], count["repeated"], [*failed]) == (3, 2, [keys[1]])
        _check_scores(out.glob("1_*.json"), expected)
        inputs.paths[1].write_bytes(content)
        for counts in ((4, 0, 1), (0, 4, 0)):  # the whole part, then nothing
            count, _ = detect_files(detector, inputs, out, batch_size=batch_size)
            assert (count["frames"], count["done"], count["repeated"]) == counts


def test_two_frames_of_one_name_are_rejected(tmp_path):
    for disk in ("a", "b"):
        path = tmp_path / disk / "5" / "radar_tesseract" / "tesseract_00033.mat"
        path.parent.mkdir(parents=True)
        path.touch()
    with pytest.raises(UserError, match=r"a/5/.* and .*b/5/.* frame 5/00033"):
        find_inputs(small.detector(), [tmp_path / "a", tmp_path / "b"])


def test_images_of_simulated_folders_are_found(tmp_path):
    """Their labels are in `info_label_v2_1`."""
    sizes = {"train_sequences": 1, "test_sequences": 0, "frames_per_sequence": 1}
    root = small.simulate(tmp_path / "data", **sizes)
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

    # The images of sequences without labels are not found.
    tensors = tmp_path / "tensors"
    paths = [tensors / n / "DERA_tesseract" / path.name for n in (path.parts[-3], "60")]
    for copy in paths:
        copy.parent.mkdir(parents=True)
        shutil.copy(path, copy)
    for labels, roots in ((root, [tensors]), (None, [tensors, root])):
        views = front_images(paths, detector, labels, root / "calib", roots)
        assert views.keys() <= {paths[0]}
        assert front_images(paths[1:], detector, labels, None, roots) == {}
    assert views[paths[0]][0] == image

    # K-Radar's disks have no camera calibration; its repository does.
    folder = (root / "calib").rename(tmp_path / "repository")
    with pytest.raises(UserError, match=r"1 no camera calib.*--camera-calibration"):
        front_images([path], detector)
    known = front_images([path], detector, camera_calibration=folder)
    np.testing.assert_array_equal(known[found][1].intrinsics, camera.intrinsics)
    image.unlink()
    assert front_images([path], detector) == {}  # only the radar can be used
