"""Sections that every config has, and the options that select a variant of a config.

A config file builds on `base_config` and `parse_options`, so that all configs have the
same fields. Their values are plain: no field is computed from another one later. The paths
of the data (`DATA_PATHS`) are ignored when a run compares its config with an earlier one.
"""

from __future__ import annotations

import ast
import copy
import difflib
import importlib.util
import json
import os
import pathlib
import types
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder
from ml_collections.config_flags import config_path

from radejax.core.errors import UserError, require
from radejax.core.files import as_path
from radejax.core.structures import CLASSES, NARROW_ROI

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
"""Folder of the bundled configs; in a checkout, a link to the one next to the package."""


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


def config_name(filename: str) -> str:
    """Returns the name of a run from its config.

    For example, "configs/radenet.py:stem" gives "radenet-stem".
    """
    path, _, options = filename.partition(":")
    return "-".join([pathlib.Path(path).stem, *filter(None, options.split(","))])


def load_module(path: str | os.PathLike[str]) -> types.ModuleType:
    """Loads a Python file that is not in a package, such as a config file, as a module."""
    spec = importlib.util.spec_from_file_location(pathlib.Path(path).stem, path)
    assert spec is not None  # for Python files, both are set
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def find_part(
    name: str, field: str, known: Mapping[str, Any], kind: type = object
) -> Any:
    """Returns the class, function or object that a field of a config names.

    Args:
        name: Name of a known part, or "module:Object" for another one, which is imported.
            Commands find modules in the current folder too.
        field: Name of the field for the error message.
        known: Parts by name.
        kind: Class from which the part is derived, or of which it is an instance.

    Raises:
        UserError: There is no such part, or it is of another kind.
    """
    part, (module, _, attribute) = known.get(name), str(name).partition(":")
    if part is None:
        expected = " or ".join([*map(repr, known), "module:Object"])
        require(bool(module and attribute), field, name, expected)
        try:
            part = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"{field} is {name!r}: {error}; run this in the folder of {module}, or add "
                "that folder to PYTHONPATH"
            ) from None
    is_kind = kind in getattr(part, "__mro__", type(part).__mro__)
    require(is_kind, field, name, f"the name of a {kind.__name__}")
    return part


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


def did_you_mean(name: str, known: Collection[str], prefix: str = "") -> str:
    """Returns a hint at the known name that is most similar to a wrong one, or "".

    Examples:
        >>> did_you_mean("radnet", ["radenet", "dinorade"])
        '; did you mean radenet?'
    """
    near = difflib.get_close_matches(name, known, 1)
    return f"; did you mean {prefix}{near[0]}?" if near else ""


def load_config(path_and_options: str) -> ConfigDict:
    """Loads the locked config of a file or name such as "my/config.py" or "radenet:stem".

    Raises:
        UserError: There is no such file, it has no function `get_config`, or an option is
            unknown.
    """
    name, _, options = path_and_options.partition(":")
    path = config_file(name)
    get_config = getattr(load_module(path), "get_config", None)
    if get_config is None:
        raise UserError(f"{path} has no function get_config()")
    config = get_config(options) if options else get_config()
    return config.lock()


DATA_PATHS = (
    *("roots", "labels", "records", "embeddings", "image_backbone"),
    "camera_calibration",
)
"""Fields of `config.data` that differ from machine to machine."""


def without_data_paths(config: ConfigDict) -> dict[str, Any]:
    """Returns the plain values of a config with its data paths (`DATA_PATHS`) emptied."""
    values = json.loads(config.to_json())
    empty: dict[str, Any] = {**dict.fromkeys(DATA_PATHS), "roots": []}
    return {**values, "data": {**values["data"], **empty}}


def plain(config: Any) -> Any:
    """Converts mappings to dictionaries and lists to tuples, recursively."""
    if isinstance(config, list | tuple):
        return tuple(map(plain, config))
    if isinstance(config, Mapping | ConfigDict):
        return {name: plain(value) for name, value in config.items()}
    return config


_FIELDS: dict[str, Any] = {
    # Seed of the initial parameters, the order of the data, dropout and augmentation.
    "seed": 0,
    # Classes to detect, in the order of the class indices.
    "classes": CLASSES,
    "model": {
        # Architecture: radenet, dinorade or module:Class.
        "name": "radenet",
        # Number of classes; must equal the length of `classes`.
        "num_classes": len(CLASSES),
        # Doppler bins of the radar; 0 without Doppler.
        "doppler_bins": 64,
        # Elevation bins of the radar; 0 without elevation.
        "elevation_bins": 37,
        # Channels of the encoder levels, finest first.
        "widths": (128, 256, 512),
        # Channels of the last decoder stage, neck and heads.
        "decoder_width": 128,
        # Groups of every group normalization; must divide every width.
        "num_groups": 32,
        # Attention on the skip connections: official (the released block), paper
        # (attention only), off.
        "cbam": "official",
        # Separate convolutions for Doppler and elevation channels at the input.
        "input_stem": False,
        # unet or module:Class.
        "backbone": "unet",
        # dilated, plain or module:Class.
        "neck": "dilated",
        # expanded, default or module:Class.
        "heads": "expanded",
        # Maps are padded to a multiple of this, itself a multiple of 2 to the power
        # of the number of encoder levels.
        "pad_multiple": 8,
        # Crop the padded output to the bins of the projection.
        "crop_output": True,
        # Dtype of the computation: float32 or bfloat16. Parameters are float32.
        "dtype": "float32",
        # Activations that the backward pass recomputes to save memory: none, blocks
        # (those of every block) or full.
        "remat": "none",
        # Score that an untrained model predicts, between 0 and 1.
        "heatmap_prior": 0.5,
        # Subtracted from the projection.
        "input_center": 0.0,
        # Multiplied with the projection after the subtraction; above 0.
        "input_scale": 1.0,
    },
    "loss": {
        # Standard deviation of the Gaussian heatmap targets: fixed, adaptive (depends on
        # the size of the box), anisotropic (depends on its length and width).
        "heatmap_sigma_mode": "fixed",
        # Standard deviation in the mode fixed, in bins; above 0.
        "heatmap_sigma_bins": 3.0,
        # Transform of the Wasserstein distance: sqrt, none, log1p.
        "gwd_transform": "sqrt",
        # Loss of a distance d: 1 - 1 / (tau + transform(d)); above 0.
        "gwd_tau": 1.65,
        # Normalize the yaw vector before the Wasserstein distance.
        "normalize_yaw": False,
        # Boxes of the regression losses: center (the objects' own bins) or nms
        # (predictions that match an object after NMS, with the thresholds of decode).
        "assignment": "center",
        # Other loss terms, each module:function.
        "own_terms": (),
        # Weight of every loss term, at least 0: focal, gwd, smooth_l1 and the functions
        # of `own_terms` by name.
        "weights": {"focal": 2.0, "gwd": 1.0, "smooth_l1": 1.0},
        # Divide each term by its own value, without a gradient through the divisor. The
        # value of the loss is then the sum of the weights.
        "normalize": True,
    },
    "decode": {
        # Rows of the output per frame; at least 1.
        "max_detections": 100,
        # Score threshold, from 0 to 1.
        "score_threshold": 0.3,
        # Keep scores equal to the threshold.
        "threshold_inclusive": True,
        # NMS removes a box whose IoU with a better box is at least this, from 0 to 1.
        "nms_iou": 0.3,
        # Apply NMS to each class separately.
        "per_class_nms": False,
        # Region of interest: x0, x1, y0, y1, z0, z1 in meters. Boxes whose center is
        # outside are removed before NMS. None: everywhere.
        "roi": placeholder(tuple),
        # Where the length of the regressed yaw vector scales a box: nms (in NMS only),
        # always (in the results too, as in the released evaluator), never.
        "raw_yaw": "nms",
        # Clip sizes to at least 0.01 m.
        "clip_sizes": True,
    },
    "train": {
        # Frames per step over all devices; at least 1.
        "batch_size": 10,
        # Passes over the training data; at least 1.
        "num_epochs": 10,
        # Steps after which the training ends if its epochs are longer, at least 1; the
        # learning rate decreases over the steps that are taken. None: all epochs.
        "max_steps": placeholder(int),
        # Peak learning rate of AdamW; above 0.
        "learning_rate": 1e-3,
        # Final learning rate, from 0 to the peak.
        "final_learning_rate": 1e-4,
        # Learning rate per step: cosine (decreases once, over the training) or
        # cyclic_cosine (decreases in one epoch and increases in the next, as released).
        "schedule": "cosine",
        # Weight decay on every parameter; at least 0.
        "weight_decay": 0.01,
        # Steps of a linear warm-up from 0; fewer than the steps of the training.
        "warmup_steps": 0,
        # Global norm to which the gradient is clipped, above 0; None: not clipped.
        "gradient_clip_norm": placeholder(float),
        # Decay per step of the exponential moving average of the parameters, below 1;
        # None: no average.
        "ema_decay": placeholder(float),
        # Batches per update of the parameters; at least 1.
        "gradient_accumulation_steps": 1,
        # replicated, or fsdp to shard the parameters over the devices.
        "parameter_sharding": "replicated",
        # Steps between logged metrics; at least 1.
        "log_every_steps": 20,
        # Steps between checkpoints; at least 1.
        "checkpoint_every_steps": 500,
        # Number of newest checkpoints that are kept, at least 1; None: all.
        "checkpoints_to_keep": 2,
        # Epochs between evaluations; 0: only after the training.
        "evaluate_every_epochs": 0,
        # Metric that selects the best checkpoint: a mean over classes in the first
        # protocol.
        "best_metric": "map_3d_iou30",
        # The run stops after more than this number of consecutive steps whose loss or
        # gradient is not finite.
        "max_skipped_steps": 20,
    },
    "data": {
        # kradar, or module:Class for another reader.
        "format": "kradar",
        # Folders of the dataset; empty: the dataset that `simulation` describes.
        "roots": (),
        # Folder or zip of a label revision; None: the labels in the roots.
        "labels": placeholder(str),
        # Form of the radar data that a model is for, polar3d or rpc (reduced releases);
        # None: radar tensors, or projections of them. Arrays of projections may be of any.
        "release": placeholder(str),
        # Folder of preprocessed projections; None: in the first root.
        "records": placeholder(str),
        # Folder of embedded images (`radejax embed`); None: the images themselves.
        "embeddings": placeholder(str),
        # Weights of the frozen image backbone: file or folder.
        "image_backbone": placeholder(str),
        # Folder of camera calibrations; None: those in the roots.
        "camera_calibration": placeholder(str),
        # v1.0, v1.1, v2.0 or v2.1.
        "label_version": "v2.1",
        # Visibility flags of the objects that count: R, L, L1; None: all.
        "visibility": ("R",),
        # Count label lines of v1.1 without an asterisk as objects, as released.
        "include_unstarred_v11_labels": False,
        # Only these sequences, such as (1, 58); empty: all.
        "sequences": (),
        # Only these kinds of weather, such as ("fog", "rain"); empty: all.
        "weather": (),
        # Sequences of the train split that are held out for validation, by number,
        # or a fraction of them, such as (0.1,); empty: none.
        "validation": (),
        # Seed with which a fraction is drawn; independent of `seed`.
        "validation_seed": 0,
        # Frames of a sample: the frame and those that precede it in its sequence, whose
        # channels are concatenated; at least 1.
        "num_frames": 1,
        # Number of objects to which each frame is padded; K-Radar v2.1 has at most 14.
        "max_objects": 32,
        # Mapping of azimuth bins to angles: true, or stretched for official checkpoints.
        "azimuth_mapping": "true",
        # Number of threads that read frames; None: one per CPU that the process may use;
        # 0: the main thread reads them.
        "num_threads": placeholder(int),
        # Probability of mirroring a frame left to right, from 0 to 1.
        "mirror_probability": 0.0,
        # Sanity check: shuffles the labels of the training frames with this seed.
        "label_permutation_seed": placeholder(int),
    },
    "evaluation": {
        # Region of interest: x0, x1, y0, y1, z0, z1 in meters; None: everywhere.
        "roi": NARROW_ROI,
        # Evaluation protocols, or module:Object; the first chooses the best checkpoint.
        "protocols": ("coco101", "all_point", "kradar_r40"),
        # Frames that are excluded: protocol (by the protocol's own rule), class (frames
        # without an object of the class), frame (frames without any object), none.
        "empty_frames": "protocol",
        # IoU thresholds, from 0 to below 1.
        "iou_thresholds": (0.3, 0.5),
        # Score threshold of all protocols except all_point, from 0 to 1.
        "score_threshold": 0.3,
        # Predictions below this score are not stored, from 0 to 1.
        "min_score": 0.05,
        # Number of bootstrap resamples of sequences for 95 % confidence intervals; 0: no
        # intervals.
        "bootstrap": 0,
        # Frames per call of the detector; at least 1.
        "batch_size": 8,
        # Number of figures of frames in a report; at least 0.
        "num_visualizations": 8,
    },
    "logging": {
        # Number of figures of fixed frames at every evaluation during training; at
        # least 0.
        "num_visualizations": 4,
        # Log to Weights & Biases in addition to TensorBoard.
        "wandb": False,
        # Project at Weights & Biases.
        "wandb_project": "radejax",
        # First and last step of a profiler trace (`--profile`), counted from the step at
        # which the command starts or continues.
        "profile_steps": (2, 5),
    },
}


def base_config() -> ConfigDict:
    """Returns a config of RADE-Net with all sections: the paper's training on K-Radar.

    Two fields differ from the paper, because the released weights and the reported
    parameter count differ from it too: `model.cbam` ("official", the released block) and
    `loss.assignment` ("center"). `configs/radenet.py` has presets for the paper and the
    released code.
    """
    return ConfigDict(copy.deepcopy(_FIELDS))


def override(config: ConfigDict, texts: Mapping[str, str]) -> None:
    """Sets fields of a config from texts such as those of a command line.

    Args:
        config: Config that is changed in place.
        texts: Texts by the dotted names of the fields, such as
            {"train.batch_size": "4"}. A text is a Python literal, a word such as "off",
            "true" or "none", or for a tuple several of these, such as "fog,rain".

    Raises:
        UserError: There is no such field, or the value is of another type.
    """
    for name, text in texts.items():
        known = dict(fields_of(config))
        if name not in known:
            hint = did_you_mean(name, known, "config.")
            raise UserError(f"config.{name} is not a field of this config{hint}")
        kind, value = known[name], _literal(text)
        if kind is tuple and not isinstance(value, tuple | list | None):
            words = filter(None, text.strip("()[] ").split(","))
            value = tuple(_literal(word) for word in words)
        if kind is str and not isinstance(value, str | None):
            value = text
        try:
            if isinstance(value, bool) and kind is not bool:
                raise TypeError
            config_path.set_value(name, config, value)
        except TypeError:
            expected = f"a value of type {kind.__name__}"
            raise UserError(f"config.{name} is {text!r}, expected {expected}") from None


def fields_of(config: ConfigDict, path: str = "") -> Iterator[tuple[str, type]]:
    """Yields the dotted name and the type of every field."""
    for key in config:
        if isinstance(config[key], ConfigDict):
            yield from fields_of(config[key], f"{path}{key}.")
        else:
            yield f"{path}{key}", config.get_type(key)


def _literal(text: str) -> Any:
    """Returns the Python value that a text represents, or the text itself."""
    words = {"true": True, "false": False, "none": None}
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return words.get(text.strip().lower(), text.strip())
