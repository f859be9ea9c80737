"""Paths of a run's data, and the class `Data` that provides its frames and batches."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import logging
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np

from radejax.config import Config, check_bins
from radejax.core import devices
from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject, as_path
from radejax.core.grain_import import grain
from radejax.core.options import find_function
from radejax.core.structures import Batch
from radejax.data import cameras, pipeline, records
from radejax.data.augment import Augmentation
from radejax.data.dataset import (
    FrameSequence,
    LabeledFrame,
    LabeledFrames,
    find_reader,
    held_out,
)
from radejax.data.kradar.reduced import check_release
from radejax.data.options import DATA_PATHS, CameraOptions
from radejax.data.projection import decode
from radejax.data.records import Records
from radejax.inference.saved import SavedModel
from radejax.models.options import DinoRadeOptions, RadeNetOptions
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.training.step import make_schedule

Frames = LabeledFrames[LabeledFrame]

_log = logging.getLogger(__name__)

_INPUT_FRAMES = 20
_KRADAR_INPUT = 0.63  # mean of projections with the noise of a map of K-Radar
_MAX_INPUT = 3.0  # of the mean that the network sees; usual ones are near 0


class Data:
    """Frames, records and cameras of a run.

    Creating the object writes nothing; only `preprocess` does.

    Args:
        config: Config of the run with absolute paths, see `located`.

    Attributes:
        options: The section `config.data`.
        frames: All frames, with the labels that the config selects.
        classes: Class names in the order of the class indices.
        camera: Options that define how images and calibrations are used; None for
            radar-only models.
        features: Embedded images, or None.
        license: License of the data.

    Raises:
        UserError: Embeddings are given, but another backbone computed them, the model
            has no frozen image backbone, or frames are mirrored.
        FileNotFoundError: A folder is missing.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        options = self.options = config.data
        assert options.records is not None  # `located` fills it in
        self._records_folder = options.records
        self.classes = config.classes
        self.camera: CameraOptions | None = None
        self.features: Records | None = None
        self._skipped = set[str]()
        self._splits: dict[str, Frames] = {}
        image = None
        if isinstance(config.model, DinoRadeOptions):
            self.camera = options.used_camera
            image = config.model.image
            self._image_size = image.size
        if options.embeddings is not None:
            if image is None or not image.freeze or options.mirror_probability:
                raise UserError(
                    "embeddings are given: they need a model whose image backbone is frozen "
                    "(config.model.image.freeze=True) and, as they cannot be mirrored, "
                    "config.data.mirror_probability=0"
                )
            self.features = records.open_embeddings(options.embeddings, image.to_dict())
        frames = find_reader(options.format).from_options(options, self.classes)
        self.frames = frames.with_valid_boxes(self.classes)
        simulation = config.simulation
        is_own = simulation is not None and simulation.scenes == "procedural"
        is_own = is_own and self.frames.is_simulated
        self.license = "Apache-2.0, that of radejax" if is_own else frames.license
        name = f"radar data in {', '.join(options.roots)}"
        check_release(self.frames.release, options.release, name)
        if self.frames.release is not None and not config.model.doppler_bins:
            self.frames.grid = self.frames.grid.without_doppler()

    def describe(self) -> JsonObject:
        """Returns names, kind and license of the data, without paths of this machine."""
        return {
            "name": ", ".join(as_path(root).name for root in self.options.roots),
            "format": self.options.format,
            "simulated": self.frames.is_simulated,
            "license": self.license,
        }

    def preprocess(self) -> None:
        """Writes the missing records on the main process while the others wait.

        `split` then leaves out frames whose radar tensor is missing or corrupted.

        Raises:
            UserError: There are no frames, the folder contains records of another kind,
                or no space is left on the disk.
        """
        report = devices.main_only(
            lambda: records.preprocess(self._chosen(self.frames), self._records_folder)
        )
        if report is not None and report.skipped:
            _log.warning("%s", report.to_text())
        keys = self.records.keys()
        self._skipped = {frame.key for frame in self.frames if frame.key not in keys}
        self._splits = {}

    @functools.cached_property
    def records(self) -> Records:
        """Projections of the frames, on their grid."""
        return records.open_projections(self._records_folder, self.frames.grid)

    def split(self, name: str, *, may_be_empty: bool = False) -> Frames:
        """Returns the frames of a split.

        Frames that `preprocess` skipped are left out and counted. The sequences that
        `options.validation` holds out of "train" form the split "validation".

        Args:
            name: "train", "validation", "test", "all" or the path of a split file.
            may_be_empty: Return a split without frames instead of raising an error.

        Raises:
            UserError: There is no such split, it has no frames, or the sequences to hold
                out do not exist or leave none to train on.
        """
        if name not in self._splits:
            if name in ("train", "validation"):
                frames = self._part_of_train(name)
            else:
                frames = self.frames if name == "all" else self.frames.of_split(name)
            # Splits of other readers may depend on which sequences there are, so that the
            # chosen frames are selected afterwards.
            frames = self._chosen(frames)
            if any(frame.key in self._skipped for frame in frames):
                frames = frames.without(self._skipped, "no readable radar tensor")
            self._splits[name] = frames
        if not len(self._splits[name]) and not may_be_empty:
            roots = ", ".join(self.options.roots)
            raise UserError(f"no frames of the {name} split in {roots}")
        return self._splits[name]

    def _chosen(self, frames: Frames) -> Frames:
        """Returns the frames of the chosen sequences and weathers."""
        return frames.part(self.options.sequences, self.options.weather)

    def _part_of_train(self, name: str) -> Frames:
        """Returns the part of the train split that is trained on, or is held out.

        Args:
            name: "train" or "validation".
        """
        frames = self.frames.of_split("train")
        chosen = self.options.validation
        if name == "validation" and not chosen:
            raise UserError(
                "there is no validation split: config.data.validation holds no sequences "
                "out of the train split, such as (5, 21), or a tenth of them by (0.1,)"
            )
        if not chosen or not len(frames):
            return frames
        is_train = name == "train"
        numbers = {frame.sequence for frame in frames}
        held = held_out(numbers, chosen, self.options.validation_seed)
        others = {f.key for f in frames if (f.sequence in held) == is_train}
        reason = "held out for validation" if is_train else "of sequences to train on"
        return frames.without(others, reason)

    @property
    def choosing_split(self) -> str:
        """Split on which the best checkpoint is chosen.

        It is "validation" if sequences are held out of the train split, else "test".
        """
        return "validation" if self.options.validation else "test"

    @functools.cached_property
    def usual_input(self) -> tuple[float, float]:
        """`input_of` the frames to train on."""
        return self.input_of("train")

    def input_of(self, split: str) -> tuple[float, float]:
        """Returns mean and standard deviation of the records of some frames of a split."""
        frames = list(self.split(split))
        some = frames[:: -(-len(frames) // _INPUT_FRAMES)]
        values = np.stack([decode(self.records[frame.key]) for frame in some])
        return float(values.mean()), float(values.std())

    def images(self, frames: FrameSequence) -> cameras.CameraInputs | None:
        """Returns the images and cameras of frames, or None for a radar-only model.

        Raises:
            UserError: Images or calibrations are missing or of another size.
        """
        if self.camera is None:
            return None
        size = self._image_size
        return cameras.camera_inputs(frames, size, self.camera, self.features)

    def training_batches(self) -> grain.DatasetIterator[Batch]:
        """Returns an endless, shuffled, checkpointable iterator over this process's batches.

        The batches are those of the train split.

        Raises:
            UserError: Images or calibrations are missing or of another size, no frame has
                a usable image, or there are fewer frames than one batch needs.
        """
        options = self.options
        frames = self.split("train")
        images = self.images(frames)
        cameras.require_images(frames, images)
        table = pipeline.make_table(
            self.records,
            frames,
            max_objects=options.max_objects,
            classes=self.classes,
            images=images,
            num_frames=options.num_frames,
            targets=options.targets,
        )
        count = options.num_frames
        is_useful = count == 1 or any(len(set(keys)) > 1 for keys in table.keys)
        expected = "1, as no frame to train on has the preceding one of its sequence"
        require(is_useful, "config.data.num_frames", count, expected)
        if (shuffled := options.label_permutation_seed) is not None:
            order = np.random.default_rng(shuffled).permutation(len(table))
            table = dataclasses.replace(
                table,
                boxes=table.boxes[order],
                classes=table.classes[order],
                targets={name: x[order] for name, x in table.targets.items()},
            )
        name = "config.data.augmentation"
        augment = Augmentation(
            self.records.grid,
            options.mirror_probability,
            options.random_gain_db,
            [find_function(place, name) for place in options.augmentation],
        )
        loader = pipeline.LoaderOptions(
            self._config.train.batch_size // jax.process_count(),
            self._config.seed,
            num_threads=options.num_threads,
        )
        return pipeline.make_loader(table, loader, augment=augment)


def located(config: Config) -> Config:
    """Returns a copy of a config with absolute paths in `config.data`.

    By default, the roots are the folder of the simulated dataset, and the records are
    below the first root.

    Raises:
        UserError: Neither data nor a simulation is given, or a simulation has several
            roots.
        FileNotFoundError: A path of `config.data` does not exist. The records and
            simulated data may be missing, because a run creates them.
    """
    options = config.data
    roots = options.roots
    if config.simulation is not None:
        one = "one folder, as the config simulates it"
        require(len(roots) <= 1, "config.data.roots", roots, one)
        roots = roots or (_simulated_root(config.simulation),)
    else:
        _check_exist(roots)
    if not roots:
        raise UserError(
            "no data: give --data ROOT[,ROOT...] with K-Radar's sequence folders, or a "
            "config that simulates them, such as quickstart"
        )
    _check_exist((options.labels, options.embeddings, options.image_backbone))
    return _with_paths(config, roots)


def _check_exist(paths: Iterable[str | None]) -> None:
    for path in filter(None, paths):
        if not as_path(path).exists():
            raise FileNotFoundError(f"no such file or folder: {path}")


def _simulated_root(simulation: SimulationOptions) -> str:
    """Returns the folder of a simulated dataset, whose name contains a hash of its config."""
    digest = hashlib.sha256(simulation.to_json().encode()).hexdigest()
    return f"data/simulated-{digest[:8]}"


def _with_paths(config: Config, roots: Iterable[str]) -> Config:
    """Returns a config with absolute data paths; records are in the first root by default.

    Those without Doppler have a folder of their own.
    """
    _check_exist([config.data.camera_calibration])
    folder = "records" if config.model.doppler_bins else "records_without_doppler"
    roots = tuple(str(as_path(root).absolute()) for root in roots)
    paths = {n: getattr(config.data, n) for n in DATA_PATHS if n != "roots"}
    paths["records"] = paths["records"] or as_path(roots[0]) / folder
    absolute = {n: x and str(as_path(x).absolute()) for n, x in paths.items()}
    return config.replace(data=absolute | {"roots": roots})


def simulate_missing(config: Config) -> None:
    """Simulates the dataset of a config if it has a `simulation` section.

    Args:
        config: Config of the run with absolute paths, see `located`.
    """
    simulation = config.simulation
    if simulation is not None:
        root = config.data.roots[0]
        devices.main_only(lambda: simulate_dataset(simulation, root))


def open_data(config: Config) -> Data:
    """Simulates the data if the config requires it, writes missing records, and opens all.

    With several processes, the main process writes the files before the others read them.

    Args:
        config: Config of the run with absolute paths, see `located`.

    Raises:
        UserError: Another backbone computed the embeddings, the radar does not fit the
            model, there are too few frames to train on, the warm-up is too long, frames of
            this radar cannot be mirrored, or no space is left on the disk.
        FileNotFoundError: A folder is missing.
    """
    simulate_missing(config)
    data = Data(config)
    _log.info("%s", data.frames.summary().to_text())
    splits = [data.frames.of_split(name) for name in ("train", "test")]
    used = {frame.key for split in splits for frame in split}
    problems = [x for split in splits for x in split.summary().problems]
    if lost := [text for kind, text in problems if kind == "label file missing"]:
        _log.warning("frames of the splits without labels: %d: %s", len(lost), lost[0])
    absent = "split entries of sequences that are not here"
    if count := sum(split.counts[absent] for split in splits):
        _log.info("%s: %d", absent, count)
    if unused := [frame.key for frame in data.split("all") if frame.key not in used]:
        _log.warning(
            "%d frames are not used, as they are in neither the train nor the test split; "
            "the first is %s",
            len(unused),
            unused[0],
        )
    # Preprocessing can take hours, so the data are checked before it.
    check_bins(config.model, data.frames.grid, f"the radar of {data.options.roots[0]}")
    frames = data.split("train")
    pipeline.check_enough(len(frames), config.train.batch_size)
    if not any(len(frame.boxes) for frame in frames):
        raise UserError(
            f"the {len(frames)} frames of the train split have no object of the classes "
            f"{', '.join(config.classes)}, with visibility {config.data.visibility} and "
            "in the field of view: nothing can be learned from them"
        )
    make_schedule(config.train, len(frames) // config.train.batch_size)
    Augmentation(data.frames.grid, config.data.mirror_probability)
    data.preprocess()
    _log_input(data, config.model)
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


def _log_input(data: Data, model: RadeNetOptions) -> None:
    """Logs mean and standard deviation of the input; warns if they hinder the training."""
    mean, spread = data.usual_input
    _log.info("input: %.3f ± %.3f in the frames to train on", mean, spread)
    seen = model.input_scale * (mean - model.input_center)
    varied = model.input_scale * spread
    problem = ""
    if abs(seen) > _MAX_INPUT:
        problem = "far from 0"
    elif varied < 0.05 and abs(seen - _KRADAR_INPUT) > 0.1:
        problem = f"nearly constant and not that of K-Radar ({_KRADAR_INPUT})"
    if problem:
        _log.warning(
            "the network sees an input of %.3g ± %.2g, %s: set "
            "--config.model.input_center=%.3f --config.model.input_scale=%.3g",
            seen,
            varied,
            problem,
            mean,
            0.5 / max(spread, 1e-6),
        )


def data_of_run(
    saved: SavedModel, changes: Mapping[str, Any] | None = None
) -> tuple[Config, Data]:
    """Returns the config of a run with changes of `config.data`, and the data it describes.

    If `changes` replace the roots, the labels, records, embeddings, calibrations and the
    image backbone of the run are not used, and all sequences and weather conditions are
    selected, unless `changes` contain these fields too. Nothing is preprocessed.

    Args:
        saved: Model of the run.
        changes: Fields of `config.data` to replace.

    Raises:
        UserError: The run has no data and none are given, or the Doppler or elevation bins
            of the data are not those of the model. Another range or azimuth axis is warned of.
        FileNotFoundError: A folder is missing.
    """
    own = saved.config.data.roots
    changes = dict(changes or {})
    roots = changes.pop("roots", own)
    if not roots:
        raise UserError(
            "the model was trained on frames that were never written, there is no split "
            "to evaluate on; give --data ROOT, or use `radejax detect`"
        )
    if tuple(str(as_path(root).absolute()) for root in roots) != own:
        paths = dict.fromkeys(name for name in DATA_PATHS if name != "roots")
        changes = {"sequences": (), "weather": (), **paths} | changes
    config = _with_paths(saved.config.replace(data=changes), roots)
    data = Data(config)
    found = data.frames.grid
    name = f"the radar of {config.data.roots[0]}"
    check_bins(config.model, found, name)
    if found != saved.grid:
        _log.warning(
            "%s has %s, while the model was trained with %s: the numbers are those of a "
            "model on another radar",
            name,
            records.describe_grid(found),
            records.describe_grid(saved.grid),
        )
    return config, data


def data_name(changes: Mapping[str, Any]) -> str:
    """Returns a name for results on other data from the changed fields of `config.data`.

    It consists of the names of the first root and the labels, the sequences and the
    weather, or is "other" if none of them is changed.
    """
    parts = [as_path(path).resolve().name for path in changes.get("roots", ())[:1]]
    if changes.get("labels") is not None:
        parts.append(as_path(changes["labels"]).resolve().stem)
    for name in ("sequences", "weather"):
        parts.append("-".join(map(str, changes.get(name, ()))))
    return "_".join(filter(None, parts)) or "other"
