"""The code blocks of docs/extending.md and docs/own_radar.md are run as they are."""

import importlib
import json
import pathlib
import re
import shutil
import sys
from dataclasses import replace
from unittest import mock

import jax
import numpy as np
import pytest
from PIL import Image

import radejax
from radejax import models
from radejax.config import Config
from radejax.core.errors import UserError
from radejax.data.check import check_frames
from radejax.data.dataset import find_reader
from radejax.data.kradar import KRadar
from radejax.data.kradar.check import check_dataset
from radejax.data.options import DataOptions
from radejax.data.pipeline import make_table
from radejax.data.projection import project_tensor
from radejax.data.records import Records, preprocess
from radejax.evaluation.boxes import tables_from_frames
from radejax.inference.detect_files import detect_files, find_inputs
from radejax.inference.detector import Detector
from radejax.inference.export import export
from radejax.runs import experiment
from radejax.runs.data import Data, located
from radejax.runs.evaluate import evaluate_run

from . import small_models as small
from . import toy_reader
from .commands import run

ROOT = pathlib.Path(__file__).resolve().parents[1]


def _blocks(page, language):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.S)


@pytest.fixture(autouse=True)
def page(tmp_path, monkeypatch):
    """Save the reader and the blocks of the page as modules that Python finds."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    (folder / "parts.py").write_text("\n\n".join(_blocks("extending.md", "python")))
    shutil.copy(toy_reader.__file__, folder / "toy.py")
    yield
    _forget()


def _forget():
    """Remove the imported modules, as if a new process had started."""
    for name in ("toy", "parts"):
        sys.modules.pop(name, None)


def _config():
    """Config of the small model with every component of the page."""
    parts = importlib.import_module("parts")
    config = small.radar_config()
    fields = {
        "name": "parts:PowerNet",
        "exponent": 3.0,
        "backbone": "parts:FlatBackbone",
        "cbam": "parts:Gate",
        "neck": "parts:StripNeck",
        "heads": "parts:WideHead",
    }
    fields["outputs"] = {"velocity": 2}
    return config.replace(
        model=parts.PowerOptions(**dict(config.model) | fields),
        loss={
            "own_terms": ("parts:height_loss", "parts:velocity_loss"),
            "weights": {"height_loss": 0.5, "velocity_loss": 0.5},
        },
        data={
            "format": "toy:Toy",
            "targets": ("velocity_mps",),
            "augmentation": ("parts:random_noise",),
        },
        train={
            "batch_size": 2,
            "num_epochs": 1,
            "warmup_steps": 0,
            "optimizer": "parts:lion",
            "schedule": "parts:one_cycle",
            "hooks": ("parts:parameter_norm",),
            "freeze": ("backbone/ConvGNSiLU_0*",),
        },
        evaluation={
            "batch_size": 2,
            "num_visualizations": 0,
            "protocols": ("parts:EVERY_FRAME", "all_point"),
            "metrics": ("parts:speed_error_mps",),
        },
    )


def _write_toy(root):
    """Write two drives of two frames, the first frame with an image."""
    rng, grid = np.random.default_rng(0), small.small_grid()
    (root / "1").mkdir(parents=True)
    (root / "2").mkdir()
    (root / "grid.json").write_text(json.dumps(grid.to_dict()))
    angles = {"yaw_deg": 90.0, "pitch_deg": 0.0, "roll_deg": 90.0}
    height, width = small.IMAGE_SIZE
    camera = {"intrinsics": [24, 24, 24, 16], "translation_m": [0, 0, 0], **angles}
    camera |= {"width": width, "height": height}
    (root / "camera.json").write_text(json.dumps(camera))
    Image.fromarray(small.images(1)[0]).save(root / "1" / "0001.png")
    for path in ("1/0001", "1/0002", "2/0001", "2/0002"):
        np.savez(
            root / f"{path}.npz",
            power=rng.uniform(1e3, 1e9, grid.shape_drea).astype(np.float32),
            boxes=np.array([[12.0, 1.0, 0.0, 4.2, 1.8, 1.6, 0.1]] * 2),
            classes=np.array(["Sedan", "Tram"]),
            velocity_mps=np.array([[3.0, 0.5], [np.nan, np.nan]]),
        )
    return root


def _read_toy(root):
    options = DataOptions(format="toy:Toy", roots=(str(root),))
    return find_reader(options.format).from_options(options, ("Sedan",))


def test_configs_may_name_the_parts_and_the_model_has_them():
    model = models.build(_config().model)
    assert model.options.exponent == 3.0
    projection = jax.ShapeDtypeStruct((1, 16, 14, 5), "float32")
    made = jax.eval_shape(model.init, jax.random.key(0), projection)["params"]
    assert "Conv_1" in made["neck"]
    assert made["heads"]["box"]["conv_1"]["conv"]["kernel"].shape[-1] == 16
    assert len(made["backbone"]) == 3


def test_records_of_other_files_or_of_another_reader_are_reported(
    tmp_path, caplog, monkeypatch
):
    root, reader = _write_toy(tmp_path), find_reader("toy:Toy")
    toy = sys.modules["toy"]

    def again():
        caplog.clear()
        with caplog.at_level("INFO", "radejax"):
            preprocess(_read_toy(root), tmp_path / "records")
        return caplog.text

    again()
    text = again()
    assert f"4 records in {tmp_path / 'records'} are used" in text
    assert "changed" not in text
    (root / "1" / "0002.npz").touch()
    assert "1 of 4 files were made from other files than there are now" in again()
    assert "such as 1/0002: delete these" in caplog.text
    # The files of the first frames were moved.
    frames = _read_toy(root)
    gone = [replace(frames[0], radar_path=None)]
    gone += [replace(frames[1], radar_path=root / "gone.npz")]
    data = toy.Toy([*gone, *frames[2:]], frames.grid)
    assert preprocess(data, tmp_path / "records").num_found == 4
    read = toy.ToyFrame.read_projection
    mirrored = lambda frame, grid: read(frame, grid)[:, ::-1]  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyFrame, "read_projection", mirrored)
        with pytest.raises(UserError, match=r"1/0001 is not what the reader computes"):
            again()
        with pytest.raises(UserError, match=r"2/0001 is not what the reader computes"):
            preprocess(data, tmp_path / "records")
    monkeypatch.setattr(reader, "reader_version", "2")
    with pytest.raises(UserError, match=r"source.reader is \['toy:Toy', ''"):
        again()


def test_commands_read_such_data_by_the_config(tmp_path, monkeypatch):
    root = _write_toy(tmp_path / "toy")
    config = Config().replace(data={"format": "toy:Toy"}, evaluation={"roi": None})
    given = ["--config", small.write_config(tmp_path / "config.py", config)]

    report = json.loads(run("data", "check", root, *given, "--deep", "--json").stdout)
    assert report["version"] == "read by toy:Toy"
    assert [row["without_camera"] for row in report["sequences"]] == [1, 2]
    assert [row["train"] for row in report["sequences"]] == [2, 0]
    assert [row["test"] for row in report["sequences"]] == [0, 2]
    train = {row["split"]: row for row in report["objects"]}["train"]
    assert (train["Sedan"], report["summary"]["num_problems"]) == (2, 0)

    out = tmp_path / "records"
    text = run("preprocess", root, *given, "--out", out, "--sequences", 2)
    assert "2 preprocessed" in text.output
    assert Records.open(out).keys() == {"2/0001", "2/0002"}

    draw = mock.Mock(wraps=radejax.draw_frame)
    monkeypatch.setattr(radejax, "draw_frame", draw)
    out = tmp_path / "a.png"
    given += ["--data", root, "--out", out]
    assert run("overlay", "1/0001", *given).output == f"drew {out}\n"
    text = run("overlay", "1/0002", *given).output
    assert "1 of 1 frames have no front image, 0 no camera" in text
    scenes = both, radar = [call.args[0] for call in draw.call_args_list]
    assert both.image is not None
    assert both.camera is not None
    assert radar.image is None
    assert [len(scene.ground_truth or ()) for scene in scenes] == [1, 1]
    text = run("overlay", "1/0002", *given, "--lidar", code=2).output
    assert "leave it out" in text
    assert "no frames of these" in run("overlay", "7/0001", *given, code=2).output


def test_objects_that_cannot_be_learned_are_left_out_and_counted(tmp_path):
    root = _write_toy(tmp_path)
    path = root / "1" / "0001.npz"
    good = [12.0, 1.0, 0.0, 4.2, 1.8, 1.6, 0.1]
    boxes = np.array([good] * 5)
    boxes[1, 2], boxes[2, 4], boxes[3, 0], boxes[4, 1] = np.nan, -1.0, -12.0, 99.0
    content = dict(np.load(path)) | {"boxes": boxes, "velocity_mps": np.zeros((5, 2))}
    content["classes"] = np.array(["Sedan"] * 5)
    np.savez(path, **content)
    config = located(_config().replace(data={"roots": (str(root),)}))
    data = Data(config)
    part = Data(config.replace(data={"sequences": (2,)}))
    assert [frame.sequence for frame in part.split("test")] == [2, 2]
    part = Data(config.replace(data={"sequences": (1,)}))  # of the train split
    with pytest.raises(UserError, match="no frames of the test split"):
        part.split("test")
    assert data.frames[0].boxes.tolist() == [good]
    assert data.split("train")[0].classes.tolist() == ["Sedan"]
    counts = data.frames.summary().counts
    assert counts["objects left out: a value is not finite"] == 1
    assert counts["objects left out: a size is not above 0"] == 1
    assert counts["objects left out: field of view"] == 2
    np.savez(path, **content | {"boxes": np.array([[*good[:6], 90.0]] * 5)})
    with pytest.raises(UserError, match=r"frame 1/0001: yaw is 90, expected radians"):
        Data(config)


def test_what_a_reader_forgets_is_named(tmp_path, monkeypatch):
    root = _write_toy(tmp_path)
    toy, classes = importlib.import_module("toy"), ("Sedan",)
    frames = list(_read_toy(root))
    grid = small.small_grid()
    with pytest.raises(UserError, match="number of frames 1/0001 is 2, expected 1:"):
        toy.Toy([*frames, frames[0]], grid).with_valid_boxes(classes)
    uncalibrated = [replace(x, camera_calibration_path=None) for x in frames]
    counts = toy.Toy(uncalibrated, grid).with_valid_boxes(classes).counts
    name = "frames with a camera_path and no camera_calibration_path: read_calibration "
    assert counts[f"{name}is not called"] == 1

    # Frames without objects may have arrays of any type and shape.
    none = np.array([])
    empty = replace(frames[0], boxes=none, classes=none, columns={"velocity_mps": none})
    data = toy.Toy([empty, *frames[1:], replace(empty, name="0009")], grid)
    data = data.with_valid_boxes(classes)
    preprocess(data, tmp_path / "records")
    records, targets = Records.open(tmp_path / "records"), ("velocity_mps",)
    table = make_table(records, data, max_objects=2, classes=classes, targets=targets)
    assert table.boxes.shape == (5, 2, 8)
    assert table.targets["velocity_mps"].shape == (5, 2, 2)
    truth, _ = tables_from_frames(data, None, targets)
    assert truth.extras["velocity_mps"].shape == (len(truth), 2)
    for fields, message in (
        ({"boxes": np.zeros((2, 6))}, r"1/0001: shape of boxes is \(2, 6\), expected"),
        ({"boxes": np.zeros(7)}, r"1/0001: shape of boxes is \(7,\), expected \(N, 7"),
        ({"classes": np.array(["Sedan"] * 9)}, r"1/0001: shape of classes is \(9,\), "),
    ):
        with pytest.raises(UserError, match=message):
            toy.Toy([replace(frames[0], **fields)], grid).with_valid_boxes(classes)

    # Labels without z and height.
    flat = replace(frames[0], boxes=np.array([[12.0, 1.0, 4.2, 1.8, 0.1]]))
    assert flat.boxes.tolist() == [[12.0, 1.0, 0.0, 4.2, 1.8, 1.5, 0.1]]

    # The frame that is read is one with a camera, whose calibration is of twice its size.
    data = toy.Toy([replace(frames[0], name="0000", camera_path=None), *frames], grid)
    assert check_frames(data, classes, [str(root)]).num_problems == 0
    camera = json.loads((root / "camera.json").read_text())
    camera |= {"width": 2 * camera["width"], "height": 2 * camera["height"]}
    (root / "camera.json").write_text(json.dumps(camera))
    (_, problem), *others = check_frames(data, classes, [str(root)]).summary.problems
    assert problem.startswith("1/0001: ")
    assert "camera.json: principal point 24, 16 in" in problem
    assert not others


@pytest.mark.parametrize("is_flat", [False, True])
def test_written_folders_are_read(is_flat, tmp_path, monkeypatch):
    """Also those of a radar that measures only range and azimuth, with one bin per axis."""
    blocks = _blocks("own_radar.md", "py")
    (written,) = (block for block in blocks if "write_splits" in block)
    if is_flat:
        axes = r"(elevation_rad|doppler_mps)=.*"
        written, count = re.subn(axes, r"\1=[0.0],", written)
        assert count == 2
    monkeypatch.chdir(tmp_path)
    shape = (1, 64, 1, 48) if is_flat else (32, 64, 2, 48)
    power = np.random.default_rng(0).exponential(1e3, shape)
    box = (20.0, 1.0, 0.0, 4.2, 1.8, 1.6, 0.1)
    recording = [(power.astype(np.float32), [("Sedan", box)])] * 4
    exec(written, {"recording": recording})
    assert check_dataset("own").num_problems == 0
    frames = KRadar("own", split="train")
    assert [frame.key for frame in frames] == ["1/00001_00001", "1/00002_00002"]
    np.testing.assert_allclose(frames[0].boxes, [box])
    projection = frames[0].read_projection(frames.grid)
    np.testing.assert_array_equal(projection, project_tensor(recording[0][0]))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("model.neck", "strip", "'strip', expected 'dilated' or 'plain' or module:Ob"),
        ("model.name", "parts:StripNeck", "expected the name of a RadeNet"),
        ("loss.own_terms", (), "for some of focal, gwd, smooth_l1, and"),
        ("evaluation.protocols", ("parts:PowerNet",), "the name of a Protocol"),
        ("data.format", "parts:PowerNet", "expected the name of a LabeledFrames"),
        ("data.format", "nuscenes", "'nuscenes', expected 'kradar' or module:Object"),
    ],
)
def test_a_wrong_part_is_named(name, value, message):
    config, section = _config(), name.partition(".")[0]
    with pytest.raises(UserError, match=rf"^config\.{section}\..*{message}"):
        config.with_fields({name: value}).check_imports()


@pytest.mark.slow
def test_own_parts_are_imported_wherever_a_run_is_opened(
    tmp_path, caplog, monkeypatch, one_device
):
    """One step on the toy data, then each command as if in a process of its own."""
    root, folder = _write_toy(tmp_path / "toy"), tmp_path / "run"
    config = _config()
    classes = ("Tram", *config.classes[1:])
    config = config.replace(data={"roots": (str(root),)}, classes=classes)
    experiment.run(config, folder, mesh=one_device)
    row = json.loads((folder / "metrics.jsonl").read_text())
    assert row["step"] == 1
    terms = ("focal", "gwd", "height_loss", "velocity_loss")
    assert np.isfinite([row[name] for name in terms]).all()
    _forget()
    out = tmp_path / "results"
    out.mkdir()
    (out / "metrics.json").write_text('{"run": "other"}')
    with caplog.at_level("WARNING", "radejax"):
        assert evaluate_run(folder, out=out) is not None
        assert f"{out}: the results of other are replaced" in caplog.text
        caplog.clear()
        assert evaluate_run(folder) is not None
    assert "are replaced" not in caplog.text
    metrics = json.loads((folder / "evaluation" / "metrics.json").read_text())
    assert metrics["options"]["protocols"] == ["parts:EVERY_FRAME", "all_point"]
    _forget()
    detector = Detector.from_workdir(folder, score_threshold=0.0)
    found, _ = detect_files(detector, find_inputs(detector, [root]), tmp_path / "boxes")
    assert found["frames"] == 4
    boxes = json.loads((tmp_path / "boxes" / "1_0001.json").read_text())
    assert {box["frame"] for box in boxes} == {"1/0001"}
    _forget()
    detector = Detector.from_workdir(folder)
    assert detector.model.options.exponent == 3.0
    out = tmp_path / "exported"
    _forget()
    export(Detector.from_workdir(folder), out, platforms=("cpu",))
    _forget()
    projection = np.full((1, *detector.grid.projection_shape), 0.5, np.float32)
    again = Detector.from_workdir(out)
    assert type(again.model).__name__ == "PowerNet"
    variables = again.saved.variables, detector.saved.variables
    jax.tree.map(np.testing.assert_array_equal, *variables)
    assert again(projection, score_threshold=0.0).boxes.shape[-1] == 7
    monkeypatch.undo()  # the folder of parts.py is not searched any more
    _forget()
    with pytest.raises(UserError, match=r"is 'parts:\w+': No module named 'parts';"):
        Detector.from_workdir(folder)
