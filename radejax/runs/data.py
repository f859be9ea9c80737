"""Where the data of a run are: found, simulated or projected."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import pathlib
from collections.abc import Sequence

from ml_collections import ConfigDict

from radejax.core.errors import UserError
from radejax.data import cameras
from radejax.data.kradar import KRadar
from radejax.data.kradar.frame import Frame
from radejax.data.records import job
from radejax.data.records.embeddings import open_embeddings
from radejax.interop.image_backbone import has_camera

_log = logging.getLogger(__name__)


def saved_path(path: str | os.PathLike | None) -> str | None:
    """Absolute path as a run keeps it."""
    return None if path is None else str(pathlib.Path(path).absolute())


@dataclasses.dataclass(frozen=True)
class DataPaths:
    """Where the data of a run are.

    Attributes:
        roots: K-Radar folders.
        labels: Folder or zip of a label revision, or None for the sequences' own.
        records: Folder of projected frames.
        embeddings: Folder of embedded images, or None for the images themselves.
        image_backbone: Weights of the image backbone, or None.
        camera_calibration: Folder of camera calibrations; the roots' own if None.
    """

    roots: tuple[str, ...]
    labels: str | None
    records: str
    embeddings: str | None = None
    image_backbone: str | None = None
    camera_calibration: str | None = None

    def open(self, config: ConfigDict, split: str | None) -> KRadar:
        """The frames of a split with the labels that the config asks for."""
        return KRadar(
            self.roots,
            self.labels,
            version=config.data.label_version,
            split=split,
            visibility=config.data.visibility,
            classes=config.classes,
            camera_calibration=self.camera_calibration,
        )

    @classmethod
    def at(cls, data: Sequence[str], **places: str | None) -> DataPaths:
        """Data in the folders `data`; records beside the first where not given.

        Raises:
            UserError: `data` names no folder.
            FileNotFoundError: A folder that was named is not there.
        """
        if isinstance(data, str) or not list(filter(None, data)):
            raise UserError(f"data must be a list of folders, got {data!r}")
        places = {name: saved_path(path) for name, path in places.items() if path}
        _check_folders([*data, *filter(None, [places.get("camera_calibration")])])
        roots = tuple(map(saved_path, data))
        records = str(pathlib.Path(roots[0]) / "records")
        return cls(**{"roots": roots, "labels": None, "records": records, **places})


@dataclasses.dataclass(frozen=True)
class OtherData:
    """Data to evaluate a run on in place of its own.

    What is None stays as the run had it, unless `data` are other folders.

    Attributes:
        data: K-Radar folders, or none for the run's.
        labels: Label revision, see `KRadar`.
        label_version: Its version; the config's if None.
        records: Folder of projected frames, beside the first of `data` if None.
        camera_calibration: Folder of camera calibrations, the data's own if None.
        embeddings: Folder of `radejax embed`, in place of images.
    """

    data: tuple[str, ...] = ()
    labels: str | None = None
    label_version: str | None = None
    records: str | None = None
    camera_calibration: str | None = None
    embeddings: str | None = None

    def paths(self, own: DataPaths | None) -> DataPaths:
        """Where they are, for a run whose own data are at `own`.

        Raises:
            UserError: No folders here, and the run has none.
            FileNotFoundError: A folder that was named is not there.
        """
        names = ("labels", "records", "camera_calibration", "embeddings")
        places = {name: getattr(self, name) for name in names}
        if own is not None and tuple(map(saved_path, self.data)) in ((), own.roots):
            given = {name: path for name, path in places.items() if path is not None}
            kept = {name: getattr(own, name) for name in names}
            found = DataPaths.at(own.roots, **{**kept, **given})
            return dataclasses.replace(found, image_backbone=own.image_backbone)
        return DataPaths.at(self.data, **places)

    @property
    def name(self) -> str:
        """What tells results on them from others: names of the folder and labels."""
        parts = [pathlib.Path(path).resolve() for path in self.data[:1]]
        parts = [path.name for path in parts]
        if self.labels is not None:
            parts.append(pathlib.Path(self.labels).resolve().stem)
        return "_".join(filter(None, parts)) or "other"


def prepare_data(
    config: ConfigDict,
    *,
    data: Sequence[str] | None,
    labels: str | None,
    records: str | None,
    camera_calibration: str | None = None,
) -> DataPaths:
    """Simulates if the config says so, and projects what has no record yet.

    One process of several does so before the others, see `processes.main_first`.

    Raises:
        UserError: No data and nothing to simulate; no space left.
        FileNotFoundError: A folder that was named is not there.
    """
    if camera_calibration is not None:  # simulating takes long
        _check_folders([camera_calibration])
    simulation = config.get("simulation")
    if data is None and simulation is None:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as configs/quickstart.py"
        )
    if simulation is not None:
        if data is None:
            digest = hashlib.sha256(simulation.to_json().encode()).hexdigest()[:8]
            data = [str(pathlib.Path("data") / f"simulated-{digest}")]
        if len(data) != 1:
            raise UserError(f"a simulated data set has one folder, got {list(data)}")
        from radejax.simulation.dataset import simulate_dataset

        simulate_dataset(simulation, data[0])
    paths = DataPaths.at(
        data, labels=labels, records=records, camera_calibration=camera_calibration
    )
    project(config, paths)
    return paths


def project(config: ConfigDict, paths: DataPaths) -> None:
    """Projects the frames that have no record yet.

    Raises:
        UserError: No frames, records of something else, or no space left.
    """
    frames = paths.open(config, split=None)
    _log.info("%s", frames.summary().to_text())
    job.project_dataset(frames, paths.records)


def camera_inputs(
    config: ConfigDict,
    frames: Sequence[Frame],
    embeddings: str | os.PathLike | None = None,
) -> cameras.CameraInputs | None:
    """Images and cameras of frames as the config says; None without a camera.

    Args:
        config: Of the run; `model.image` and `data.camera` are read.
        frames: Of a data set.
        embeddings: Folder of `radejax embed`, in place of the images.

    Raises:
        UserError: Images, calibrations or embeddings are missing or of another size or
            backbone.
    """
    if not has_camera(config):
        if embeddings is not None:
            raise UserError(
                f"embeddings are given, but config.model.name is {config.model.name!r}, "
                "which has no camera"
            )
        return None
    features = None
    if embeddings is not None:
        cameras.check_embeddable(
            freeze=config.model.image.freeze,
            mirror_probability=config.data.mirror_probability,
        )
        features = open_embeddings(embeddings, config.model.image)
    options = cameras.CameraOptions.of_config(config.data)
    return cameras.camera_inputs(frames, config.model.image.size, options, features)


def _check_folders(paths: Sequence[str]) -> None:
    for path in paths:
        if not pathlib.Path(path).is_dir():
            raise FileNotFoundError(f"no such folder: {saved_path(path)}")
