"""Checks every section of a config before a run reads or writes anything."""

from __future__ import annotations

from typing import Any

from ml_collections import ConfigDict
from ml_collections.config_flags import config_path

from radejax import models
from radejax.core.config import did_you_mean, fields_of, load_config
from radejax.core.errors import (
    BELOW_ONE,
    POSITIVE,
    UserError,
    check_options,
    integer,
    number,
    one_line,
    one_of,
    or_none,
    require,
    several,
)
from radejax.data.cameras import CameraOptions
from radejax.data.dataset import data_set
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.kradar.labels import LABEL_CLASSES, VERSIONS, VISIBILITY_FLAGS
from radejax.data.reduced import RELEASES
from radejax.detection.decode import DecodeOptions
from radejax.evaluation.evaluation_set import SPACES
from radejax.evaluation.results import EvaluationOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import LossOptions
from radejax.simulation.config import SimulationConfig, default_config

_SEED = integer(0, 2**32 - 2)  # 32 bits; the training also uses the next integer
_VERSIONS = one_of(*VERSIONS, *(version.removeprefix("v") for version in VERSIONS))
_SEQUENCES = several(integer(1), "different sequence numbers; () for all")

# Fields that no constructor checks, or only one that reads data.
_DATA = {
    "roots": (all, "folders"),
    "release": or_none(one_of(*RELEASES)),
    "label_version": _VERSIONS,
    "visibility": or_none(
        several(one_of(*VISIBILITY_FLAGS), f"different flags of {VISIBILITY_FLAGS}")
    ),
    "sequences": _SEQUENCES,
    "weather": several(one_of(*WEATHERS), f"different ones of {WEATHERS}; () for all"),
    "validation": (
        lambda value: _SEQUENCES[0](value) or (len(value) == 1 and 0 < value[0] < 1),
        "different sequence numbers, or one fraction between 0 and 1; () for none",
    ),
    "validation_seed": _SEED,
    "num_frames": integer(1),
    "max_objects": integer(1),
    "azimuth_mapping": one_of("true", "stretched"),
    "num_threads": or_none(integer(0)),
    "mirror_probability": number(0, 1),
    "label_permutation_seed": or_none(integer(0)),
}
_TRAIN = {
    "batch_size": integer(1),
    "num_epochs": integer(1),
    "max_steps": or_none(integer(1)),
    "learning_rate": POSITIVE,
    "final_learning_rate": number(0),
    "schedule": one_of("cosine", "cyclic_cosine"),
    "weight_decay": number(0),
    "warmup_steps": integer(0),
    "gradient_clip_norm": or_none(POSITIVE),
    "ema_decay": or_none(BELOW_ONE),
    "gradient_accumulation_steps": integer(1),
    "parameter_sharding": one_of("replicated", "fsdp"),
    "log_every_steps": integer(1),
    "checkpoint_every_steps": integer(1),
    "checkpoints_to_keep": or_none(integer(1)),
    "evaluate_every_epochs": integer(0),
    "max_skipped_steps": integer(0),
}
_LOGGING = {
    "num_visualizations": integer(0),
    "profile_steps": (
        lambda v: len(v) == 2 and all(map(integer(0)[0], v)) and v[0] <= v[1],
        "two integers of at least 0, the first not above the last",
    ),
}
_GRID = dict.fromkeys(("num_doppler", "num_elevation"), integer(0))
_GRID |= {"num_range": integer(2), "num_azimuth": integer(2), "max_range_m": POSITIVE}
_KINDS: dict[type, Any] = {float: int | float, tuple: tuple | list}
_OPTIONAL = ("data.visibility", "evaluation.roi", "train.checkpoints_to_keep")
# Sections that not every config has. Their constructors check the names of the fields.
_OWN_NAMES = ("model.", "loss.weights.", "data.camera", "simulation")


def check(config: ConfigDict) -> None:
    """Checks a config by constructing the objects that its sections configure.

    No data are read or written. Conditions that depend on the data, such as a warm-up that
    is shorter than the training, are checked later.

    Raises:
        UserError: A field is missing, unknown, of another type or out of its range.
    """
    _check_fields(config)
    check_options(config.data, "config.data", _DATA)
    check_options(config.train, "config.train", _TRAIN)
    check_options(config.logging, "config.logging", _LOGGING)
    data_set(config.data.format)
    names, expected = one_of(*LABEL_CLASSES), f"different classes of {LABEL_CLASSES}"
    if config.data.format != "kradar":
        names, expected = (lambda name: isinstance(name, str), ""), "different names"
    classes = several(names, expected, least=1)
    check_options(config, "config", {"seed": _SEED, "classes": classes})
    for section, construct in (
        ("model", lambda: models.build(config.model, config.data.num_frames)),
        ("loss", lambda: LossOptions(**config.loss.to_dict())),
        ("decode", lambda: DecodeOptions(**config.decode)),
        ("data.camera", lambda: CameraOptions.from_config(config.data)),
        ("evaluation", lambda: EvaluationOptions.from_config(config)),
        ("simulation", lambda: _check_simulation(config)),
    ):
        try:
            construct()
        except (TypeError, AttributeError, KeyError) as error:
            raise UserError(f"config.{section}: {one_line(error)}") from error
    _check_pairs(config)


def _check_pairs(config: ConfigDict) -> None:
    """Checks conditions between two fields."""
    name, count = "config.model.num_classes", config.model.num_classes
    classes = f"{len(config.classes)}, the number of config.classes"
    require(count == len(config.classes), name, count, classes)
    peak, final = config.train.learning_rate, config.train.final_learning_rate
    text = f"at most config.train.learning_rate, {peak}"
    require(final <= peak, "config.train.final_learning_rate", final, text)
    if config.train.evaluate_every_epochs:
        ious = config.evaluation.iou_thresholds
        known = [f"map_{space}_iou{100 * iou:.4g}" for space in SPACES for iou in ious]
        best = config.train.best_metric
        require(best in known, "config.train.best_metric", best, f"one of {known}")


def check_bins(model: ConfigDict, grid: RadarGrid, source: str) -> None:
    """Raises `UserError` if the Doppler or elevation bins of a model and a grid differ.

    Args:
        model: The section `config.model`.
        grid: Grid of the radar.
        source: Description of the radar for the error message.
    """
    for name in ("doppler", "elevation"):
        bins, expected = model[f"{name}_bins"], getattr(grid, f"num_{name}")
        text = f"{expected}, as {source} has"
        require(bins == expected, f"config.model.{name}_bins", bins, text)


def _check_simulation(config: ConfigDict) -> None:
    if "simulation" not in config:
        return
    # It may also be "kradar", or the fields of a `RadarGrid`.
    if "num_range" in config.simulation.grid:
        check_options(config.simulation.grid, "config.simulation.grid", _GRID)
    grid = SimulationConfig.from_mapping(config.simulation).make_grid()
    if not config.model.doppler_bins and grid.num_elevation:
        grid = grid.without_doppler()  # as frames of a reduced release can be read
    check_bins(config.model, grid, "config.simulation.grid")


def _check_fields(config: ConfigDict) -> None:
    """Checks the names of the fields that every config has, and the types of all fields."""
    reference = load_config("dinorade").unlock()
    reference.simulation = ConfigDict(default_config())
    found, known = dict(fields_of(config)), dict(fields_of(reference))
    for name in sorted(found.keys() ^ known.keys()):
        if not name.startswith(_OWN_NAMES):
            if name not in found:
                raise UserError(f"config.{name} is missing")
            hint = did_you_mean(name, known, "config.")
            raise UserError(f"config.{name} is not a field{hint}")
    for name, kind in known.items():
        try:
            value = config_path.get_value(name, config)
        except (KeyError, TypeError):  # a section that this config does not have
            continue
        if kind is type(None):  # any type is allowed here; the constructors check it
            continue
        is_fine = isinstance(value, _KINDS.get(kind, kind))
        is_fine = is_fine and isinstance(value, bool) == (kind is bool)
        if value is None:
            default = config_path.get_value(name, reference)
            is_fine = default is None or name in _OPTIONAL
        require(is_fine, f"config.{name}", value, f"a value of type {kind.__name__}")
