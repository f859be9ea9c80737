"""The data of a run: where they are, and one object that gives frames and batches."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import logging
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import grain
import jax
from ml_collections import ConfigDict

from radejax import models
from radejax.core.errors import UserError
from radejax.core.structures import Batch
from radejax.data.augment import make_augmentation
from radejax.data.cameras import (
    CameraInputs,
    CameraOptions,
    camera_inputs,
    check_embeddable,
    require_images,
)
from radejax.data.dataset import FrameSequence, LabelledFrames, data_set
from radejax.data.frame_table import make_table
from radejax.data.pipeline import LoaderOptions, check_enough, make_loader
from radejax.data.records import job
from radejax.data.records.arrays import ArrayRecords
from radejax.data.records.embeddings import open_embeddings
from radejax.data.records.projections import (
    RecordSource,
    describe_grid,
    skipped_frames,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.packed import LoadedModel
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.simulation.dataset import simulate_dataset
from radejax.training import processes

_log = logging.getLogger(__name__)


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
        records: Folder of projected frames, beside the first of `data` if None.
        camera_calibration: Folder of camera calibrations, the data's own if None.
        embeddings: Folder of `radejax embed`, in place of images.
        image_backbone: Weights of the image backbone.
    """

    data: Sequence[str] = ()
    labels: str | None = None
    label_version: str | None = None
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
        roots = tuple(saved_path(path) for path in self.data if path)
        places = {
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
        """What tells results on them from others: names of the folder and labels."""
        parts = [pathlib.Path(path).resolve().name for path in self.data[:1]]
        if self.labels is not None:
            parts.append(pathlib.Path(self.labels).resolve().stem)
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


@dataclasses.dataclass(frozen=True)
class Data:
    """Frames, records and cameras of a run, opened once.

    Attributes:
        paths: Where they are.
        frames: All of them, with the labels that the config asks for.
        classes: Names in the order of the class indices.
        options: `config.data`.
        camera: How images and calibrations are used; None for the radar alone.
        image_size: Height and width that the model takes, or None.
        features: Embedded images, or None.
        grid: That the records must have; None takes any.
    """

    paths: DataPaths
    frames: LabelledFrames
    classes: tuple[str, ...]
    options: ConfigDict
    camera: CameraOptions | None
    image_size: tuple[int, int] | None
    features: ArrayRecords | None
    grid: RadarGrid | None = None

    @classmethod
    def open(
        cls,
        config: ConfigDict,
        model: nn.Module,
        paths: DataPaths,
        grid: RadarGrid | None = None,
    ) -> Data:
        """Reads the labels; nothing is written.

        Raises:
            UserError: Embeddings are given and are of another backbone, or the model
                has none.
        """
        camera = features = None
        if models.has_camera(model):
            camera = CameraOptions.of_config(config.data)
            if paths.embeddings is not None:
                check_embeddable(
                    freeze=model.freeze,
                    mirror_probability=config.data.mirror_probability,
                )
                features = open_embeddings(paths.embeddings, config.model.image)
        elif paths.embeddings is not None:
            raise UserError(
                "embeddings are given, but config.model.name is "
                f"{config.model.name!r}, which has no camera"
            )
        frames = data_set(config.data.get("format", "kradar"))(
            paths.roots,
            paths.labels,
            version=config.data.label_version,
            visibility=config.data.visibility,
            classes=config.classes,
            camera_calibration=paths.camera_calibration,
            # Runs of before are without these two fields.
            sequence_numbers=config.data.get("sequences") or None,
            weather=config.data.get("weather") or None,
        )
        return cls(
            paths=paths,
            frames=frames,
            classes=tuple(config.classes),
            options=config.data,
            camera=camera,
            image_size=None if camera is None else tuple(model.image_size),
            features=features,
            grid=grid,
        )

    def project(self) -> None:
        """Projects the frames that have no record yet.

        Raises:
            UserError: No frames, records of something else, or no space left.
        """
        processes.main_first(
            lambda: job.project_dataset(
                self.frames, self.paths.records, retry_skipped=False
            )
        )
        self._splits.clear()  # frames may have been left out now

    @functools.cached_property
    def records(self) -> RecordSource:
        """Projections of the frames."""
        return RecordSource(self.paths.records, grid=self.grid)

    @functools.cached_property
    def _splits(self) -> dict[str | None, LabelledFrames]:
        return {}

    def split(self, name: str | None) -> LabelledFrames:
        """Frames of "train", "test" or a split file; all for None.

        Without those that were left out when they were projected, which are counted.
        """
        if name not in self._splits:
            frames = self.frames if name is None else self.frames.of_split(name)
            skipped = skipped_frames(self.paths.records)
            if any(frame.key in skipped for frame in frames):
                frames = frames.without(skipped, "no record of them")
            self._splits[name] = frames
        return self._splits[name]

    def images(self, frames: FrameSequence) -> CameraInputs | None:
        """Images and cameras of frames; None for a model without a camera.

        Raises:
            UserError: Images or calibrations are missing or of another size.
        """
        if self.camera is None:
            return None
        return camera_inputs(frames, self.image_size, self.camera, self.features)

    def training_batches(
        self, frames: FrameSequence, train: ConfigDict, seed: int
    ) -> grain.DatasetIterator[Batch]:
        """An endless, shuffled, checkpointable iterator over batches of this process.

        Args:
            frames: To train on.
            train: `config.train`.
            seed: Of order and augmentation.

        Raises:
            UserError: As `images`, or no frame has a usable one; fewer frames than one
                batch.
        """
        images, options = self.images(frames), self.options
        require_images(frames, images)
        table = make_table(
            self.records,
            frames,
            max_objects=options.max_objects,
            classes=self.classes,
            images=images,
            label_permutation_seed=options.label_permutation_seed,
        )
        augment = make_augmentation(
            self.records.grid,
            mirror_probability=options.mirror_probability,
            gain_db=options.gain_db,
            gain_slope_db=options.gain_slope_db,
        )
        loading = LoaderOptions(
            batch_size=train.batch_size // jax.process_count(),
            seed=seed,
            num_threads=options.num_threads,
            num_workers=options.num_workers,
        )
        return make_loader(table, loading, augment=augment)


def open_data(config: ConfigDict, model: nn.Module, sources: Sources) -> Data:
    """Simulates if the config says so, projects what has no record yet, opens all.

    One process of several writes before the others read, see `processes.main_first`.

    Args:
        config: Of the run.
        model: What `config.model` describes.
        sources: What the user says of the data.

    Raises:
        UserError: No data and nothing to simulate; the embeddings are of another
            backbone; no space left.
        FileNotFoundError: A folder that was named is not there.
    """
    if sources.camera_calibration is not None:  # simulating takes long
        check_folders([sources.camera_calibration])
    simulation = config.get("simulation")
    if not sources.data and simulation is None:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as configs/quickstart.py"
        )
    if simulation is not None:
        root = _simulated_root(simulation, sources.data)
        processes.main_first(lambda: simulate_dataset(simulation, root))
        sources = dataclasses.replace(sources, data=(root,))
    data = Data.open(config, model, sources.paths())
    _log.info("%s", data.frames.summary().to_text())
    if count := len(data.split("train")):  # projecting takes long
        check_enough(count, config.train.batch_size)
    data.project()
    lost = len(data.frames) - len(data.split(None))
    if lost:
        _log.warning(
            f"{lost} of {len(data.frames)} frames were left out when they were projected; "
            f"manifest.json in {data.paths.records} says why"
        )
    return data


def data_of_run(
    loaded: LoadedModel, workdir: pathlib.Path, other: Sources | None = None
) -> tuple[ConfigDict, Data]:
    """A run's data, or others in their place, and its config with their label version.

    Nothing is projected.

    Raises:
        UserError: The run has no data and none are given; they are of another radar
            grid, or without what a frozen image backbone makes of their images.
        FileNotFoundError: A folder is not there.
    """
    config, own = loaded.config, loaded.run.get("data")
    paths = own = own and DataPaths.from_dict(own)
    if other is not None:
        paths = other.paths(own)
    if paths is None:
        raise UserError(
            f"{workdir}: trained on frames that were never written, there is no "
            "split to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    if other is not None:
        if other.label_version is not None:
            config = config.copy_and_resolve_references()
            config.data.label_version = other.label_version
        is_blind = models.has_camera(loaded.model) and (
            IMAGE_BACKBONE not in loaded.variables["params"]
        )
        if is_blind and paths.embeddings is None:
            raise UserError(
                f"{workdir} is without the weights of its image backbone: give "
                "--image_backbone FOLDER, or --embeddings FOLDER of these images"
            )
    data = Data.open(config, loaded.model, paths, grid=loaded.grid)
    if other is not None and data.frames.grid != loaded.grid:
        raise UserError(
            f"{', '.join(paths.roots)}: the radar has {describe_grid(data.frames.grid)}, "
            f"{workdir} was trained on {describe_grid(loaded.grid)}"
        )
    return config, data


def _simulated_root(simulation: ConfigDict, data: Sequence[str]) -> str:
    """Folder of a simulated data set, named by its config where none is given."""
    if not data:
        digest = hashlib.sha256(simulation.to_json().encode()).hexdigest()[:8]
        return str(pathlib.Path("data") / f"simulated-{digest}")
    if len(data) != 1:
        raise UserError(f"a simulated data set has one folder, got {list(data)}")
    return data[0]


def check_folders(paths: Sequence[str]) -> None:
    """`FileNotFoundError` for a folder that is not there."""
    for path in paths:
        if not pathlib.Path(path).is_dir():
            raise FileNotFoundError(f"no such folder: {saved_path(path)}")
