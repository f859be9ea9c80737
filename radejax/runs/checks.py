"""Checks every section of a config before a run reads or writes anything."""

from __future__ import annotations

import difflib
from typing import Any

from ml_collections import ConfigDict
from ml_collections.config_flags import config_path

from radejax import models
from radejax.core.config import fields_of, load_config
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
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.kradar.labels import LABEL_CLASSES, VERSIONS, VISIBILITY_FLAGS
from radejax.detection.decode import DecodeOptions
from radejax.evaluation.results import EvaluationOptions
from radejax.losses.detection import LossOptions
from radejax.simulation.config import SimulationConfig, default_config
from radejax.training.step import check_train_section

_SEED = integer(0, 2**32 - 2)  # of 32 bits; a training uses the next one too
_VERSIONS = one_of(*VERSIONS, *(version.removeprefix("v") for version in VERSIONS))
_SEQUENCES = several(integer(1), "different sequence numbers; () for all")

_RUN = {
    "seed": _SEED,
    "classes": several(one_of(*LABEL_CLASSES), f"different classes of {LABEL_CLASSES}"),
}
_DATA = {
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
    "max_objects": integer(1),
    "azimuth_mapping": one_of("true", "stretched"),
    "num_threads": integer(0),
    "mirror_probability": number(0, 1),
    "gain_db": number(0),
    "gain_slope_db": number(0),
    "label_permutation_seed": or_none(integer(0)),
}
_MODEL = {
    "widths": (
        lambda value: len(value) > 0 and all(map(integer(1)[0], value)),
        "one or more integers of at least 1",
    ),
    "decoder_width": integer(1),
}
_FUSION = {"dropout": BELOW_ONE}
_AXIS = several(number(-1e6), "two finite numbers", count=2)
_QUERY_GRID = dict.fromkeys(("range_m", "azimuth_deg", "elevation_deg"), _AXIS)
_GRID = {f"num_{axis}": integer(1) for axis in ("doppler", "range", "elevation")}
_GRID |= {"num_azimuth": integer(1), "max_range_m": POSITIVE}
_EVALUATION = {
    "roi": (
        lambda v: (
            v is None or (len(v) == 6 and v[0] < v[1] and v[2] < v[3] and v[4] < v[5])
        ),
        "x0, x1, y0, y1, z0, z1 with x0 < x1, y0 < y1, z0 < z1, or None",
    ),
    "min_score": number(0, 1),
}
_LOGGING = {
    "num_visualizations": integer(0),
    "profile_steps": (
        lambda v: len(v) == 2 and all(map(integer(0)[0], v)) and v[0] <= v[1],
        "two integers of at least 0, the first not above the last",
    ),
}
_KINDS: dict[type, Any] = {float: int | float, tuple: tuple | list}
_OPTIONAL = ["data.visibility", "evaluation.roi", "train.checkpoints_to_keep"]
_OPTIONAL += ["model.cbam"]
# Sections of some configs, whose names are checked by what they construct.
_OWN_NAMES = ("model.", "loss.weights.", "data.camera", "simulation")


def check(config: ConfigDict) -> None:
    """Constructs what each section configures; nothing is read or written.

    What needs data is checked later: whether a warm-up is shorter than the training,
    for example.

    Raises:
        UserError: A field is missing, unknown, of another type or out of its range.
    """
    _check_fields(config)
    check_options(dict(config), "config", _RUN)
    require(len(config.classes) > 0, "config.classes", config.classes, "one or more")
    check_options(config.evaluation, "config.evaluation", _EVALUATION)
    _construct("config.evaluation", EvaluationOptions.from_config, config)
    check_options(config.model, "config.model", _MODEL)
    if "fusion" in config.model:
        check_options(config.model.fusion, "config.model.fusion", _FUSION)
        query_grid = config.model.query_grid
        check_options(query_grid, "config.model.query_grid", _QUERY_GRID)
    _construct("config.model", models.build, config.model)
    for name, constructor in (
        ("loss", LossOptions),
        ("decode", DecodeOptions),
    ):
        options = config[name].to_dict()
        _construct(f"config.{name}", lambda x, c=constructor: c(**x), options)
    check_train_section(config.train)
    check_options(config.logging, "config.logging", _LOGGING)
    check_options(config.data, "config.data", _DATA)
    _construct("config.data.camera", CameraOptions.from_config, config.data)
    _check_together(config)


def check_best_metric(name: str, iou_thresholds: Any) -> None:
    """Raises `UserError` for a metric that evaluations during training do not compute."""
    spaces = ("bev", "3d")
    known = [f"map_{s}_iou{100 * iou:.4g}" for s in spaces for iou in iou_thresholds]
    require(name in known, "config.train.best_metric", name, f"one of {known}")


def _check_fields(config: ConfigDict) -> None:
    """Names of the fields that every config has, and types of all."""
    reference = load_config("dinorade").unlock()
    reference.simulation = ConfigDict(default_config())
    found, known = dict(fields_of(config)), dict(fields_of(reference))
    for name in sorted(found.keys() ^ known.keys()):
        if not name.startswith(_OWN_NAMES):
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean config.{near[0]}?" if name in found and near else ""
            problem = "is not a field" if name in found else "is missing"
            raise UserError(f"config.{name} {problem}{hint}")
    for name, kind in known.items():
        try:
            value = config_path.get_value(name, config)
        except (KeyError, TypeError):  # a section that this config does not have
            continue
        if kind is type(None):  # any value; checked by what is constructed
            continue
        default = config_path.get_value(name, reference)
        is_kind = isinstance(value, _KINDS.get(kind, kind))
        is_fine = is_kind and isinstance(value, bool) == (kind is bool)
        if value is None:
            is_fine = default is None or name in _OPTIONAL
        require(is_fine, f"config.{name}", value, f"a value of type {kind.__name__}")


def _construct(name: str, constructor: Any, options: Any) -> Any:
    try:
        return constructor(options)
    except (TypeError, AttributeError, KeyError) as error:
        raise UserError(f"{name}: {one_line(error)}") from error


def _check_together(config: ConfigDict) -> None:
    """Checks what one section requires of another."""
    model, count = config.model, len(config.classes)
    name = "config.model.num_classes"
    require(model.num_classes == count, name, model.num_classes, f"{count} classes")
    if config.train.evaluate_every_epochs:
        check_best_metric(config.train.best_metric, config.evaluation.iou_thresholds)
    if "simulation" in config:
        if isinstance(config.simulation.grid, ConfigDict):
            check_options(config.simulation.grid, "config.simulation.grid", _GRID)
        simulation = _construct(
            "config.simulation", SimulationConfig.from_mapping, config.simulation
        )
        grid = simulation.make_grid()
        for name in ("doppler", "elevation"):
            bins, expected = model[f"{name}_bins"], getattr(grid, f"num_{name}")
            text = f"{expected}, as config.simulation.grid has"
            require(bins == expected, f"config.model.{name}_bins", bins, text)
