"""The readers of foreign files, with small valid files written by our own writers."""

import functools
import pathlib
import shutil

import numpy as np
import safetensors.numpy

from radejax.core import files
from radejax.data.kradar import KRadar, conditions, folders, labels, motion, write
from radejax.data.kradar.tesseract import project_file, read_projection_npy
from radejax.geometry.camera import CameraCalibration
from radejax.inference.saved import load_torch
from radejax.weights import radenet_torch

from .. import small_models as small
from ..data.conftest import make_labels, write_kradar
from ..torch_files import write_pth
from .engine import Reader

Folder = pathlib.Path
GRID = small.small_grid()


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def _root(folder: Folder) -> None:
    write_kradar(folder, sequences=(1,), num_frames=2, grid=GRID)
    table = f"{motion.OBJECT_HEADER}\n00004_00001,Sedan,0,1.5,-0.5\n"
    files.write_text(folder / "1/info_motion/objects.csv", table)
    (folder / "1/cam_1.yml").write_text(small.calibration().to_kradar_text())


def _read_root(folder: Folder) -> None:
    data = KRadar([folder], split="train")
    data.summary().to_text()
    assert all(np.isfinite(frame.boxes).all() for frame in data)


def _labels(folder: Folder, version: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(3):
        path = folder / f"0000{index}_00001.txt"
        objects = make_labels(_rng(), 2 * index)
        write.write_labels(path, (index, 1, 2, 1, 3), 1.6e9, objects, version)


def _read_labels(folder: Folder, version: str) -> None:
    for path in folder.glob("*.txt"):
        found = labels.read_label_file(path, version).labels
        assert np.isfinite([label.box for label in found]).all()
        assert all(min(label.box[3:6]) > 0 for label in found)
        labels.read_labels(path, version)


def _label_zip(folder: Folder) -> None:
    _labels(folder / "labels/1", "v2.1")
    shutil.make_archive(str(folder / "labels"), "zip", folder / "labels")


def _read_label_zip(folder: Folder) -> None:
    KRadar(labels=folder / "labels.zip").summary().to_text()


def _tensor(folder: Folder, kind: str) -> None:
    power = (10 ** _rng().uniform(2, 15, GRID.shape_drea)).astype(np.float32)
    write.write_tesseract(folder / "a.mat", power, compress=kind == "deflated")
    np.save(folder / "a.npy", np.log10(power[0]).transpose(1, 0, 2))


def _read_tensor(folder: Folder) -> None:
    assert np.isfinite(project_file(folder / "a.mat", shape_drea=GRID.shape_drea)).all()


def _read_projection(folder: Folder) -> None:
    shape = GRID.num_range, GRID.num_azimuth, GRID.num_elevation
    assert read_projection_npy(folder / "a.npy", shape).shape == shape


def _weights(folder: Folder, suffix: str) -> None:
    detector = small.detector()
    state = radenet_torch.save(detector.model, detector.variables)
    path = folder / f"a{suffix}"
    if suffix == ".pth":
        write_pth(path, state)
    else:
        safetensors.numpy.save_file(state, path)


def _read_weights(folder: Folder, suffix: str) -> None:
    bins = {"doppler_bins": 2, "elevation_bins": 3}
    load_torch(folder / f"a{suffix}", num_groups=4, **bins)


def _of_root(read: object, path: str) -> Reader:
    """A reader of one file of a small dataset."""
    return Reader(_root, lambda folder: read(folder / path), path)


def _camera(path: Folder) -> None:
    CameraCalibration.from_kradar(path).camera()


READERS = {
    f"labels {version}": Reader(
        functools.partial(_labels, version=version),
        functools.partial(_read_labels, version=version),
        "*.txt",
    )
    for version in labels.VERSIONS
}
READERS |= {
    "label zip": Reader(_label_zip, _read_label_zip, "*.zip", 60),
    "split": _of_root(folders.read_split, "split/train.txt"),
    "calibration": _of_root(
        folders.read_calibration, "1/info_calib/calib_radar_lidar.txt"
    ),
    "description": _of_root(conditions.read_description, "1/description.txt"),
    "camera yml": _of_root(_camera, "1/cam_1.yml"),
    "dataset": Reader(_root, _read_root, "**/*.txt", 50),
    "projection npy": Reader(
        functools.partial(_tensor, kind="plain"),
        _read_projection,
        "a.npy",
    ),
}
READERS |= {
    f"tensor {kind}": Reader(
        functools.partial(_tensor, kind=kind), _read_tensor, "a.mat"
    )
    for kind in ("plain", "deflated")
}
READERS |= {
    f"weights {suffix}": Reader(
        functools.partial(_weights, suffix=suffix),
        functools.partial(_read_weights, suffix=suffix),
        "a*",
        20,
    )
    for suffix in (".pth", ".safetensors")
}
