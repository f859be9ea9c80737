"""Radar-camera runs from images and from embeddings, with a frozen backbone from files."""

import copy
import dataclasses
import json
import logging
import os
import pathlib
import re
import shutil

import jax
import numpy as np
import pytest
from click.testing import CliRunner

from radejax.cli.main import main
from radejax.config import load_config, load_module
from radejax.core.errors import DataError, UserError
from radejax.data.cameras import require_images
from radejax.data.records import open_embeddings
from radejax.inference.saved import load_model
from radejax.models import build
from radejax.runs import experiment
from radejax.runs.data import Data, data_of_run
from radejax.runs.evaluate import evaluate_run
from radejax.weights import image_backbone

from . import small_models as small

pytestmark = [
    pytest.mark.slow,  # several programs to compile
    pytest.mark.usefixtures("commands_on_one_device"),
]

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
    mesh: jax.sharding.Mesh

    def train(self, name, config=None, init_from=None, **paths):
        data = paths | {"roots": (str(self.folder),)}
        config = (config or small_config()).replace(data=data)
        workdir = self.runs / name
        experiment.run(config, workdir, init_from=init_from, mesh=self.mesh)
        return workdir

    def losses(self, workdir):
        rows = map(json.loads, (workdir / "metrics.jsonl").read_text().splitlines())
        return [[row[k] for k in ("focal", "gwd", "smooth_l1")] for row in rows]


def opened(workdir):
    """Model and data of a run."""
    loaded = load_model(workdir)
    return loaded, data_of_run(loaded)[1]


@pytest.fixture(scope="module")
def data(tmp_path_factory, make, one_device):
    root = tmp_path_factory.mktemp("fusion")
    (root / "dinov3").mkdir()
    return _Data(
        root / "data", make.write_tiny_folder(root / "dinov3"), root, one_device
    )


@pytest.fixture(scope="module")
def from_images(data):
    return data.train("images", image_backbone=str(data.backbone))


def embed(data, config, out, *options):
    """Run `radejax embed` and return its result."""
    path = small.write_config(data.runs / "config.py", config)
    command = ["embed", str(data.folder), "--config", str(path), "--out", str(out)]
    command += ["--image-backbone", str(data.backbone), *options]
    return CliRunner().invoke(main, command)


@pytest.fixture(scope="module")
def embeddings(data, from_images, tmp_path_factory):
    out = tmp_path_factory.mktemp("embeddings")
    path = min(data.folder.glob("1/cam-front/*.png"))
    content, state = path.read_bytes(), path.stat()
    path.write_bytes(b"")
    result = embed(data, small_config(), out)
    assert "12 frames: 0 were done, 11 preprocessed, 1 skipped" in result.output
    assert result.exit_code == 1
    assert f"{path}: corrupted" in result.output
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    for counts in ("11 were done, 1 preprocessed", "12 were done, 0 preprocessed"):
        assert counts in embed(data, small_config(), out).output
    wrong = small_config().with_fields({"model.image.size": (16, 48)})
    assert "other records: options.shape is" in embed(data, wrong, out).output
    found = open_embeddings(out)
    assert (found.shape, np.dtype(found.dtype)) == ((2, 6, 96), np.float32)
    return out


@pytest.fixture(scope="module")
def from_embeddings(data, embeddings):
    return data.train("embedded", embeddings=str(embeddings))


def test_frozen_backbone_is_in_no_checkpoint_and_comes_back(data, from_images):
    variables = load_model(from_images).variables
    model = build(small_config().model)
    given = image_backbone.load_image_backbone(data.backbone, model)["params"]
    assert_same(variables["params"]["image_backbone"], given["image_backbone"])
    stored = from_images / "checkpoints"
    names = [*map(str, stored.rglob("*"))]
    names += [path.read_text() for path in stored.rglob("_METADATA")]
    assert "image_neck" in "".join(names)
    assert "image_backbone" not in "".join(names)
    path = from_images / "evaluation" / "camera_share.json"
    share = json.loads(path.read_text())["all"]
    assert share["frames"] == 4
    assert 0 < share["mean"] < 1


def assert_same(found, wanted):
    jax.tree.map(np.testing.assert_array_equal, found, wanted)


def test_training_from_embeddings_is_the_same(from_images, from_embeddings, data):
    found, wanted = data.losses(from_embeddings), data.losses(from_images)
    assert len(found) == len(wanted) > 0
    np.testing.assert_allclose(found, wanted, rtol=2e-5)
    # The evaluation uses the embeddings too: the backbone's weights do not exist.
    assert "image_backbone" not in load_model(from_embeddings).variables["params"]
    reports = [
        json.loads((run / "evaluation" / "metrics.json").read_text())["ap"]
        for run in (from_embeddings, from_images)
    ]
    assert reports[0] == reports[1]


def test_example_compares_fusion_and_radar_by_the_lens(
    data, from_images, tmp_path, monkeypatch
):
    # Intervals resample sequences, of which the test split has only one.
    split = data.folder / "split"
    texts = [(split / f"{name}.txt").read_text() for name in ("test", "train")]
    other = shutil.copytree(data.folder, tmp_path / "other")
    (other / "split" / "test.txt").write_text("\n".join(texts))
    run = shutil.copytree(from_images, tmp_path / "run")
    evaluate_run(run, num_visualizations=0, other={"roots": (str(other),)})
    script = load_module(CONFIG.parents[1] / "examples" / "fusion_by_lens.py")
    arguments = [str(run), str(run), "--data", str(other), "--resamples", "10"]
    result = CliRunner().invoke(script.main, arguments)
    assert result.exit_code == 0, result.output
    # A run compared with itself has no gain.
    rows = json.loads((run / "by_lens_other" / "by_lens.json").read_text())["ap"]
    assert {row["frames"] for row in rows if row["condition"] == "all"} == {12}
    assert {row["difference"] for row in rows} == {0.0}


def test_a_run_that_starts_from_another_keeps_its_backbone(data, from_images):
    # Without --image-backbone, the initial weights include the backbone's.
    config = small_config().replace(train={"num_epochs": 1})
    workdir = data.train("continued", config, init_from=str(from_images))
    first, second = (load_model(w).variables["params"] for w in (from_images, workdir))
    assert_same(first["image_backbone"], second["image_backbone"])
    with pytest.raises(AssertionError):
        assert_same(first["image_neck"], second["image_neck"])


def test_a_backbone_that_is_gone_leaves_embedded_images(
    data, from_images, tmp_path, caplog
):
    moved = data.backbone.rename(tmp_path / "moved")
    try:
        with caplog.at_level(logging.WARNING):
            run = load_model(from_images)
        again = load_model(from_images, image_backbone=moved)
    finally:
        moved.rename(data.backbone)
    assert re.search("image backbone .*not found at", caplog.text)
    assert "image_backbone" not in run.variables["params"]
    assert "image_backbone" in again.variables["params"]


def test_images_that_are_not_embedded_are_an_error(from_images, embeddings):
    _, own = opened(from_images)
    frames = list(own.split("test"))
    embedded = copy.copy(own)
    embedded.features = open_embeddings(embeddings)
    other = [dataclasses.replace(frames[0], name="99999_99999"), *frames[1:]]
    with pytest.raises(UserError, match=r"1 of 4 frames have an image that"):
        embedded.images(other)
    # Images with embeddings need no files.
    gone = [dataclasses.replace(frame, camera_path=None) for frame in frames]
    inputs = embedded.images(gone)
    assert all(camera.is_valid for camera in inputs.cameras)
    inputs = own.images(gone)
    with pytest.raises(UserError, match=r"\(4\) can use the camera: 4 have no front"):
        require_images(gone, inputs)


def test_other_data_without_cameras_are_an_error(data, from_images, tmp_path):
    other = shutil.copytree(data.folder, tmp_path / "other")
    shutil.rmtree(other / "records")
    for image in other.rglob("cam-front*.png"):
        image.unlink()
    with pytest.raises(UserError, match=r"no frame of the test split .* front image"):
        evaluate_run(from_images, other={"roots": (str(other),)})
    assert not (other / "records").exists()


def test_embeddings_that_do_not_fit_are_rejected(data, embeddings, tmp_path):
    config = small_config()
    paths = {"roots": (str(data.folder),), "records": str(data.folder / "records")}
    paths["embeddings"] = str(embeddings)

    def open_data(fields):
        changed = config.replace(data=paths).with_fields(fields)
        return Data(changed)

    for call, message in (
        (lambda: open_data({"data.mirror_probability": 0.5}), "cannot be mirrored"),
        (lambda: open_embeddings(tmp_path / "nothing"), "radejax embed"),
    ):
        with pytest.raises((UserError, DataError, FileNotFoundError), match=message):
            call()
