"""Where the data of a run are: what a user says, and the folders that are meant."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

from radejax.core.errors import UserError


def saved_path(path: str | os.PathLike | None) -> str | None:
    """Absolute path as a run keeps it."""
    return None if path is None else str(pathlib.Path(path).absolute())


@dataclasses.dataclass(frozen=True)
class Sources:
    """What a user says of the data; what is None is found, made or the run's own.

    Attributes:
        data: K-Radar folders. Without any a config may say what to simulate.
        labels: Label revision, see `KRadar`; the sequences' own if None.
        label_version: Its version, in place of the config's.
        sequences: Only these, and only of this `weather`, in place of the config's.
        records: Folder of projected frames, beside the first of `data` if None.
        camera_calibration: Folder of camera calibrations, the data's own if None.
        embeddings: Folder of `radejax embed`, in place of images.
        image_backbone: Weights of the image backbone.
    """

    data: Sequence[str] = ()
    labels: str | None = None
    label_version: str | None = None
    sequences: Sequence[int] = ()
    weather: Sequence[str] = ()
    records: str | None = None
    camera_calibration: str | None = None
    embeddings: str | None = None
    image_backbone: str | None = None

    def paths(self, own: DataPaths | None = None) -> DataPaths:
        """Where they are.

        Args:
            own: Of a run that these stand for: what is None stays as the run had it,
                unless `data` are other folders.

        Raises:
            UserError: No folders here, and the run has none.
            FileNotFoundError: A folder that was named is not there.
        """
        if isinstance(self.data, str):
            raise UserError(f"data must be a list of folders, got {self.data!r}")
        roots = tuple(str(pathlib.Path(path).absolute()) for path in self.data if path)
        places: dict[str, Any] = {
            field.name: saved_path(getattr(self, field.name))
            for field in dataclasses.fields(DataPaths)
            if field.name != "roots"
        }
        if own is not None and roots in ((), own.roots):
            kept = dataclasses.asdict(own)
            places = {k: kept[k] if v is None else v for k, v in places.items()}
            roots = own.roots
        if not roots:
            raise UserError(f"data must be a list of folders, got {self.data!r}")
        check_folders([*roots, *filter(None, [places["camera_calibration"]])])
        places["records"] = places["records"] or str(pathlib.Path(roots[0]) / "records")
        return DataPaths(roots, **places)

    @property
    def name(self) -> str:
        """What tells results on them from others: folder, labels, sequences, weather."""
        parts = [pathlib.Path(path).resolve().name for path in self.data[:1]]
        if self.labels is not None:
            parts.append(pathlib.Path(self.labels).resolve().stem)
        parts += ["-".join(map(str, part)) for part in (self.sequences, self.weather)]
        return "_".join(filter(None, parts)) or "other"


@dataclasses.dataclass(frozen=True)
class DataPaths:
    """Where the data of a run are, absolute; `Sources` says of what.

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

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> DataPaths:
        """Inverse of `dataclasses.asdict`, also after JSON."""
        return cls(**{**fields, "roots": tuple(fields["roots"])})


def check_folders(paths: Iterable[str]) -> None:
    """`FileNotFoundError` for a folder that is not there."""
    for path in paths:
        if not pathlib.Path(path).is_dir():
            raise FileNotFoundError(f"no such folder: {saved_path(path)}")
