"""Where the data of a run are: found, simulated or projected."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import pathlib
from collections.abc import Sequence

from ml_collections import ConfigDict

from radejax.camera_inputs import saved_path
from radejax.data import projection_job
from radejax.data.kradar import KRadar
from radejax.errors import UserError

_log = logging.getLogger(__name__)


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


def prepare_data(
    config: ConfigDict,
    *,
    data: Sequence[str] | None,
    labels: str | None,
    records: str | None,
    camera_calibration: str | None = None,
) -> DataPaths:
    """Simulates if the config says so, and projects what has no record yet.

    Raises:
        UserError: No data and nothing to simulate; no space left.
        FileNotFoundError: A folder that was named is not there.
    """
    check_folders([camera_calibration] if camera_calibration else [])
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
    return project_data(
        config,
        data,
        labels=labels,
        records=records,
        camera_calibration=camera_calibration,
    )


def project_data(
    config: ConfigDict,
    data: Sequence[str],
    *,
    labels: str | None = None,
    records: str | None = None,
    camera_calibration: str | None = None,
) -> DataPaths:
    """Projects the frames of data folders that have no record yet.

    Args:
        config: Says which labels, see `DataPaths.open`.
        data: K-Radar folders.
        labels: Label revision, see `KRadar`.
        records: Folder of projected frames, beside the first of `data` if None.
        camera_calibration: Folder of camera calibrations, the data's own if None.

    Raises:
        UserError: No frames, or no space left.
        FileNotFoundError: A folder is not there.
    """
    check_folders([*data, *([camera_calibration] if camera_calibration else [])])
    paths = DataPaths(
        roots=tuple(map(saved_path, data)),
        labels=saved_path(labels),
        records=saved_path(records or pathlib.Path(data[0]) / "records"),
        camera_calibration=saved_path(camera_calibration),
    )
    frames = paths.open(config, split=None)
    _log.info("%s", frames.summary().to_text())
    projection_job.project_dataset(frames, paths.records)
    return paths


def check_folders(paths: Sequence[str]) -> None:
    """Raises FileNotFoundError for the first that is no folder."""
    for path in paths:
        if not pathlib.Path(path).is_dir():
            raise FileNotFoundError(f"no such folder: {saved_path(path)}")
