"""The data of a run: where they are, and one object that gives frames and batches."""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import json
import logging
import pathlib
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import grain
import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core.config import DATA_PATHS
from radejax.core.errors import DataError, UserError, require
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
from radejax.simulation.dataset import simulate_dataset
from radejax.training import distributed

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Data:
    """Frames, records and cameras of a run, opened once.

    Attributes:
        options: `config.data`, see `located`.
        frames: All frames, with the labels that the config asks for.
        classes: Names in the order of the class indices.
        camera: How images and calibrations are used; None for radar-only models.
        image_size: Height and width that the model takes, or None.
        features: Embedded images, or None.
        grid: Grid that the records must have; None takes any.
    """

    options: ConfigDict
    frames: LabelledFrames
    classes: tuple[str, ...]
    camera: CameraOptions | None
    image_size: tuple[int, int] | None
    features: Records | None
    grid: RadarGrid | None = None

    @classmethod
    def open(
        cls, config: ConfigDict, model: nn.Module, grid: RadarGrid | None = None
    ) -> Data:
        """Read the labels; nothing is written.

        Raises:
            UserError: Embeddings are given and another backbone made them, or the model
                has none.
            FileNotFoundError: A folder is missing.
        """
        options, camera, features = config.data, None, None
        _require_folders(*options.roots, options.camera_calibration)
        if models.has_camera(model):
            camera = CameraOptions.from_config(options)
            if options.embeddings is not None:
                check_embeddable(
                    freeze=model.freeze, mirror_probability=options.mirror_probability
                )
                features = open_embeddings(options.embeddings, config.model.image)
        elif options.embeddings is not None:
            raise UserError(
                "embeddings are given, but config.model.name is "
                f"{config.model.name!r}, which has no camera"
            )
        frames = data_set(options.format)(
            options.roots,
            options.labels,
            version=options.label_version,
            visibility=options.visibility,
            classes=config.classes,
            camera_calibration=options.camera_calibration,
            common_camera=camera is not None and camera.calibration == "common",
            include_unstarred_v11_labels=options.include_unstarred_v11_labels,
            sequence_numbers=options.sequences or None,
            weather=options.weather or None,
        )
        return cls(
            options=options,
            frames=frames,
            classes=tuple(config.classes),
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
            lambda: preprocess(self.frames, self.options.records)
        )
        if report is not None and report.skipped:
            _log.warning("%s", report.to_text())
        keys = self.records.keys()
        self._skipped.update(f.key for f in self.frames if f.key not in keys)
        if len(self._skipped) == len(self.frames):
            raise DataError(
                f"{', '.join(self.options.roots)}: none of {len(self.frames)} frames has a "
                "radar tensor that can be read"
            )
        self._splits.clear()

    @functools.cached_property
    def records(self) -> Records:
        """Projections of the frames."""
        return open_projections(self.options.records, self.grid)

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
        chosen = self.options.validation
        if name == "validation" and not chosen:
            raise UserError(
                "there is no validation split: config.data.validation holds no sequences "
                "out of the train split, such as (5, 21), or a tenth of them by (0.1,)"
            )
        if not chosen or not len(frames):
            return frames
        numbers = {frame.sequence for frame in frames}
        held = held_out(numbers, chosen, self.options.validation_seed)
        if name == "train":
            other, reason = set(held), "held out for validation"
        else:
            other, reason = numbers.difference(held), "of sequences to train on"
        keys = {frame.key for frame in frames if frame.sequence in other}
        return frames.without(keys, reason)

    @property
    def choosing_split(self) -> str:
        """By which the best checkpoint is chosen: "validation", "test" without one."""
        return "validation" if self.options.validation else "test"

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


def located(config: ConfigDict) -> ConfigDict:
    """A copy of a config whose `config.data` has absolute paths, roots and records.

    Raises:
        UserError: Neither data nor a simulation is given.
    """
    config = config.copy_and_resolve_references()
    roots = config.data.roots
    is_list = not isinstance(roots, str) and all(roots)
    require(is_list, "config.data.roots", roots, "a tuple of folders")
    if "simulation" in config:
        name, one = "config.data.roots", "one folder, as the config simulates it"
        require(len(roots) <= 1, name, tuple(roots), one)
        roots = roots or (_simulated_root(config.simulation),)
    if not roots:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as quickstart"
        )
    _set_paths(config.data, {**{n: config.data[n] for n in DATA_PATHS}, "roots": roots})
    return config


def _simulated_root(simulation: ConfigDict) -> str:
    """Folder of a simulated dataset, named by its config."""
    text = json.dumps(json.loads(simulation.to_json()), sort_keys=True)
    return f"data/simulated-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _set_paths(options: ConfigDict, paths: Mapping[str, Any]) -> None:
    """Set paths of `config.data`, made absolute, and where records are by default."""
    absolute: dict[str, Any] = {
        name: path and str(pathlib.Path(path).absolute())
        for name, path in paths.items()
        if name != "roots"
    }
    roots = tuple(str(pathlib.Path(root).absolute()) for root in paths["roots"])
    absolute["records"] = absolute["records"] or str(pathlib.Path(roots[0], "records"))
    with options.ignore_type():
        options.update(absolute, roots=roots)


def _require_folders(*paths: str | None) -> None:
    """Raise `FileNotFoundError` for a folder that is missing; None is not looked for."""
    for path in filter(None, paths):
        if not pathlib.Path(path).is_dir():
            raise FileNotFoundError(f"no such folder: {path}")


def simulate_missing(config: ConfigDict) -> None:
    """Simulate the dataset of a located config that has a `simulation` section."""
    if "simulation" in config:
        values, root = dict(config.simulation), config.data.roots[0]
        distributed.main_first(lambda: simulate_dataset(values, root))


def open_data(config: ConfigDict, model: nn.Module) -> Data:
    """Simulate if the config says so, preprocess what has no record yet, open all.

    One process of several writes before the others read, see `distributed.main_first`.

    Args:
        config: Config of the run, see `located`.
        model: What `config.model` describes.

    Raises:
        UserError: Another backbone made the embeddings, or no space is left.
        FileNotFoundError: A folder is missing.
    """
    _require_folders(config.data.camera_calibration)  # simulating takes long
    simulate_missing(config)
    data = Data.open(config, model)
    _log.info("%s", data.frames.summary().to_text())
    _check_bins(config.model, data)
    if count := len(data.split("train")):  # preprocessing takes long
        check_enough(count, config.train.batch_size)
    data.preprocess()
    if config.data.validation:
        _log_held_out(data)
        if not config.train.evaluate_every_epochs:
            _log.info(
                "config.train.evaluate_every_epochs is 0: nothing is chosen by them; "
                "evaluate.py --split validation evaluates on them afterwards"
            )
    return data


def _check_bins(model: ConfigDict, data: Data) -> None:
    """`UserError` for a model of another radar, before anything is projected."""
    doppler, elevation = data.frames.grid.num_doppler, data.frames.grid.num_elevation
    if (model.doppler_bins, model.elevation_bins) != (doppler, elevation):
        raise UserError(
            f"config.model has {model.doppler_bins} Doppler and {model.elevation_bins} "
            f"elevation bins, the radar of {', '.join(data.options.roots)} {doppler} and "
            f"{elevation}; give --config.model.doppler_bins={doppler} "
            f"--config.model.elevation_bins={elevation}"
        )


def _log_held_out(data: Data) -> None:
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
    saved: SavedModel, changes: Mapping[str, Any] | None = None
) -> tuple[ConfigDict, Data]:
    """The config of a run with changes of `config.data`, and these data.

    Other roots have labels, records, embeddings and calibrations of their own, and are
    taken whole, unless `changes` say otherwise. Nothing is preprocessed.

    Raises:
        UserError: The run has no data and none are given; they are of another radar
            grid, or without what a frozen image backbone makes of their images.
        FileNotFoundError: A folder is missing.
    """
    config = saved.config.copy_and_resolve_references()
    options, changes = config.data, dict(changes or {})
    paths = {name: options[name] for name in DATA_PATHS}
    roots = tuple(changes.get("roots") or options.roots)
    if [str(pathlib.Path(root).absolute()) for root in roots] != list(options.roots):
        paths = dict.fromkeys(DATA_PATHS)
        changes = {"sequences": (), "weather": (), **changes}
    if not roots:
        raise UserError(
            "the model was trained on frames that were never written, there is no split "
            "to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    with options.ignore_type():
        options.update({k: v for k, v in changes.items() if k not in DATA_PATHS})
    given = {k: v for k, v in changes.items() if k in DATA_PATHS}
    _set_paths(options, {**paths, **given, "roots": roots})
    has_backbone = IMAGE_BACKBONE in saved.variables["params"]
    is_blind = models.has_camera(saved.model) and not has_backbone
    if changes and is_blind and options.embeddings is None:
        raise UserError(
            "the run is without the weights of its image backbone: give "
            "--image-backbone FOLDER, or --embeddings FOLDER of these images"
        )
    data = Data.open(config, saved.model, saved.grid)
    if data.frames.grid != saved.grid:
        raise UserError(
            f"{', '.join(options.roots)}: the radar has "
            f"{describe_grid(data.frames.grid)}, the model was trained on "
            f"{describe_grid(saved.grid)}"
        )
    return config, data


def data_name(changes: Mapping[str, Any]) -> str:
    """Name of results on other data: folder, labels, sequences and weather."""
    parts = [pathlib.Path(path).resolve().name for path in changes.get("roots", ())[:1]]
    if changes.get("labels") is not None:
        parts.append(pathlib.Path(changes["labels"]).resolve().stem)
    for name in ("sequences", "weather"):
        parts.append("-".join(map(str, changes.get(name, ()))))
    return "_".join(filter(None, parts)) or "other"
