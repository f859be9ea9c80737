"""Every reader of the package, with a small valid folder written by our own writers."""

import json
import pathlib
import shutil
from collections.abc import Callable, Iterable

import grain
import jax.numpy as jnp
import numpy as np
from PIL import Image

from radejax.core import files
from radejax.core.config import load_module
from radejax.core.structures import CLASSES
from radejax.data.images import read_left_image
from radejax.data.kradar import KRadar, conditions, labels, write
from radejax.data.kradar import dataset as kradar
from radejax.data.records import embeddings, job
from radejax.data.records.files import RecordFileWriter, file_name, read_manifest_of
from radejax.data.records.projections import RecordSource
from radejax.data.tesseract import project_file, read_projection_npy
from radejax.evaluation import files as predictions
from radejax.evaluation import kitti
from radejax.evaluation.boxes import KNOWN_CLASSES
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load
from radejax.geometry.camera import CameraCalibration
from radejax.inference.saved import load_model, save_model
from radejax.runs import evaluate, seeds, workdir
from radejax.runs.data import DataPaths
from radejax.simulation import dataset
from radejax.simulation.config import SimulationConfig
from radejax.training.checkpoints import Checkpoints
from radejax.training.metric_logger import _remove_after
from radejax.visualize.curves import read_metrics
from radejax.weights import dinov3_hf, radenet_torch
from radejax.weights.convert import write_state_dict

from .. import small_models as small
from ..data.conftest import make_labels, write_kradar
from ..torch_files import write_pth
from .engine import Reader

Folder = pathlib.Path
GRID = small.small_grid()
GOLDEN = Folder(__file__).resolve().parents[1] / "golden"
FRAMES = ["1/00004_00001", "1/00005_00002"]


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


# Data sets ---------------------------------------------------------------------------


def _root(folder: Folder) -> None:
    write_kradar(folder, sequences=(1,), num_frames=2, grid=GRID)
    (folder / "1/cam_1.yml").write_text(small.calibration().to_kradar_text())


def _labels(folder: Folder, version: str) -> None:
    for index in range(3):
        path = folder / f"0000{index}_00001.txt"
        objects = make_labels(_rng(), 2 * index)
        write.write_labels(path, (index, 1, 2, 1, 3), 1.6e9, objects, version)


def _read_labels(folder: Folder, version: str) -> None:
    for path in folder.glob("*.txt"):
        content, problems = path.read_bytes(), []
        found = labels.parse_label_file(content, version, problems=problems).labels
        assert np.isfinite([label.box for label in found]).all()
        assert all(min(label.box[3:6]) > 0 for label in found)
        labels.read_labels(path, version)


def _label_zip(folder: Folder) -> None:
    _labels(folder / "labels" / "1", "v2.1")
    shutil.make_archive(str(folder / "labels"), "zip", folder / "labels")


def _read_label_zip(folder: Folder) -> None:
    data = KRadar(labels=folder / "labels.zip")
    data.summary().to_text()


def _read_root(folder: Folder) -> None:
    data = KRadar([folder], split="train")
    data.summary().to_text()
    assert all(np.isfinite(frame.boxes).all() for frame in data)


def _tesseract(folder: Folder, kind: str) -> None:
    power = (10 ** _rng().uniform(2, 15, GRID.shape_drea)).astype(np.float32)
    if kind == "npy":
        np.save(folder / "a.npy", np.log10(power[0]).transpose(1, 0, 2))
    else:
        write.write_tesseract(folder / "a.mat", power, compress=kind == "deflated")


def _read_tesseract(folder: Folder, _kind: str) -> None:
    assert np.isfinite(project_file(folder / "a.mat", shape_drea=GRID.shape_drea)).all()


def _images(folder: Folder) -> None:
    picture = Image.fromarray(small.images(1)[0])
    for name in ("a.png", "b.jpg"):
        picture.save(folder / name)


def _read_images(folder: Folder) -> None:
    for name in ("a.png", "b.jpg"):
        image = read_left_image(folder / name, small.IMAGE_SIZE, resize=True)
        assert image.shape == (*small.IMAGE_SIZE, 3)


# Records and simulations -------------------------------------------------------------


def _records(folder: Folder) -> None:
    write_kradar(folder / "root", sequences=(1,), num_frames=2, grid=GRID)
    job.project_dataset(KRadar([folder / "root"]), folder / "records", progress=False)


def _read_records(folder: Folder) -> None:
    records = RecordSource(folder / "records", grid=GRID)
    for index in range(len(records)):
        records.read(index)
    records.manifest.to_dict()


def _project_again(folder: Folder) -> None:
    data = KRadar([folder / "root"])
    job.project_dataset(data, folder / "records", progress=False, num_workers=0)
    read_manifest_of(folder / "records", file_name(0, 1))


IMAGE = {"kind": "vit", "size": [32, 48]}


def _embeddings(folder: Folder) -> None:
    with RecordFileWriter(folder, file_name(0, 1, "embeddings")) as writer:
        for key in FRAMES:
            writer.write(key, np.ones((2, 3, 8), np.float32))
        entry = writer.commit()
    manifest = {"format": embeddings.FORMAT, "version": 1, "image": IMAGE}
    manifest |= {"shape": [2, 3, 8], "dtype": "float32", "weights_sha256": "ab"}
    files.write_json(folder / "manifest.json", manifest | {"files": [vars(entry)]})


def _read_embeddings(folder: Folder) -> None:
    records = embeddings.open_embeddings(folder, IMAGE)
    for index in range(len(records)):
        records.read(index)
    embeddings.embeddings_sha256(folder)


SIMULATION = SimulationConfig(train_sequences=1, test_sequences=0)


def _simulation(folder: Folder) -> None:
    content = dataset._marker(SIMULATION) | {"finished": True}
    files.write_json(folder / "simulation.json", content)


# Evaluation --------------------------------------------------------------------------


def _table(count: int = 5) -> dict[str, np.ndarray]:
    box = _rng().uniform(1, 9, (count, 7))
    cls = np.array(KNOWN_CLASSES)[np.arange(count) % 5]
    return {
        "frame": np.arange(count) % 3,
        "cls": cls,
        "box": box,
        "score": box[:, 0] / 9,
    }


def _frames() -> dict[str, np.ndarray]:
    names = np.array([f"0000{i}_00001" for i in range(3)])
    weather = np.array(["fog", "rain", "fog"])
    return {
        "frame": np.arange(3),
        "name": names,
        "sequence": np.ones(3, int),
        "weather": weather,
    }


def _report(folder: Folder) -> None:
    columns = {k: v.tolist() for k, v in _frames().items()}
    files.write_json(folder / "frames.json", columns)
    files.write_json(folder / "source.json", {"roots": ["nowhere"], "labels": None})
    for name in ("predictions", "ground_truth"):
        predictions.write_table(folder / f"{name}.npz", _table(), _frames())


def _read_report(folder: Folder) -> None:
    truth, found, frames, _ = load(folder, Source(), CLASSES)
    EvaluationSet(truth, found, frames=frames, classes=CLASSES)
    evaluate._check_source(folder, {"roots": ["nowhere"]})


def _predictions(folder: Folder, suffix: str) -> None:
    predictions.write_table(folder / f"p{suffix}", _table(), _frames())


def _read_predictions(folder: Folder, suffix: str) -> None:
    found = predictions.read_table(folder / f"p{suffix}", _frames())
    EvaluationSet(found, found, frames=_frames(), classes=CLASSES)


def _kitti(folder: Folder) -> None:
    kitti.write_kitti(folder, _table(), _table(), _frames())


def _read_kitti(folder: Folder) -> None:
    truth, found, frames = kitti.read_kitti(folder)
    EvaluationSet(truth, found, frames=frames, classes=CLASSES)


# Runs and models ---------------------------------------------------------------------


def _workdir(folder: Folder) -> None:
    (folder / "checkpoints" / "1").mkdir(parents=True)
    with workdir.claimed(folder, small.radar_config()):
        pass
    paths = DataPaths(("nowhere",), None, "nowhere/records")
    files.write_json(folder / "run.json", workdir.run_info(folder, paths))
    rows = [json.dumps({"step": step, "loss": 1.5 * step}) for step in range(5)]
    (folder / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    names = [*seeds._KEYS, "ap", "num_gt"]
    lines = [
        names,
        *(["all_point", "all", "Sedan", "bev", "0.3", "12.5", "7"] for _ in range(3)),
    ]
    lines[1:] = [line[: len(names)] for line in lines[1:]]
    (folder / "metrics.csv").write_text("\n".join(map(",".join, lines)))


def _read_workdir(folder: Folder) -> None:
    with workdir.claimed(folder, small.radar_config()):
        pass
    workdir.run_info(folder, DataPaths(("nowhere",), None, "nowhere/records"))
    read_metrics(folder / "metrics.jsonl")
    _remove_after(3, folder / "metrics.jsonl")
    seeds.read_aps(folder / "metrics.csv")


def _packed(folder: Folder, kind: str) -> None:
    save_model(small.saved(kind), folder, with_backbone=True)


def _dinov3(folder: Folder) -> None:
    load_module(GOLDEN / "dinorade_make.py").write_tiny_folder(folder)


def _torch(folder: Folder, suffix: str) -> None:
    detector = small.detector()
    state = radenet_torch.save(detector.model, detector.variables)
    if suffix == ".pth":
        write_pth(folder / f"a{suffix}", state)
    else:
        write_state_dict(folder / f"a{suffix}", state)


def _read_torch(folder: Folder, suffix: str) -> None:
    radenet_torch.load(
        folder / f"a{suffix}", num_groups=4, doppler_bins=2, elevation_bins=3
    )


def _checkpoints(folder: Folder) -> None:
    detector, config = small.detector(), small.radar_config()
    info = workdir.checkpoint_info(config, GRID, {}, {})
    state = {"params": detector.variables["params"], "step": jnp.int32(1)}
    positions = grain.MapDataset.range(9).to_iter_dataset(
        grain.ReadOptions(num_threads=0)
    )
    with Checkpoints(folder / "checkpoints", max_to_keep=None) as checkpoints:
        checkpoints.save(1, state, iter(positions), info=info)


def _kinds(
    name: str,
    kinds: Iterable[str],
    make: Callable[[Folder, str], object],
    read: Callable[[Folder, str], object],
    files: str,
    count: int = 500,
) -> dict[str, Reader]:
    """A reader for each kind of a file."""
    return {
        f"{name} {kind}": Reader(
            lambda folder, kind=kind: make(folder, kind),
            lambda folder, kind=kind: read(folder, kind),
            files,
            count=count,
        )
        for kind in kinds
    }


READERS: dict[str, Reader] = {
    **_kinds("labels", labels.VERSIONS, _labels, _read_labels, "*.txt"),
    "label zip": Reader(_label_zip, _read_label_zip, "*.zip", count=150),
    "split": Reader(
        _root, lambda f: kradar.read_split(f / "split/train.txt"), "split/train.txt"
    ),
    "calibration": Reader(
        _root,
        lambda f: kradar.read_calibration(f / "1/info_calib/calib_radar_lidar.txt"),
        "1/info_calib/*.txt",
    ),
    "description": Reader(
        _root,
        lambda f: conditions.read_description(f / "1/description.txt"),
        "1/description.txt",
    ),
    "camera yml": Reader(
        _root,
        lambda f: CameraCalibration.from_kradar(f / "1/cam_1.yml").camera(),
        "1/*.yml",
    ),
    "radar_grid.json": Reader(
        _root, lambda f: kradar.read_grid([f]), "radar_grid.json"
    ),
    "data set": Reader(_root, _read_root, "**/*.txt", "*.json", count=200),
    **_kinds("tesseract", ("plain", "deflated"), _tesseract, _read_tesseract, "a.mat"),
    "projection npy": Reader(
        lambda f: _tesseract(f, "npy"),
        lambda f: read_projection_npy(f / "a.npy"),
        "a.npy",
    ),
    "images": Reader(_images, _read_images, "*"),
    "records": Reader(_records, _read_records, "records/*", count=200),
    "plan.json": Reader(
        _records, _project_again, "records/*.json", count=100, writes=True
    ),
    "embeddings": Reader(_embeddings, _read_embeddings, "*", count=200),
    "simulation.json": Reader(
        _simulation, lambda f: dataset._is_finished(f, SIMULATION), "*"
    ),
    "report": Reader(_report, _read_report, "*.json", "*.npz", count=200),
    **_kinds(
        "predictions",
        (".npz", ".json"),
        _predictions,
        _read_predictions,
        "p*",
        150,
    ),
    "kitti": Reader(_kitti, _read_kitti, "0.0/all/**/*", count=200),
    "work folder": Reader(
        _workdir, _read_workdir, "*.json", "*.jsonl", "*.csv", count=200, writes=True
    ),
    "packed": Reader(lambda f: _packed(f, "radar"), load_model, "*", count=60),
    "packed camera": Reader(lambda f: _packed(f, "camera"), load_model, "*", count=20),
    "dinov3": Reader(_dinov3, dinov3_hf.load, "*", count=60),
    **_kinds("torch", (".pth", ".npz", ".safetensors"), _torch, _read_torch, "a*", 20),
    "checkpoint": Reader(_checkpoints, load_model, "checkpoints/**/*", count=5),
}
"""By name; the order is that of the tables."""
