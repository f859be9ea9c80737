"""The sections that every config has, and the options that choose a variant.

A config file builds on `base_config` and `parse_options`, so that all configs have the
same fields. Values are plain and resolved: nothing is computed later. The paths of the
data (`DATA_PATHS`) are ignored when a run compares its config.
"""

from __future__ import annotations

import ast
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

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, NARROW_ROI

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
"""Those that come along: in a checkout a link to the folder beside the package."""


def parse_options(arg: str | None, *choices: Collection[str]) -> list[str | None]:
    """Splits the part after the colon of `--config file.py:option,option`.

    Args:
        arg: Options separated by commas; None or empty for none.
        *choices: Groups of options; at most one of each group may be given.

    Returns:
        One option per group, None where none was given.

    Raises:
        UserError: An option is in no group, or two are of the same group.
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
    """Name of a run from its config: "configs/radenet.py:stem" gives "radenet-stem"."""
    path, _, options = filename.partition(":")
    return "-".join([pathlib.Path(path).stem, *filter(None, options.split(","))])


def load_module(path: str | os.PathLike[str]) -> types.ModuleType:
    """The module of a Python file that is in no package, such as a config file."""
    spec = importlib.util.spec_from_file_location(pathlib.Path(path).stem, path)
    assert spec is not None  # a file has both
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def config_file(name: str | os.PathLike[str]) -> pathlib.Path:
    """File of a config: a path, or the name of one that comes with radejax.

    Raises:
        UserError: There is none; says which names there are.

    Examples:
        >>> config_file("quickstart").name
        'quickstart.py'
    """
    path = pathlib.Path(name)
    own = CONFIGS / f"{path.stem}.py"
    if not path.suffix and path.name == str(name) and own.is_file():
        return own
    if path.suffix == ".py" and path.is_file():
        return path
    names = sorted(file.stem for file in CONFIGS.glob("*.py"))
    near = difflib.get_close_matches(path.stem, names, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise UserError(
        f"no such config file: {name}; give a .py file, or one of {', '.join(names)}{hint}"
    )


def load_config(path_and_options: str) -> ConfigDict:
    """The config of a file or name such as "my/config.py" or "radenet:stem".

    Raises:
        UserError: There is no such file, it makes no config, or an option is unknown.
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
    """Plain values of a config whose data paths are empty."""
    values = json.loads(config.to_json())
    empty: dict[str, Any] = {**dict.fromkeys(DATA_PATHS), "roots": []}
    return {**values, "data": {**values["data"], **empty}}


def base_config() -> ConfigDict:
    """A config of RADE-Net with all sections: the paper's training on K-Radar.

    Two fields are not the paper's, because the released weights and the reported
    parameter count are not either: `model.cbam` ("official", the released block) and
    `loss.assignment` ("center"). `configs/radenet.py` has presets for the paper and the
    released code.
    """
    config = ConfigDict()
    config.seed = 0
    config.classes = CLASSES
    config.model = _model()
    config.loss = _loss()
    config.decode = _decode()
    config.train = _train()
    config.data = _data()
    config.evaluation = _evaluation()
    config.logging = _logging()
    return config


def override(config: ConfigDict, texts: Mapping[str, str]) -> None:
    """Sets fields of a config from texts such as those of a command line.

    Args:
        config: Changed in place.
        texts: By dotted name, such as {"train.batch_size": "4"}: Python literals, words
            such as "off", "true" and "none", or several for a tuple, "fog,rain".

    Raises:
        UserError: There is no such field, or the value is of another type.
    """
    for name, text in texts.items():
        known = dict(fields_of(config))
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean config.{near[0]}?" if near else ""
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
    """Dotted name and type of every field."""
    for key in config:
        if isinstance(config[key], ConfigDict):
            yield from fields_of(config[key], f"{path}{key}.")
        else:
            yield f"{path}{key}", config.get_type(key)


def _literal(text: str) -> Any:
    """The Python value that a text is, or the text."""
    words = {"true": True, "false": False, "none": None}
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return words.get(text.strip().lower(), text.strip())


def _model() -> ConfigDict:
    return ConfigDict(
        {
            "name": "radenet",
            "num_classes": len(CLASSES),
            "doppler_bins": 64,
            "elevation_bins": 37,
            "widths": (128, 256, 512),
            "decoder_width": 128,
            "num_groups": 32,
            "cbam": "official",  # "paper": attention alone; "off"
            "input_stem": False,
            "backbone": "unet",
            "neck": "dilated",  # "plain"
            "heads": "expanded",  # "default"
            "pad_multiple": 8,
            "crop_output": True,
            "dtype": "float32",  # of the computation; parameters are float32
            "remat": "none",  # "blocks", "full": less memory, more time
            "heatmap_prior": 0.5,  # confidence of an untrained model, as released
            # The network sees (projection - center) * scale; as released, the projection.
            "input_center": 0.0,
            "input_scale": 1.0,
        }
    )


def _loss() -> ConfigDict:
    return ConfigDict(
        {
            "heatmap_sigma_mode": "fixed",  # "adaptive", "anisotropic"
            "heatmap_sigma_bins": 3.0,
            "gwd_transform": "sqrt",  # "none", "log1p"
            "gwd_tau": 1.65,
            "normalize_yaw": False,
            "assignment": "center",  # "nms", with the thresholds of `decode`
            "weights": {"focal": 2.0, "gwd": 1.0, "smooth_l1": 1.0},
            "normalize": True,  # divide each part by its own value
            # Boxes are z0 + dz. The paper prints no value for its sensor height.
            "z0_m": 0.0,
        }
    )


def _decode() -> ConfigDict:
    return ConfigDict(
        {
            "max_detections": 100,
            "score_threshold": 0.3,
            "threshold_inclusive": True,  # score >= threshold
            "nms_iou": 0.3,
            "per_class_nms": False,
            # Boxes with a center outside are left out before NMS: x, y, z from and to.
            "roi": placeholder(tuple),
            # Where the length of the regressed (sin, cos) scales a box: "nms" alone,
            # "always" (results too, as the released evaluator has it), "never".
            "raw_yaw": "nms",
            "clip_sizes": True,  # regressed sizes that are not positive; False: released
        }
    )


def _train() -> ConfigDict:
    return ConfigDict(
        {
            "batch_size": 10,
            "num_epochs": 10,
            "learning_rate": 1e-3,
            "final_learning_rate": 1e-4,
            # Per step, from the first rate to the final one: "cosine" once in the
            # training; "cyclic_cosine" down in one epoch, up in the next, as released.
            "schedule": "cosine",
            "weight_decay": 0.01,
            "warmup_steps": 0,
            "gradient_clip_norm": placeholder(float),
            # Decay per batch of the parameters' moving average; None for no average.
            "ema_decay": placeholder(float),
            "gradient_accumulation_steps": 1,  # batches per update of the parameters
            "parameter_sharding": "replicated",  # "fsdp"
            "log_every_steps": 20,
            "checkpoint_every_steps": 500,
            "checkpoints_to_keep": 2,
            "evaluate_every_epochs": 0,  # 0: after training only
            # Which checkpoint is the best: mean over classes, in the first protocol.
            "best_metric": "map_3d_iou30",
            "max_skipped_steps": 20,  # in a row, for loss or gradient not finite
        }
    )


def _data() -> ConfigDict:
    return ConfigDict(
        {
            "format": "kradar",
            # Folders of the dataset; () for what `config.simulation` describes.
            "roots": (),
            "labels": placeholder(str),  # folder or zip of a revision; else the roots'
            # Folder of projections; None: in the first root.
            "records": placeholder(str),
            "embeddings": placeholder(str),  # folder of `radejax embed`, for images
            "image_backbone": placeholder(str),  # its weights, see training.md
            "camera_calibration": placeholder(str),  # folder; else the roots'
            "label_version": "v2.1",
            "visibility": ("R",),  # what the radar can see
            "include_unstarred_v11_labels": False,  # v1.1 lines without a *, as released
            "sequences": (),  # only these, such as (1, 58); () for all that are there
            "weather": (),  # only these, such as ("fog", "rain"); () for all
            # Whole sequences of the train split that choose the best checkpoint and are
            # not trained on: numbers, or one share that is drawn, (0.1,); () for none.
            "validation": (),
            "validation_seed": 0,  # of that draw; seeds of a run do not change it
            "max_objects": 32,  # per frame; 14 is the most in K-Radar v2.1
            "azimuth_mapping": "true",  # "stretched": released checkpoints
            "num_threads": 2,  # that prepare batches
            # Augmentation, off as in the papers: share of frames mirrored left to right,
            # standard deviations of a gain at all ranges and of one that grows with range.
            "mirror_probability": 0.0,
            "gain_db": 0.0,
            "gain_slope_db": 0.0,
            # Exchanges the labels of training frames: what is learnt then is no skill.
            "label_permutation_seed": placeholder(int),
        }
    )


def _evaluation() -> ConfigDict:
    return ConfigDict(
        {
            "roi": NARROW_ROI,
            # The papers', ours, K-Radar's; the first chooses the best checkpoint.
            "protocols": ("coco101", "all_point", "kradar_r40"),
            "empty_frames": "protocol",  # each one's own; "class", "frame", "none"
            "iou_thresholds": (0.3, 0.5),
            "score_threshold": 0.3,  # of all protocols but "all_point", which has none
            "min_score": 0.05,  # predictions are kept from here on
            "bootstrap": 0,  # resamples of sequences for intervals; 1000 is plenty
            "batch_size": 8,
            "num_visualizations": 8,
        }
    )


def _logging() -> ConfigDict:
    return ConfigDict(
        {
            "num_visualizations": 4,  # of fixed frames, at every evaluation during training
            "wandb": False,  # Weights & Biases, beside TensorBoard
            "wandb_project": "radejax",
            "profile_steps": (2, 5),  # first and last traced, counted from a start
        }
    )
