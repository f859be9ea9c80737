"""The config of a run: one typed object from a config file to the saved model.

A config file has a function `get_config(arg=None)` that returns a `Config`. Presets are changes
of a config, such as `config.replace(train={"batch_size": 10})`. A config contains all settings
of a run except the weights that it starts from (`--init-from`). When a run starts, missing data
paths are completed, and all of them are made absolute.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import logging
import os
import pathlib
import sys
import types
from collections.abc import Collection, Mapping
from typing import Annotated, Any

import numpy as np
import pydantic
from annotated_types import MinLen

from radejax import models
from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject, as_path
from radejax.core.options import Options, Seed, as_tuples, did_you_mean, find_function
from radejax.core.structures import CLASSES
from radejax.data.dataset import find_reader
from radejax.data.options import DATA_PATHS, DataOptions
from radejax.detection.decode import DecodeOptions
from radejax.evaluation.evaluation_set import SPACES
from radejax.evaluation.results import EvaluationOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.losses.detection import LossOptions
from radejax.models.options import RadeNetOptions, axis_centers, azimuth_axis_deg
from radejax.simulation.config import RadarOptions, SimulationOptions
from radejax.training.options import LoggingOptions, TrainOptions

_log = logging.getLogger(__name__)

CONFIGS = pathlib.Path(__file__).resolve().parent / "configs"
"""Folder of the bundled configs; in a checkout, a link to the one next to the package."""


class Config(Options):
    """The options of a run.

    The defaults are the paper's training of RADE-Net on K-Radar. Four fields differ from the
    paper: `model.widths` and `model.cbam` (those of the authors' code), `loss.assignment`
    ("center") and `decode.raw_yaw` ("nms"). `docs/deviations.md` describes them.
    `configs/radenet.py` has presets for the paper and the authors' code.
    """

    seed: Seed = 0
    """Seed of the initial parameters, the order of the data, dropout and augmentation."""
    classes: Annotated[tuple[str, ...], MinLen(1)] = CLASSES
    """Classes to detect, in the order of the class indices."""
    model: pydantic.SerializeAsAny[RadeNetOptions] = RadeNetOptions()
    """The detector."""
    loss: LossOptions = LossOptions()
    """The loss."""
    decode: DecodeOptions = DecodeOptions()
    """The conversion of the network's maps to boxes."""
    train: TrainOptions = TrainOptions()
    """The training."""
    data: DataOptions = DataOptions()
    """The frames."""
    evaluation: EvaluationOptions = EvaluationOptions()
    """Evaluations of the run."""
    logging: LoggingOptions = LoggingOptions()
    """Logs of the training."""
    simulation: SimulationOptions | None = None
    """The dataset to simulate; None for recorded data."""

    @pydantic.field_validator("model", mode="before")
    @classmethod
    def _of_named_class(cls, model: object) -> object:
        """Converts the model's options to the class of options of the named model."""
        if not isinstance(model, Mapping | RadeNetOptions):
            return model
        fields = dict(model)
        kind = models.options_class(fields.get("name", RadeNetOptions().name))
        return model if type(model) is kind else kind(**fields)

    @pydantic.model_validator(mode="after")
    def _check(self) -> Config:
        if ":" not in self.data.format:
            find_reader(self.data.format).check_options(self.data, self.classes)
        is_different = len(set(self.classes)) == len(self.classes)
        require(is_different, "config.classes", self.classes, "different classes")
        count = self.model.num_classes
        classes = f"{len(self.classes)}, the number of config.classes"
        is_equal = count == len(self.classes)
        require(is_equal, "config.model.num_classes", count, classes)
        for field in ("score_threshold", "calibration"):
            value = getattr(self.decode, field)
            is_fine = not isinstance(value, tuple) or len(value) == count
            require(is_fine, f"config.decode.{field}", value, f"{count}, one per class")
        if self.train.evaluate_every_epochs:
            ious = self.evaluation.iou_thresholds
            known = [
                f"map_{space}_iou{100 * iou:.4g}" for space in SPACES for iou in ious
            ]
            best = self.train.best_metric
            require(best in known, "config.train.best_metric", best, f"one of {known}")
        if self.simulation is not None:
            grid = self.simulation.make_grid()
            if not self.model.doppler_bins and grid.num_elevation:
                grid = grid.without_doppler()  # as frames of a reduced release
            check_bins(self.model, grid, "config.simulation.grid")
        return self

    def check_imports(self) -> None:
        """Imports all parts outside of the network that are named as "module:Object".

        Loading a model does not import them.

        Raises:
            UserError: One cannot be imported, or the reader rejects the options.
        """
        find_reader(self.data.format).check_options(self.data, self.classes)
        self.loss.find_terms()
        self.evaluation.find_protocols()
        self.evaluation.find_metrics()
        self.train.find_functions()
        for function in self.data.augmentation:
            find_function(function, "config.data.augmentation")

    def own_parts(self) -> dict[str, str]:
        """Returns the SHA-256 of the file of each part that is named as "module:Object".

        Parts that were not imported are left out, see `check_imports`.
        """
        values = (value for name, value in self.fields() if name != "data.roots")
        names = (
            x for value in values for x in (value if type(value) is tuple else [value])
        )
        found = {}
        for name in names:
            module = sys.modules.get(str(name).partition(":")[0])
            path = getattr(module, "__file__", None)
            if isinstance(name, str) and ":" in name and path is not None:
                content = pathlib.Path(path).read_bytes()
                found[name] = hashlib.sha256(content).hexdigest()
        return found

    def check_parts(self, before: Mapping[str, str], run: object) -> None:
        """Warns of parts whose files have changed since a run was started.

        Args:
            before: Result of `own_parts` at that time.
            run: Name of the run for the warning.
        """
        now = self.own_parts().items()
        if changed := [name for name, sha in now if before.get(name, sha) != sha]:
            _log.warning(
                "%s: the file of %s has changed since the training was started: results may "
                "differ",
                run,
                ", ".join(changed),
            )

    def without_data_paths(self) -> JsonObject:
        """Returns plain values for JSON with the data paths (`DATA_PATHS`) emptied."""
        empty = {**dict.fromkeys(DATA_PATHS), "roots": ()}
        return self.replace(data=empty).model_dump(mode="json")


def check_bins(model: RadeNetOptions, grid: RadarGrid, source: str) -> None:
    """Raises `UserError` if Doppler bins, elevation bins or beams of a model and a grid differ.

    Args:
        model: Options of the model.
        grid: Grid of the radar.
        source: Description of the radar for the error message.
    """
    for name in ("doppler", "elevation"):
        bins = getattr(model, f"{name}_bins")
        expected = getattr(grid, f"num_{name}")
        text = f"{expected}, as {source} has"
        require(bins == expected, f"config.model.{name}_bins", bins, text)
    if (axis := model.beam_azimuth_deg) is not None:
        azimuth_deg = np.rad2deg(grid.azimuth_rad)
        found = axis_centers(axis, grid.num_azimuth)
        expected = f"{azimuth_axis_deg(grid)}, as {source} has"
        is_equal = np.allclose(found, azimuth_deg, atol=0.01)
        require(is_equal, "config.model.beam_azimuth_deg", axis, expected)


# Config files ------------------------------------------------------------------------


def load_config(path_and_options: str) -> Config:
    """Loads the config of a file or name such as "my/config.py" or "radenet:stem".

    Args:
        path_and_options: Path or name as for `config_file`. What follows a colon is passed
            to the function `get_config` of the file.

    Raises:
        UserError: There is no such file, it has no function `get_config` that returns a
            `Config`, or an option is unknown.

    Examples:
        >>> load_config("radenet:paper").model.cbam
        'paper'
    """
    name, _, options = path_and_options.partition(":")
    path = config_file(name)
    get_config = getattr(load_module(path), "get_config", None)
    if get_config is None:
        raise UserError(f"{path} has no function get_config()")
    config: Config = get_config(options) if options else get_config()
    require(isinstance(config, Config), f"{path}: get_config()", config, "a Config")
    return config


def config_file(name: str | os.PathLike[str]) -> pathlib.Path:
    """Returns the file of a config.

    Args:
        name: Path of a `.py` file, or name of a config that is part of radejax.

    Raises:
        UserError: There is no such config; the message lists the names of radejax's.

    Examples:
        >>> config_file("quickstart").name
        'quickstart.py'
    """
    path = as_path(name)
    own = CONFIGS / f"{path.stem}.py"
    if not path.suffix and path.name == str(name) and own.is_file():
        return own
    if path.suffix == ".py" and path.is_file():
        return path
    names = sorted(file.stem for file in CONFIGS.glob("*.py"))
    raise UserError(
        f"no such config file: {name}; give a .py file, or one of {', '.join(names)}"
        f"{did_you_mean(path.stem, names)}"
    )


def config_name(filename: str) -> str:
    """Returns the name of a run from its config.

    For example, "configs/radenet.py:stem" gives "radenet-stem".
    """
    path, _, options = filename.partition(":")
    return "-".join([pathlib.Path(path).stem, *filter(None, options.split(","))])


def load_module(path: str | os.PathLike[str]) -> types.ModuleType:
    """Loads a Python file that is not in a package, such as a config file, as a module.

    In `sys.modules`, its name is its path, which no import statement finds.
    """
    name = os.path.abspath(path).replace(".", "_")  # a dot would separate packages
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None  # for Python files, both are set
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses find the module of their annotations there
    spec.loader.exec_module(module)
    return module


def parse_options(arg: str | None, *choices: Collection[str]) -> list[str | None]:
    """Splits the part after the colon of `--config file.py:option,option`.

    Args:
        arg: Options separated by commas; None or empty for none.
        *choices: Groups of options; at most one of each group may be given.

    Returns:
        One option per group; None for groups without a given option.

    Raises:
        UserError: An option is in no group, or two options are in the same group.
    """
    chosen: list[str | None] = [None] * len(choices)
    for option in filter(None, (o.strip() for o in (arg or "").split(","))):
        groups = [i for i, group in enumerate(choices) if option in group]
        if not groups:
            known = "; ".join(", ".join(sorted(group)) for group in choices)
            raise UserError(f"unknown config option {option!r}; available: {known}")
        group = groups[0]
        if chosen[group] not in (None, option):
            raise UserError(
                f"config options {chosen[group]!r} and {option!r} exclude each other"
            )
        chosen[group] = option
    return chosen


# Fields on the command line ----------------------------------------------------------


def with_texts(config: Config, texts: Mapping[str, str]) -> Config:
    """Returns a config with fields from texts such as those of a command line.

    All fields are set at once, because one may depend on another.

    Args:
        config: The config.
        texts: Texts by the dotted names of the fields, such as
            {"train.batch_size": "4"}. A text is a Python literal, a word such as "off",
            "true" or "none", or for a tuple several of these, such as "fog,rain".

    Raises:
        UserError: There is no such field, or the value is of another type.
    """
    known = dict(config.fields())
    values = {}
    for name, text in texts.items():
        if name not in known and not _takes_other_fields(config, name):
            hint = did_you_mean(name, known, "config.")
            raise UserError(f"config.{name} is not a field of this config{hint}")
        values[name] = _read_text(config, name, text)
    return config.with_fields(values)


def _takes_other_fields(config: Config, name: str) -> bool:
    """Returns whether the section of a field also takes fields that it has no value of."""
    section: object = config
    for step in name.split(".")[:-1]:
        section = getattr(section, step, None)
    return isinstance(section, RadarOptions)


def _read_text(config: Config, name: str, text: str) -> object:
    """Returns the first reading of a text that the type of a field allows."""
    *sections, field = name.split(".")
    place: Any = functools.reduce(getattr, sections, config)
    literal = _literal(text)
    info = getattr(type(place), "model_fields", {}).get(field)
    if info is None:  # a weight, or a parameter of the simulated radar
        return as_tuples(literal)
    words = filter(None, text.strip("()[] ").split(","))
    several = tuple(map(_literal, words))
    # The name has no effect: `Annotated` requires an annotation.
    kind: Any = Annotated[(info.annotation, field, *info.metadata)]
    adapter = pydantic.TypeAdapter[object](kind)
    for reading in (as_tuples(literal), several, text):
        try:
            return adapter.validate_python(reading, strict=True)
        except pydantic.ValidationError:
            continue
    # The type allows no reading. The validation of the whole config raises the error.
    return several if isinstance(getattr(place, field), tuple) else literal


def _literal(text: str) -> object:
    """Returns the Python value that a text represents, or the text itself."""
    words = {"true": True, "false": False, "none": None}
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return words.get(text.strip().lower(), text.strip())
