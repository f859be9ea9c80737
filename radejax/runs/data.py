"""The data of a run: where they are, and one object that gives frames and batches."""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import json
import logging
import pathlib
from collections.abc import Sequence

import flax.linen as nn
import grain
import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core.errors import DataError, UserError
from radejax.core.structures import Batch
from radejax.data.augment import Augmentation
from radejax.data.cameras import (
    CameraInputs,
    CameraOptions,
    camera_inputs,
    check_embeddable,
    require_images,
)
from radejax.data.dataset import FrameSequence, LabelledFrames, data_set
from radejax.data.kradar.dataset import held_out
from radejax.data.pipeline import LoaderOptions, check_enough, make_loader, make_table
from radejax.data.records import (
    Records,
    describe_grid,
    open_embeddings,
    open_projections,
    preprocess,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import SavedModel
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.runs.sources import DataPaths, Sources, check_folders
from radejax.simulation.dataset import simulate_dataset
from radejax.training import distributed

_log = logging.getLogger(__name__)


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
    features: Records | None
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
            camera = CameraOptions.from_config(config.data)
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
            common_camera=camera is not None and camera.calibration == "common",
            # Runs of before are without these fields.
            include_unstarred_v11_labels=config.data.get(
                "include_unstarred_v11_labels", False
            ),
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

    def preprocess(self) -> None:
        """Write the records that are missing, on one process while others wait.

        `split` then leaves out frames whose radar tensor is missing or corrupted.

        Raises:
            UserError: No frames, records of something else, or no space left.
            DataError: No frame could be read.
        """
        report = distributed.main_only(
            lambda: preprocess(self.frames, self.paths.records)
        )
        if report is not None and report.skipped:
            _log.warning("%s", report.to_text())
        keys = self.records.keys()
        self._skipped.update(f.key for f in self.frames if f.key not in keys)
        if len(self._skipped) == len(self.frames):
            raise DataError(
                f"{', '.join(self.paths.roots)}: none of {len(self.frames)} frames has a "
                "radar tensor that can be read"
            )
        self._splits.clear()

    @functools.cached_property
    def records(self) -> Records:
        """Projections of the frames."""
        return open_projections(self.paths.records, self.grid)

    @functools.cached_property
    def _skipped(self) -> set[str]:
        return set()

    @functools.cached_property
    def _splits(self) -> dict[str | None, LabelledFrames]:
        return {}

    def split(self, name: str | None) -> LabelledFrames:
        """Frames of "train", "validation", "test" or a split file; all for None.

        Without those that `preprocess` skipped, which are counted.
        Sequences that `options.validation` holds out of "train" are "validation".

        Raises:
            UserError: No such split, or sequences to hold out that are not there.
        """
        if name not in self._splits:
            if name in ("train", "validation"):
                frames = self._part_of_train(name)
            else:
                frames = self.frames if name is None else self.frames.of_split(name)
            if any(frame.key in self._skipped for frame in frames):
                frames = frames.without(self._skipped, "no readable radar tensor")
            self._splits[name] = frames
        return self._splits[name]

    def _part_of_train(self, name: str) -> LabelledFrames:
        """What the train split leaves to train on, or what is held out of it."""
        frames = self.frames.of_split("train")
        # Runs of before are without these two fields.
        chosen = self.options.get("validation") or ()
        if name == "validation" and not chosen:
            raise UserError(
                "there is no validation split: config.data.validation holds no sequences "
                "out of the train split, such as (5, 21), or a tenth of them by (0.1,)"
            )
        if not chosen or not len(frames):
            return frames
        numbers = {frame.sequence for frame in frames}
        held = held_out(numbers, chosen, self.options.get("validation_seed", 0))
        if name == "train":
            other, reason = set(held), "held out for validation"
        else:
            other, reason = numbers.difference(held), "of sequences to train on"
        keys = {frame.key for frame in frames if frame.sequence in other}
        return frames.without(keys, reason)

    @property
    def choosing_split(self) -> str:
        """By which the best checkpoint is chosen: "validation", "test" without one."""
        return "validation" if self.options.get("validation") else "test"

    def images(self, frames: FrameSequence) -> CameraInputs | None:
        """Images and cameras of frames; None for a model without a camera.

        Raises:
            UserError: Images or calibrations are missing or of another size.
        """
        if self.camera is None or self.image_size is None:
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
        )
        if (shuffled := options.label_permutation_seed) is not None:
            order = np.random.default_rng(shuffled).permutation(len(table))
            boxes, classes = table.boxes[order], table.classes[order]
            table = dataclasses.replace(table, boxes=boxes, classes=classes)
        augment = Augmentation(
            self.records.grid,
            options.mirror_probability,
            options.gain_db,
            options.gain_slope_db,
        )
        loader = LoaderOptions(
            train.batch_size // jax.process_count(),
            seed,
            num_threads=options.num_threads,
        )
        return make_loader(table, loader, augment=augment)


def open_data(config: ConfigDict, model: nn.Module, sources: Sources) -> Data:
    """Simulate if the config says so, preprocess what has no record yet, open all.

    One process of several writes before the others read, see `distributed.main_first`.

    Args:
        config: Of the run.
        model: What `config.model` describes.
        sources: What the user says of the data.

    Raises:
        UserError: No data and nothing to simulate; the embeddings are of another
            backbone; no space left.
        FileNotFoundError: A folder that was named is not there.
    """
    check_folders(filter(None, [sources.camera_calibration]))  # simulating takes long
    roots = existing_roots(config.get("simulation"), sources.data)
    data = Data.open(config, model, dataclasses.replace(sources, data=roots).paths())
    _log.info("%s", data.frames.summary().to_text())
    _check_bins(config.model, data)
    if count := len(data.split("train")):  # preprocessing takes long
        check_enough(count, config.train.batch_size)
    data.preprocess()
    if config.data.get("validation"):
        _tell_what_is_held_out(data)
        if not config.train.evaluate_every_epochs:
            _log.info(
                "config.train.evaluate_every_epochs is 0: nothing is chosen by them; "
                "evaluate.py --split validation looks at them afterwards"
            )
    return data


def _check_bins(model: ConfigDict, data: Data) -> None:
    """`UserError` for a model of another radar, before anything is projected."""
    doppler, elevation = data.frames.grid.num_doppler, data.frames.grid.num_elevation
    if (model.doppler_bins, model.elevation_bins) != (doppler, elevation):
        raise UserError(
            f"config.model has {model.doppler_bins} Doppler and {model.elevation_bins} "
            f"elevation bins, the radar of {', '.join(data.paths.roots)} {doppler} and "
            f"{elevation}; give --config.model.doppler_bins={doppler} "
            f"--config.model.elevation_bins={elevation}"
        )


def _tell_what_is_held_out(data: Data) -> None:
    """The sequences and their objects, with a warning for a class that they lack."""
    frames, num_left = data.split("validation"), len(data.split("train"))
    found = collections.Counter(cls for frame in frames for cls in frame.classes)
    counts = {cls: found[cls] for cls in data.classes}
    _log.info(
        "validation: sequences %s of the train split are held out, %d frames beside %d "
        "to train on; %s",
        ", ".join(map(str, sorted({frame.sequence for frame in frames}))),
        len(frames),
        num_left,
        ", ".join(f"{cls} {number}" for cls, number in counts.items()),
    )
    if absent := [cls for cls, number in counts.items() if not number]:
        _log.warning(
            "no %s in the validation split: it does not help to choose a checkpoint",
            " and no ".join(absent),
        )


def data_of_run(
    loaded: SavedModel, workdir: pathlib.Path, other: Sources | None = None
) -> tuple[ConfigDict, Data]:
    """A run's data, or others in their place, and its config with their label version.

    Nothing is projected.

    Raises:
        UserError: The run has no data and none are given; they are of another radar
            grid, or without what a frozen image backbone makes of their images.
        FileNotFoundError: A folder is not there.
    """
    config, own = loaded.config, loaded.run.get("data")
    own = own and DataPaths.from_dict(own)
    paths = own if other is None else other.paths(own)
    if paths is None:
        raise UserError(
            f"{workdir}: trained on frames that were never written, there is no "
            "split to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    if other is not None:
        config = config.copy_and_resolve_references()
        if other.label_version is not None:
            config.data.label_version = other.label_version
        is_own = own is not None and paths.roots == own.roots
        for name in ("sequences", "weather"):
            if (part := getattr(other, name)) or not is_own:
                config.data[name] = tuple(part)
        is_blind = models.has_camera(loaded.model) and (
            IMAGE_BACKBONE not in loaded.variables["params"]
        )
        if is_blind and paths.embeddings is None:
            raise UserError(
                f"{workdir} is without the weights of its image backbone: give "
                "--image-backbone FOLDER, or --embeddings FOLDER of these images"
            )
    data = Data.open(config, loaded.model, paths, grid=loaded.grid)
    if other is not None and data.frames.grid != loaded.grid:
        raise UserError(
            f"{', '.join(paths.roots)}: the radar has {describe_grid(data.frames.grid)}, "
            f"{workdir} was trained on {describe_grid(loaded.grid)}"
        )
    return config, data


def existing_roots(
    simulation: ConfigDict | None, roots: Sequence[str]
) -> Sequence[str]:
    """Folders of the data, those of a config that simulates them made if missing.

    Args:
        simulation: `config.simulation`; None for real data.
        roots: What the user says.

    Raises:
        UserError: Neither is there.
    """
    if simulation is not None:
        root = _simulated_root(simulation, roots)
        values = dict(simulation)
        distributed.main_first(lambda: simulate_dataset(values, root))
        return (root,)
    if not roots:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as quickstart"
        )
    return roots


def _simulated_root(simulation: ConfigDict, data: Sequence[str]) -> str:
    """Folder of a simulated data set, named by its config where none is given."""
    if not data:
        text = json.dumps(json.loads(simulation.to_json()), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:8]
        return str(pathlib.Path("data") / f"simulated-{digest}")
    if len(data) != 1:
        raise UserError(f"a simulated data set has one folder, got {list(data)}")
    return data[0]
