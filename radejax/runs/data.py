"""The data of a run: where they are, and one object that gives frames and batches."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any

import flax.linen as nn
import grain
import jax
import numpy as np
from ml_collections import ConfigDict

from radejax import models
from radejax.core.config import DATA_PATHS
from radejax.core.errors import UserError, require
from radejax.core.structures import Batch
from radejax.data import pipeline, records
from radejax.data.augment import Augmentation
from radejax.data.cameras import CameraOptions
from radejax.data.dataset import FrameSequence, LabelledFrames, data_set
from radejax.data.kradar.dataset import held_out
from radejax.data.records import Records
from radejax.inference.saved import SavedModel
from radejax.runs.checks import check_bins
from radejax.simulation.dataset import simulate_dataset
from radejax.training import distributed

_log = logging.getLogger(__name__)


class Data:
    """Frames, records and cameras of a run, opened once; nothing is written.

    Args:
        config: Config of the run, see `located`.
        model: What `config.model` describes.

    Attributes:
        options: `config.data`.
        frames: All frames, with the labels that the config asks for.
        classes: Names in the order of the class indices.
        camera: How images and calibrations are used; None for radar-only models.
        features: Embedded images, or None.

    Raises:
        UserError: Embeddings are given and another backbone made them, or the model
            has none.
        FileNotFoundError: A folder is missing.
    """

    def __init__(self, config: ConfigDict, model: Any) -> None:
        options = self.options = config.data
        self.classes = tuple(config.classes)
        self.camera: CameraOptions | None = None
        self.features: Records | None = None
        self._model, self._skipped = model, set[str]()
        self._splits: dict[str, LabelledFrames] = {}
        if models.has_camera(model):
            self.camera = CameraOptions.from_config(options)
        if options.embeddings is not None:
            is_frozen = self.camera is not None and model.freeze
            if not is_frozen or options.mirror_probability:
                raise UserError(
                    "embeddings are given: they need a model whose image backbone is frozen "
                    "(config.model.image.freeze=True) and, as they cannot be mirrored, "
                    "config.data.mirror_probability=0"
                )
            self.features = records.open_embeddings(
                options.embeddings, config.model.image
            )
        is_common = self.camera is not None and self.camera.calibration == "common"
        self.frames = data_set(options.format)(
            options.roots,
            options.labels,
            version=options.label_version,
            visibility=options.visibility,
            classes=config.classes,
            camera_calibration=options.camera_calibration,
            common_camera=is_common,
            include_unstarred_v11_labels=options.include_unstarred_v11_labels,
            sequence_numbers=options.sequences or None,
            weather=options.weather or None,
        )

    def preprocess(self) -> None:
        """Write the records that are missing, on one process while others wait.

        `split` then leaves out frames whose radar tensor is missing or corrupted.

        Raises:
            UserError: No frames, records of something else, or no space left.
        """
        report = distributed.main_only(
            lambda: records.preprocess(self.frames, self.options.records)
        )
        if report is not None and report.skipped:
            _log.warning("%s", report.to_text())
        keys = self.records.keys()
        self._skipped = {frame.key for frame in self.frames if frame.key not in keys}
        self._splits = {}

    @functools.cached_property
    def records(self) -> Records:
        """Projections of the frames, on their grid."""
        return records.open_projections(self.options.records, self.frames.grid)

    def split(self, name: str, *, may_be_empty: bool = False) -> LabelledFrames:
        """Frames of "train", "validation", "test", "all" or a split file.

        Without those that `preprocess` skipped, which are counted.
        Sequences that `options.validation` holds out of "train" are "validation".

        Raises:
            UserError: No such split, no frames in it unless it `may_be_empty`, or
                sequences to hold out that are not there.
        """
        if name not in self._splits:
            if name in ("train", "validation"):
                frames = self._part_of_train(name)
            else:
                frames = self.frames if name == "all" else self.frames.of_split(name)
            if any(frame.key in self._skipped for frame in frames):
                frames = frames.without(self._skipped, "no readable radar tensor")
            self._splits[name] = frames
        if not len(self._splits[name]) and not may_be_empty:
            roots = ", ".join(self.options.roots)
            raise UserError(f"no frames of the {name} split in {roots}")
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
        numbers, is_train = {frame.sequence for frame in frames}, name == "train"
        held = held_out(numbers, chosen, self.options.validation_seed)
        others = {f.key for f in frames if (f.sequence in held) == is_train}
        reason = "held out for validation" if is_train else "of sequences to train on"
        return frames.without(others, reason)

    @property
    def choosing_split(self) -> str:
        """By which the best checkpoint is chosen: "validation", "test" without one."""
        return "validation" if self.options.validation else "test"

    def images(self, frames: FrameSequence) -> pipeline.CameraInputs | None:
        """Images and cameras of frames; None for a model without a camera.

        Raises:
            UserError: Images or calibrations are missing or of another size.
        """
        if self.camera is None:
            return None
        size = tuple(self._model.image_size)
        return pipeline.camera_inputs(frames, size, self.camera, self.features)

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
        pipeline.require_images(frames, images)
        table = pipeline.make_table(
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
        augment = Augmentation(self.records.grid, options.mirror_probability)
        loader = pipeline.LoaderOptions(
            train.batch_size // jax.process_count(),
            seed,
            num_threads=options.num_threads,
        )
        return pipeline.make_loader(table, loader, augment=augment)


def located(config: ConfigDict) -> ConfigDict:
    """A copy of a config whose `config.data` has absolute paths, roots and records.

    Raises:
        UserError: Neither data nor a simulation is given.
        FileNotFoundError: A path of `config.data` does not exist, except the data that
            are simulated and the records, which are made.
    """
    config = config.copy_and_resolve_references()
    options, is_simulated = config.data, "simulation" in config
    roots = options.roots
    if is_simulated:
        name, one = "config.data.roots", "one folder, as the config simulates it"
        require(len(roots) <= 1, name, tuple(roots), one)
        roots = roots or (_simulated_root(config.simulation),)
    if not roots:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as quickstart"
        )
    _set_paths(options, roots)
    _check_exist(() if is_simulated else options.roots)
    _check_exist((options.labels, options.embeddings, options.image_backbone))
    return config


def _check_exist(paths: Iterable[str | None]) -> None:
    for path in filter(None, paths):
        if not pathlib.Path(path).exists():
            raise FileNotFoundError(f"no such file or folder: {path}")


def _simulated_root(simulation: ConfigDict) -> str:
    """Folder of a simulated dataset, named by its config."""
    text = json.dumps(json.loads(simulation.to_json()), sort_keys=True)
    return f"data/simulated-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _set_paths(options: ConfigDict, roots: Iterable[str]) -> None:
    """Make paths of `config.data` absolute; records are in the first root by default."""
    roots = tuple(str(pathlib.Path(root).absolute()) for root in roots)
    paths = {name: options[name] for name in DATA_PATHS if name != "roots"}
    paths["records"] = paths["records"] or pathlib.Path(roots[0], "records")
    absolute = {n: x and str(pathlib.Path(x).absolute()) for n, x in paths.items()}
    with options.ignore_type():  # tuples are lists in the config of a checkpoint
        options.update(absolute, roots=roots)
    _check_exist([options.camera_calibration])


def simulate_missing(config: ConfigDict) -> None:
    """Simulate the dataset of a located config that has a `simulation` section."""
    if "simulation" in config:
        values, root = dict(config.simulation), config.data.roots[0]
        distributed.main_only(lambda: simulate_dataset(values, root))


def open_data(config: ConfigDict, model: nn.Module) -> Data:
    """Simulate if the config says so, preprocess what has no record yet, open all.

    One process of several writes before the others read.

    Args:
        config: Config of the run, see `located`.
        model: What `config.model` describes.

    Raises:
        UserError: Another backbone made the embeddings, no frames to train on, or no
            space is left.
        FileNotFoundError: A folder is missing.
    """
    simulate_missing(config)
    data = Data(config, model)
    _log.info("%s", data.frames.summary().to_text())
    # Preprocessing takes long.
    check_bins(config.model, data.frames.grid, f"the radar of {data.options.roots[0]}")
    pipeline.check_enough(len(data.split("train")), config.train.batch_size)
    data.preprocess()
    if config.data.validation:
        frames = data.split("validation")
        _log.info(
            "validation: sequences %s of the train split are held out, %d frames beside "
            "%d to train on",
            ", ".join(map(str, sorted({frame.sequence for frame in frames}))),
            len(frames),
            len(data.split("train")),
        )
    return data


def data_of_run(
    saved: SavedModel, changes: Mapping[str, Any] | None = None
) -> tuple[ConfigDict, Data]:
    """The config of a run with changes of `config.data`, and these data.

    Other roots have labels, records, embeddings and calibrations of their own, and are
    taken whole, unless `changes` say otherwise. Nothing is preprocessed.

    Raises:
        UserError: The run has no data and none are given, or they are of another radar
            grid.
        FileNotFoundError: A folder is missing.
    """
    config = saved.config.copy_and_resolve_references()
    options, changes = config.data, dict(changes or {})
    own = list(options.roots)
    roots = changes.pop("roots", own)
    if not roots:
        raise UserError(
            "the model was trained on frames that were never written, there is no split "
            "to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    if [str(pathlib.Path(root).absolute()) for root in roots] != own:
        whole = {"sequences": (), "weather": (), **dict.fromkeys(DATA_PATHS)}
        changes = whole | changes
    with options.ignore_type():
        options.update(changes)
    _set_paths(options, roots)
    data = Data(config, saved.model)
    found, name = data.frames.grid, f"the radar of {options.roots[0]}"
    expected = f"{records.describe_grid(saved.grid)}, as the model was trained"
    require(found == saved.grid, name, records.describe_grid(found), expected)
    return config, data


def data_name(changes: Mapping[str, Any]) -> str:
    """Name of results on other data: folder, labels, sequences and weather."""
    parts = [pathlib.Path(path).resolve().name for path in changes.get("roots", ())[:1]]
    if changes.get("labels") is not None:
        parts.append(pathlib.Path(changes["labels"]).resolve().stem)
    for name in ("sequences", "weather"):
        parts.append("-".join(map(str, changes.get(name, ()))))
    return "_".join(filter(None, parts)) or "other"
