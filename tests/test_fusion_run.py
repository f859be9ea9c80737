"""Radar-camera runs from images and from embeddings, with a frozen backbone from files."""

import copy
import dataclasses
import json
import logging
import pathlib
import shutil

import jax
import numpy as np
import pytest
import safetensors.numpy
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.config import load_config, load_module
from radejax.core.errors import DataError, UserError
from radejax.data.cameras import require_images
from radejax.data.kradar.radar_files import key_of
from radejax.data.records import open_embeddings
from radejax.inference.detect_files import detect_files, find_inputs
from radejax.inference.detector import Detector
from radejax.inference.embed import embed_dataset
from radejax.inference.predict import predict_dataset
from radejax.inference.saved import load_model
from radejax.models import build
from radejax.runs import experiment
from radejax.runs.data import Data, data_of_run
from radejax.runs.evaluate import evaluate_run
from radejax.training import checkpoints, distributed
from radejax.weights import image_backbone

from . import small_models as small

pytestmark = pytest.mark.slow  # several programs to compile

CONFIG = pathlib.Path(__file__).parents[1] / "configs" / "quickstart_fusion.py"


def small_config():
    """A few bins, small images, and the tiny DINOv3's sizes, frozen."""
    return small.shrink_run(load_config(f"{CONFIG}:short")).replace(
        simulation={
            "train_sequences": 2,
            "test_sequences": 1,
            "frames_per_sequence": 4,
            "image_width": 96,
            "image_height": 32,
        },
        model={
            "pad_multiple": 4,
            "image": {
                "size": (32, 96),
                "freeze": True,
                "hidden_size": 96,
                "num_layers": 3,
                "num_registers": 4,
                "mlp_dim": 192,
            },
            "fusion": {"num_heads": 2, "num_elevation": 3, "necks": False},
        },
        data={"mirror_probability": 0.0},
        train={"batch_size": 8, "num_epochs": 2, "log_every_steps": 1},
        evaluation={"num_visualizations": 1},
    )


@dataclasses.dataclass
class _Data:
    folder: pathlib.Path
    backbone: pathlib.Path
    runs: pathlib.Path

    def train(self, name, config=None, init_from=None, **paths):
        data = paths | {"roots": (str(self.folder),)}
        config = (config or small_config()).replace(data=data)
        workdir = self.runs / name
        experiment.run(config, workdir, init_from=init_from)
        return workdir

    def losses(self, workdir):
        rows = map(json.loads, (workdir / "metrics.jsonl").read_text().splitlines())
        return [[row[k] for k in ("focal", "gwd", "smooth_l1")] for row in rows]


def opened(workdir):
    """Model and data of a run."""
    loaded = load_model(workdir)
    return loaded, data_of_run(loaded)[1]


@pytest.fixture(scope="module", autouse=True)
def one_device():
    """One device only: compiling for eight takes long and is tested elsewhere."""
    mesh = distributed.make_mesh(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(distributed, "make_mesh", lambda *_: mesh)
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory, make):
    root = tmp_path_factory.mktemp("fusion")
    (root / "dinov3").mkdir()
    return _Data(root / "data", make.write_tiny_folder(root / "dinov3"), root)


@pytest.fixture(scope="module")
def from_images(data):
    return data.train("images", image_backbone=str(data.backbone))


@pytest.fixture(scope="module")
def embeddings(data, from_images, tmp_path_factory):
    out = tmp_path_factory.mktemp("embeddings")
    model = build(small_config().model)
    variables = image_backbone.load_image_backbone(data.backbone, model)
    frames = opened(from_images)[1].frames
    arguments = (model, variables, frames, out)
    counts = embed_dataset(*arguments)
    assert counts == {"frames": 12, "embedded": 12, "found": 0, "missing": 0}
    counts = embed_dataset(*arguments)
    assert counts == {"frames": 12, "embedded": 0, "found": 12, "missing": 0}
    return out


def test_frozen_backbone_is_in_no_checkpoint_and_comes_back(data, from_images):
    config = small_config()
    run = load_model(from_images)
    given = image_backbone.load_image_backbone(data.backbone, build(config.model))
    backbone = run.variables["params"]["image_backbone"]
    for found, wanted in zip(
        jax.tree.leaves(backbone),
        jax.tree.leaves(given["params"]["image_backbone"]),
        strict=True,
    ):
        np.testing.assert_array_equal(found, wanted)
    stored = json.dumps(
        [str(p) for p in (from_images / "checkpoints").rglob("*")]
    ) + "".join(p.read_text() for p in (from_images / "checkpoints").rglob("_METADATA"))
    assert "image_neck" in stored
    assert "image_backbone" not in stored


def test_training_from_embeddings_is_the_same(data, from_images, embeddings, tmp_path):
    workdir = data.train("embedded", embeddings=str(embeddings))
    found, wanted = data.losses(workdir), data.losses(from_images)
    assert len(found) == len(wanted) > 0
    np.testing.assert_allclose(found, wanted, rtol=2e-5)
    # The evaluation uses the embeddings too: the backbone's weights do not exist.
    assert "image_backbone" not in load_model(workdir).variables["params"]
    reports = [
        json.loads((w / "evaluation" / "metrics.json").read_text())
        for w in (workdir, from_images)
    ]
    assert reports[0]["ap"] == reports[1]["ap"]
    other = shutil.copytree(data.folder, tmp_path / "other")
    with pytest.raises(UserError, match=r"\(--image-backbone FOLDER\)"):
        evaluate_run(workdir, other={"roots": (str(other),)})
    given = {"roots": (str(other),), "embeddings": str(embeddings)}
    evaluate_run(workdir, other=given, num_visualizations=0)
    report = json.loads((workdir / "evaluation_other/metrics.json").read_text())
    assert report["ap"] == reports[0]["ap"]


def test_dinov2_embeds_and_trains_like_dinov3(data, golden, tmp_path):
    # 32 x 96 pixels are no multiples of the patch size: the model resizes them to 28 x 98.
    seeds = load_module(golden / "backbones_make.py")
    info = json.loads(str(np.load(golden / "backbones.npz")["info"]))
    listing = info["dinov2_registers"]
    backbone, embeddings = tmp_path / "dinov2", tmp_path / "embeddings"
    backbone.mkdir()
    (backbone / "config.json").write_text(json.dumps(listing["config"]))
    safetensors.numpy.save_file(
        seeds.tensors(listing["tensors"]), backbone / "model.safetensors"
    )

    image = {"hidden_size": 32, "num_layers": 2, "num_heads": 2, "mlp_dim": 128}
    image |= {"patch_size": 14, "position_grid": 4}
    config = small_config().replace(model={"image": image})
    with pytest.raises(UserError, match=r"dinov3 is DINOv3, .* 16 there and 14 here"):
        data.train("other", config, image_backbone=str(data.backbone))
    images = data.train("dinov2_images", config, image_backbone=str(backbone))
    path = small.write_config(tmp_path / "config.py", config)
    arguments = ["embed", str(data.folder), "--config", str(path), "--out"]
    arguments += [str(embeddings), "--image-backbone", str(backbone)]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert "12 frames, 12 embedded" in result.output
    assert open_embeddings(embeddings).shape == (2, 7, 32)
    embedded = data.train("dinov2_embedded", config, embeddings=str(embeddings))
    found, wanted = data.losses(embedded), data.losses(images)
    np.testing.assert_allclose(found, wanted, rtol=2e-5)


def test_a_run_that_starts_from_another_keeps_its_backbone(data, from_images):
    # Without --image-backbone, the initial weights include the backbone's.
    workdir = data.train("continued", init_from=str(from_images))
    assert (workdir / "evaluation" / "metrics.json").exists()
    first, second = (load_model(w).variables for w in (from_images, workdir))
    for name, is_same in (("image_backbone", True), ("image_neck", False)):
        pairs = zip(
            jax.tree.leaves(first["params"][name]),
            jax.tree.leaves(second["params"][name]),
            strict=True,
        )
        assert all(np.array_equal(a, b) for a, b in pairs) == is_same


def test_a_backbone_that_is_gone_leaves_embedded_images(
    data, from_images, tmp_path, caplog
):
    copy = tmp_path / "copy"
    shutil.copytree(from_images, copy)
    info = copy / "checkpoints"
    newest = max(info.iterdir(), key=lambda path: int(path.name))
    stored = newest / "description" / "metadata"
    text = stored.read_text().replace(str(data.backbone), str(tmp_path / "gone"))
    content = json.loads(text)
    del content["sha256"]
    content["sha256"] = checkpoints._text_checksum(content)
    stored.write_text(json.dumps(content))
    with caplog.at_level(logging.WARNING):
        run = load_model(copy)
    assert "image backbone" in caplog.text
    assert "not found at" in caplog.text
    assert "image_backbone" not in run.variables["params"]
    again = load_model(copy, image_backbone=data.backbone)
    assert "image_backbone" in again.variables["params"]


def test_images_that_are_not_embedded_are_an_error(data, embeddings):
    _, own = opened(data.runs / "images")
    frames = list(own.split("test"))
    embedded = copy.copy(own)
    embedded.features = open_embeddings(embeddings)
    other = [dataclasses.replace(frames[0], name="99999_99999"), *frames[1:]]
    with pytest.raises(
        UserError, match=r"1 of 4 frames have an image that .* `radejax embed`"
    ):
        embedded.images(other)
    # Images with embeddings need no files.
    gone = [dataclasses.replace(frame, camera_path=None) for frame in frames]
    inputs = embedded.images(gone)
    assert all(camera.is_valid for camera in inputs.cameras)
    inputs = own.images(gone)
    with pytest.raises(UserError, match=r"\(4\) can use the camera: 4 have no front"):
        require_images(gone, inputs)


def test_embeddings_of_another_kind_are_rejected(data, embeddings, make, tmp_path):
    config = small_config().with_fields({"model.image.standardize": False})
    with pytest.raises(UserError, match=r"standardize is True there and False here"):
        open_embeddings(embeddings, config.model.image.to_dict())
    paths = {"roots": (str(data.folder),), "records": str(data.folder / "records")}
    paths["embeddings"] = str(embeddings)
    for changes, message in (
        ({"data.mirror_probability": 0.5}, "cannot be mirrored"),
        ({"model.image.freeze": False}, "freeze=True"),
    ):
        config = small_config().replace(data=paths).with_fields(changes)
        with pytest.raises(UserError, match=message):
            Data(config, build(config.model))
    with pytest.raises(FileNotFoundError, match="radejax embed"):
        open_embeddings(tmp_path)
    (tmp_path / "records.json").write_text('{"shape": [2, 3]}')
    with pytest.raises(DataError, match=r"records\.json: corrupted"):
        open_embeddings(tmp_path)


def test_weights_that_do_not_fit_are_rejected(data, tmp_path):
    config = small_config()
    with pytest.raises(UserError, match="--image-backbone FOLDER"):
        image_backbone.load_image_backbone(None, build(config.model))
    with pytest.raises(FileNotFoundError, match=r"lacks config.json"):
        image_backbone.load_image_backbone(tmp_path, build(config.model))
    config = config.with_fields({"model.image.num_layers": 12})
    with pytest.raises(UserError, match=r"num_layers is 3 .* 12 here"):
        image_backbone.load_image_backbone(data.backbone, build(config.model))
    radar = build(load_config(f"{CONFIG}:radar").model)
    with pytest.raises(UserError, match="has no camera"):
        image_backbone.load_image_backbone(data.backbone, radar)
    assert image_backbone.load_image_backbone(None, radar) is None


def test_frames_without_image_are_counted_and_predicted_by_radar(
    data, from_images, caplog
):
    run, own = opened(from_images)
    frames = list(own.split("test"))
    detector = Detector(run, score_threshold=0.0)

    def boxes(frames):
        images = own.images(frames)
        found = predict_dataset(detector, own.records, frames, 4, images=images)
        return {i: found.box[found.frame == i] for i in range(len(frames))}

    seen = boxes(frames)
    blind = [dataclasses.replace(frames[0], camera_path=None), *frames[1:]]
    with caplog.at_level(logging.WARNING):
        half = boxes(blind)
    assert "1 of 4 frames have no front image" in caplog.text
    assert not np.array_equal(half[0], seen[0])
    np.testing.assert_allclose(half[1], seen[1], rtol=1e-4, atol=1e-4)
    radar = predict_dataset(detector, own.records, frames[:1], 4)
    np.testing.assert_allclose(radar.box, half[0], rtol=1e-4, atol=1e-4)

    own.camera = own.camera.replace(allow_missing=False)
    with pytest.raises(UserError, match="1 of 4 frames"):
        own.images(blind)


def test_detect_finds_the_images_by_the_labels(from_images, tmp_path):
    frames = list(opened(from_images)[1].split("test"))
    path = frames[0].projection_path
    folder = path.parents[1]
    root = tmp_path / "kradar"
    others = [x.name for x in folder.parent.iterdir() if x.name.isdecimal()]
    others.remove(folder.name)
    shutil.copytree(folder.parent, root, ignore=shutil.ignore_patterns(*others))

    def detect(name):
        out = tmp_path / name
        detector = Detector.from_workdir(from_images, score_threshold=0.0)
        counts = detect_files(detector, find_inputs(detector, [root]), out)
        boxes = {path.name: json.loads(path.read_text()) for path in out.iterdir()}
        assert counts["frames"] == len(boxes) == len(frames)
        assert counts["boxes"] == sum(map(len, boxes.values()))
        return counts["radar_only"], boxes

    none_missing, seen = detect("seen")
    assert none_missing == 0
    detector = Detector.from_workdir(from_images, score_threshold=0.0)
    frame = frames[0]
    expected = detector(
        path, [frame.camera_path], [frame.camera_calibration_path]
    ).to_list()[0]
    name = f"{key_of(path).replace('/', '_')}.json"
    assert [box["x"] for box in seen[name]] == pytest.approx(
        [box["x"] for box in expected], abs=1e-3
    )

    calib = (root / "calib").rename(tmp_path / "repository")
    command = ["detect", str(root), "--workdir", str(from_images)]
    command += ["--score-threshold", "0", "--out", str(tmp_path / "command")]
    failed = CliRunner().invoke(main, command)
    assert failed.exit_code == 2
    assert "4 no camera calibration" in failed.output
    command += ["--camera-calibration", str(calib)]
    done = CliRunner().invoke(main, command, catch_exceptions=False)
    assert "radar only" not in done.stdout
    given = json.loads((tmp_path / "command" / name).read_text())
    assert given == seen[name]
    calib.rename(root / "calib")

    (root / folder.name / "cam-front" / frame.camera_path.name).unlink()
    one_missing, blind = detect("blind")
    assert one_missing == 1
    assert blind.keys() == seen.keys()
    assert blind[name] != seen[name]

    for labels in (root / folder.name).glob("info_label*"):
        shutil.rmtree(labels)
    all_missing, _ = detect("unlabelled")
    assert all_missing == len(frames)


def test_evaluation_shows_the_share_of_the_camera(from_images, tmp_path):
    evaluate_run(from_images, out=tmp_path, num_visualizations=0)
    shares = json.loads((tmp_path / "camera_share.json").read_text())
    assert shares["all"]["frames"] == 4
    assert 0 < shares["all"]["mean"] < 1


def _example(name, *arguments):
    path = CONFIG.parents[1] / "examples" / f"{name}.py"
    module = load_module(path)
    result = CliRunner().invoke(module.main, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture
def three_test_sequences(data):
    """The training split joins the test split: intervals resample sequences."""
    split = data.folder / "split"
    before = (split / "test.txt").read_text()
    (split / "test.txt").write_text(before + "\n" + (split / "train.txt").read_text())
    yield
    (split / "test.txt").write_text(before)


def test_example_compares_fusion_and_radar_by_the_lens(
    from_images, three_test_sequences, tmp_path
):
    out, run = tmp_path / "by_lens", shutil.copytree(from_images, tmp_path / "run")
    evaluate_run(run, num_visualizations=0)
    # A run compared with itself has no gain, on all frames and by state of the lens.
    text = _example("fusion_by_lens", run, run, "--out", out, "--resamples", 10)
    assert (out / "by_lens.txt").read_text() in text
    content = json.loads((out / "by_lens.json").read_text())
    rows = content["ap"]
    whole = [row for row in rows if row["condition"] == "all"]
    assert {row["frames"] for row in whole} == {12}
    assert {row["difference"] for row in rows} == {0.0}
    shares = json.loads((out / "camera_share.json").read_text())
    parts = set(shares) - {"all"}
    assert sum(shares[name]["frames"] for name in parts) == 12
    # Three sequences in different weather: a condition with one sequence has no interval.
    alone = {n for n in parts if f"left out: {n} (4 frames" in text}
    told = {row["condition"]: row for row in content["share"]}
    assert told.keys() == {row["condition"] for row in rows}
    assert parts - alone == told.keys() - {"all"}
    for name, row in told.items():
        # Averages over frames and over bins must agree.
        assert row["share"] == pytest.approx(shares[name]["mean"], abs=0.02)
        assert row["frames"] == shares[name]["frames"]
        assert 0 < row["share low"] <= row["share"] <= row["share high"] < 1
    assert told["all"]["difference"] == 0


def test_example_compares_on_another_data_set(
    data, from_images, three_test_sequences, tmp_path, monkeypatch
):
    run = shutil.copytree(from_images, tmp_path / "run")
    other = shutil.copytree(data.folder, tmp_path / "other")
    for data in (None, {"roots": (str(other),)}):
        evaluate_run(run, num_visualizations=0, other=data)
    results = []
    monkeypatch.chdir(other)
    for arguments in ((), ("--data", ".")):
        _example("fusion_by_lens", run, run, *arguments, "--resamples", 10)
    for name in ("by_lens", "by_lens_other"):
        results.append((run / name / "by_lens.json").read_text())
    assert results[0] == results[1]
    assert len(json.loads(results[0])["ap"]) > 1
    with pytest.raises(AssertionError, match="other frames than split train"):
        _example("fusion_by_lens", run, run, "--split", "train")


def test_other_data_without_cameras_are_an_error(data, from_images, tmp_path):
    other = shutil.copytree(data.folder, tmp_path / "other")
    shutil.rmtree(other / "records")
    for image in other.rglob("cam-front*.png"):
        image.unlink()
    with pytest.raises(UserError, match=r"no frame of the test split .* front image"):
        evaluate_run(from_images, other={"roots": (str(other),)})
    assert not (other / "records").exists()


def test_example_draws_reference_points(data, from_images, tmp_path):
    frame = opened(from_images)[1].split("test")[0]
    files = frame.camera_path, frame.camera_calibration_path
    (label,) = (data.folder / str(frame.sequence)).glob(f"info_label*/{frame.name}.txt")
    out = tmp_path / "points.png"
    text = _example("reference_points", *files, "--label", label, "--out", out)
    share, count = float(text.split("%")[0]), int(text.split("drew ")[1].split()[0])
    assert 5 < share < 100
    assert count > 50
    assert out.stat().st_size > 10_000


def test_embeddings_grow_with_a_second_disk(data, from_images, tmp_path):
    disk = tmp_path / "disk1"
    second = shutil.copytree(data.folder, tmp_path / "disk2")
    shutil.rmtree(second / "records")
    disk.mkdir()
    (second / "1").rename(disk / "1")
    for name in ("radar_grid.json", "split", "calib", "simulation.json"):
        if (second / name).is_dir():
            shutil.copytree(second / name, disk / name)
        else:
            shutil.copy(second / name, disk / name)
    wrong = small_config().with_fields({"model.image.size": (32, 80)})
    out = tmp_path / "out"

    def embed(*roots, config, options=()):
        path = small.write_config(tmp_path / "config.py", config)
        command = ["embed", *map(str, roots), "--config", str(path), "--out", str(out)]
        command += ["--image-backbone", str(data.backbone), *options]
        return CliRunner().invoke(main, command)

    failed = embed(disk, config=wrong)
    assert failed.exit_code == 1
    assert "expected 160 x 32 (stereo) or 80 x 32" in failed.output
    half = ("--dtype", "float16")
    done = embed(disk, config=small_config(), options=half)
    assert "4 embedded, 0 found" in done.output, done.output
    done = embed(disk, second, config=small_config())
    assert "8 embedded, 4 found" in done.output, done.output
    assert len(open_embeddings(out).keys()) == 12
    paths = {"roots": (str(disk), str(second)), "embeddings": str(out)}
    paths["records"] = str(tmp_path / "records")
    config = small_config().replace(data=paths)
    own = Data(config, build(config.model))
    assert own.images(own.frames).image(11).dtype == np.float16
    other = embed(disk, config=wrong)
    assert "other records: shape is" in other.output


def test_embed_command(data, from_images, tmp_path, monkeypatch):
    config = small.write_config(tmp_path / "config.py", small_config())
    command = ["embed", str(data.folder), "--config", str(config)]
    command += ["--image-backbone", str(data.backbone), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "12 embedded" in result.stdout
    # Without a folder, the config's dataset is simulated again.
    monkeypatch.chdir(tmp_path)
    command = ["embed", *command[2:], "--out", "again"]
    result = CliRunner().invoke(main, command, catch_exceptions=False)
    assert "12 embedded" in result.stdout
    (made,) = (tmp_path / "data").glob("simulated-*")
    assert (made / "1" / "cam-front").is_dir()
    half = open_embeddings(tmp_path / "out")
    assert np.dtype(half.dtype) == np.float32
    assert half.shape == (2, 6, 96)
