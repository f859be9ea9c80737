"""Every field of a config and what it may be, checked before a run does anything."""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

from ml_collections import ConfigDict

from radejax.core.errors import UserError
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.kradar.labels import LABEL_CLASSES, VERSIONS, VISIBILITY_FLAGS
from radejax.evaluation.protocols import PROTOCOLS
from radejax.losses.detection import LOSSES
from radejax.simulation.config import SimulationConfig


@dataclasses.dataclass(frozen=True)
class Rule:
    """What a field may be.

    Attributes:
        expected: In words, for the message.
        holds: Whether a value is that.
    """

    expected: str
    holds: Callable[[Any], bool]


def _integer(least: int, most: int | None = None) -> Rule:
    def holds(value: Any) -> bool:
        is_integer = isinstance(value, numbers.Integral) and not _is_bool(value)
        return is_integer and least <= value <= (math.inf if most is None else most)

    upper = "" if most is None else f" and at most {most}"
    return Rule(f"an integer of at least {least}{upper}", holds)


def _number(
    text: str = "a number", fits: Callable[[float], bool] = lambda _: True
) -> Rule:
    """A finite number that fits."""

    def holds(value: Any) -> bool:
        is_number = isinstance(value, numbers.Real) and not _is_bool(value)
        return is_number and math.isfinite(value) and fits(value)

    return Rule(text, holds)


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool)


def _one_of(*choices: Any) -> Rule:
    """One of several values; True is not 1."""
    return Rule(
        f"one of {', '.join(map(repr, choices))}",
        lambda value: any(type(value) is type(c) and value == c for c in choices),
    )


def _several(rule: Rule, count: int | None = None, *, distinct: bool = False) -> Rule:
    """A tuple or list, not empty, or of so many, each entry as the rule says."""

    def holds(value: Any) -> bool:
        if not isinstance(value, tuple | list) or not all(map(rule.holds, value)):
            return False
        if distinct and len(set(value)) < len(value):
            return False
        return len(value) == count if count is not None else len(value) > 0

    size = "one or more" if count is None else f"{count}"
    names = ", different from each other" * distinct
    return Rule(f"a tuple of {size}{names}, each {rule.expected}", holds)


def _some(rule: Rule) -> Rule:
    """A tuple or list of different entries, or () for all."""
    several = _several(rule, distinct=True)
    return Rule(
        f"{several.expected}; () for all",
        lambda value: value in ((), []) or several.holds(value),
    )


def _or_none(rule: Rule) -> Rule:
    return Rule(f"{rule.expected}, or None", lambda v: v is None or rule.holds(v))


def _where(rule: Rule, text: str, fits: Callable[[Any], bool]) -> Rule:
    return Rule(f"{rule.expected}; {text}", lambda v: rule.holds(v) and fits(v))


def _are_weights(value: Any) -> bool:
    """By name; or of focal, GWD and smooth L1 in a row, as in earlier versions."""
    if isinstance(value, Mapping):
        is_known, value = set(value) <= set(LOSSES), tuple(value.values())
    else:
        is_known = _several(_NOT_NEGATIVE, 3).holds(value)
    return is_known and all(map(_NOT_NEGATIVE.holds, value)) and any(value)


_BOOL = Rule("True or False", _is_bool)
_TEXT = Rule("text", lambda value: isinstance(value, str))
_MAPPING = Rule("a mapping of fields", lambda value: isinstance(value, Mapping))
_COUNT, _COUNT_OR_0 = _integer(1), _integer(0)
_SEED = _integer(0, 2**32 - 2)  # of 32 bits; a step uses the next one too
_POSITIVE = _number("a number above 0", lambda value: value > 0)
_NOT_NEGATIVE = _number("a number of at least 0", lambda value: value >= 0)
_SHARE = _number("a number from 0 to 1", lambda value: 0 <= value <= 1)
_BELOW_ONE = _number("a number from 0 to below 1", lambda value: 0 <= value < 1)
_AXIS = _where(
    _several(_number(), 2), "not all 0", lambda value: any(x != 0 for x in value)
)
_HELD_OUT = Rule(
    "a tuple of sequence numbers, different from each other, or of one share between 0 "
    "and 1, such as (0.1,); () for none",
    lambda value: (
        _some(_COUNT).holds(value)
        or _several(_number(fits=lambda share: 0 < share < 1), 1).holds(value)
    ),
)
_VERSION = _one_of(*VERSIONS, *(version.removeprefix("v") for version in VERSIONS))

RULES: dict[str, Rule] = {
    "seed": _SEED,
    "classes": _several(_one_of(*LABEL_CLASSES), distinct=True),
    # The model: which parts there are, and what they need of each other, is told when
    # it is built.
    "model.name": _one_of("radenet", "dinorade"),
    "model.num_classes": _COUNT,
    "model.doppler_bins": _COUNT,
    "model.elevation_bins": _COUNT,
    "model.widths": _several(_COUNT),
    "model.decoder_width": _COUNT,
    "model.num_groups": _COUNT,
    "model.cbam": _one_of("official", "paper", "off", None),
    "model.input_stem": _BOOL,
    "model.backbone": _TEXT,
    "model.neck": _TEXT,
    "model.heads": _TEXT,
    "model.pad_multiple": _COUNT,
    "model.crop_output": _BOOL,
    "model.dtype": _one_of("float32", "bfloat16"),
    "model.remat": _one_of("none", "blocks", "full", False, True),
    "model.heatmap_prior": _number(
        "a number between 0 and 1, without the two", lambda value: 0 < value < 1
    ),
    "model.input_center": _number(),
    "model.input_scale": _POSITIVE,
    "model.image.kind": _one_of("vit", "resnet50"),
    "model.image.size": _several(_COUNT, 2),
    "model.image.freeze": _BOOL,
    "model.image.standardize": _BOOL,
    "model.image.hidden_size": _COUNT,
    "model.image.num_layers": _COUNT,
    "model.image.num_heads": _COUNT,
    "model.image.mlp_dim": _COUNT,
    "model.image.patch_size": _COUNT,
    "model.image.num_registers": _COUNT_OR_0,
    "model.image.gated_mlp": _BOOL,
    "model.image.layer_scale": _number(),
    "model.image.attention": _one_of("auto", "blocked", "xla", "cudnn"),
    "model.image.resnet_width": _COUNT,
    "model.fusion.num_heads": _COUNT,
    "model.fusion.num_points": _COUNT,
    "model.fusion.num_elevation": _COUNT,
    "model.fusion.weighting": _one_of("mlp", "cnn", "off"),
    "model.fusion.gate": _one_of("channel", "bin"),
    "model.fusion.out_of_view": _one_of("drop", "official"),
    "model.fusion.necks": _BOOL,
    "model.fusion.dropout": _BELOW_ONE,
    "model.fusion.chunk_size": _COUNT_OR_0,
    "model.query_grid.range_m": _AXIS,
    "model.query_grid.azimuth_deg": _AXIS,
    "model.query_grid.elevation_deg": _AXIS,
    "loss.heatmap_sigma_mode": _one_of("fixed", "adaptive", "anisotropic"),
    "loss.heatmap_sigma_bins": _POSITIVE,
    "loss.gwd_transform": _one_of("sqrt", "none", "log1p"),
    "loss.gwd_tau": _POSITIVE,
    "loss.normalize_yaw": _BOOL,
    "loss.assignment": _one_of("center", "nms"),
    "loss.weights": Rule(
        f"numbers of at least 0, not all 0, by names of {', '.join(LOSSES)}",
        lambda value: _are_weights(value),
    ),
    "loss.normalize": _BOOL,
    "loss.z0_m": _number(),
    "decode.max_detections": _COUNT,
    "decode.score_threshold": _SHARE,
    "decode.threshold_inclusive": _BOOL,
    "decode.nms_iou": _SHARE,
    "decode.per_class_nms": _BOOL,
    "decode.roi": _or_none(_several(_number(), 6)),
    "decode.raw_yaw": _one_of("nms", "always", "never"),
    "decode.clip_sizes": _BOOL,
    "train.batch_size": _COUNT,
    "train.num_epochs": _COUNT,
    "train.learning_rate": _POSITIVE,
    "train.final_learning_rate": _NOT_NEGATIVE,
    "train.weight_decay": _NOT_NEGATIVE,
    "train.schedule": _one_of("cosine", "cyclic_cosine"),
    "train.warmup_steps": _COUNT_OR_0,
    "train.gradient_clip_norm": _or_none(_POSITIVE),
    "train.ema_decay": _or_none(_BELOW_ONE),
    "train.gradient_accumulation_steps": _COUNT,
    "train.parameter_sharding": _one_of("replicated", "fsdp"),
    "train.log_every_steps": _COUNT,
    "train.checkpoint_every_steps": _COUNT,
    "train.checkpoints_to_keep": _or_none(_COUNT),
    "train.evaluate_every_epochs": _COUNT_OR_0,
    "train.best_metric": _TEXT,
    "train.max_skipped_steps": _COUNT_OR_0,
    "data.format": _TEXT,
    "data.label_version": _VERSION,
    "data.visibility": _or_none(_several(_one_of(*VISIBILITY_FLAGS), distinct=True)),
    "data.include_unstarred_v11_labels": _BOOL,
    "data.sequences": _some(_COUNT),
    "data.weather": _some(_one_of(*WEATHERS)),
    "data.validation": _HELD_OUT,
    "data.validation_seed": _SEED,
    "data.max_objects": _COUNT,
    "data.azimuth_mapping": _one_of("true", "stretched"),
    "data.num_threads": _COUNT_OR_0,
    "data.num_workers": _COUNT_OR_0,
    "data.mirror_probability": _SHARE,
    "data.gain_db": _NOT_NEGATIVE,
    "data.gain_slope_db": _NOT_NEGATIVE,
    "data.label_permutation_seed": _or_none(_COUNT_OR_0),
    "data.camera.projection": _one_of("raw", "pinhole"),
    "data.camera.radar_from_lidar_m": _or_none(_several(_number(), 3)),
    "data.camera.radar_from_lidar_z_m": _or_none(_number()),
    "data.camera.calibration": _one_of("sequence", "common"),
    "data.camera.resize": _BOOL,
    "data.camera.allow_missing": _BOOL,
    "evaluation.roi": _or_none(
        _where(
            _several(_number(), 6),
            "x0 < x1, y0 < y1, z0 < z1",
            lambda value: all(
                a < b for a, b in zip(value[::2], value[1::2], strict=True)
            ),
        )
    ),
    "evaluation.protocols": _several(_one_of(*PROTOCOLS), distinct=True),
    "evaluation.empty_frames": _one_of("protocol", "class", "frame", "none"),
    "evaluation.iou_thresholds": _several(_BELOW_ONE, distinct=True),
    "evaluation.score_threshold": _SHARE,
    "evaluation.min_score": _SHARE,
    "evaluation.bootstrap": _COUNT_OR_0,
    "evaluation.batch_size": _COUNT,
    "evaluation.num_visualizations": _COUNT_OR_0,
    "logging.num_visualizations": _COUNT_OR_0,
    "logging.wandb": _BOOL,
    "logging.wandb_project": _TEXT,
    "logging.profile_steps": _where(
        _several(_COUNT_OR_0, 2),
        "the first not after the last",
        lambda value: value[0] <= value[1],
    ),
    # What belongs together in a simulation is checked by `SimulationConfig`.
    "simulation.seed": _COUNT_OR_0,
    "simulation.scenes": _TEXT,
    "simulation.train_sequences": _COUNT_OR_0,
    "simulation.test_sequences": _COUNT_OR_0,
    "simulation.sequences": _or_none(_several(_COUNT, distinct=True)),
    "simulation.label_version": _VERSION,
    "simulation.frames_per_sequence": _COUNT_OR_0,
    "simulation.frame_stride": _COUNT,
    "simulation.vru_density_scale": _number(),
    "simulation.grid": Rule(
        "'kradar' or a mapping of sizes",
        lambda value: value == "kradar" or isinstance(value, Mapping),
    ),
    "simulation.radar": _MAPPING,
    "simulation.output": _one_of("tesseract", "projection"),
    "simulation.image_width": _COUNT_OR_0,
    "simulation.image_height": _COUNT_OR_0,
    "simulation.cover_lens": _BOOL,
    "simulation.camera_mode": _one_of("scene", "oracle"),
    "simulation.radar_from_lidar_m": _several(_number(), 3),
    "simulation.label_distance_m": _POSITIVE,
}
"""What each field may be; a new field of a config gets its row here."""

_SECTIONS = ("model", "loss", "decode", "train", "data", "evaluation", "logging")
_CAMERA_SECTIONS = ("model.image", "model.fusion", "model.query_grid", "data.camera")


def check(config: ConfigDict) -> None:
    """Refuses a config that a run could not do as it says; nothing is read or written.

    What needs data is checked later: whether a warm-up is shorter than the training,
    for example.

    Raises:
        UserError: A field is missing, unknown or has an impossible value; names the
            first one, what it is and what is expected.
    """
    values = config.to_dict()
    found = dict(field_values(values))
    sections = {"", *_SECTIONS}
    if found.get("model.name") != "radenet":
        sections |= set(_CAMERA_SECTIONS)
    if "simulation" in values:
        sections.add("simulation")
    known = [name for name in RULES if name.rpartition(".")[0] in sections]
    for name, value in found.items():
        if any(rule.startswith(f"{name}.") for rule in known):
            raise UserError(f"config.{name} is {value!r}, expected a section of fields")
        check_name(name, known)
        check_field(name, value)
    for name in known:
        if name not in found:
            raise UserError(
                f"config.{name} is missing, expected {RULES[name].expected}"
            )
    _check_together(config, values)


def check_name(name: str, known: Collection[str]) -> None:
    """`UserError` with the nearest name for a field that is not among those known."""
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean config.{near[0]}?" if near else ""
        raise UserError(f"config.{name} is not a field of this config{hint}")


def check_field(name: str, value: Any) -> None:
    """`UserError` for an impossible value of a field that there is, by its dotted name."""
    if not RULES[name].holds(value):
        raise UserError(f"config.{name} is {value!r}, expected {RULES[name].expected}")


def check_best_metric(name: str, iou_thresholds: Sequence[float]) -> None:
    """`UserError` for a metric that validations at these thresholds do not compute."""
    spaces = ("bev", "3d")
    known = [
        f"map_{space}_iou{100 * i:.4g}" for space in spaces for i in iou_thresholds
    ]
    if name not in known:
        raise UserError(
            f"train.best_metric is {name!r}; with these evaluation.iou_thresholds it "
            f"can be one of {', '.join(known)}"
        )


def field_values(
    values: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, Any]]:
    """Name with dots and value of every field; an empty section counts as one."""
    for key, value in values.items():
        name = f"{path}{key}"
        if isinstance(value, Mapping) and value and name not in RULES:
            yield from field_values(value, f"{name}.")
        else:
            yield name, value


def _check_together(config: ConfigDict, values: Mapping[str, Any]) -> None:
    """What one field asks of another."""
    train, model = config.train, config.model
    _require_same(
        "model.num_classes", model.num_classes, len(config.classes), "config.classes"
    )
    if train.final_learning_rate > train.learning_rate:
        raise UserError(
            f"config.train.final_learning_rate is {train.final_learning_rate}, "
            f"expected at most config.train.learning_rate, {train.learning_rate}"
        )
    if train.evaluate_every_epochs:
        check_best_metric(train.best_metric, config.evaluation.iou_thresholds)
    if "simulation" in values:
        grid = SimulationConfig.from_mapping(values["simulation"]).make_grid()
        source = "config.simulation.grid"
        _require_same(
            "model.doppler_bins", model.doppler_bins, grid.num_doppler, source
        )
        _require_same(
            "model.elevation_bins", model.elevation_bins, grid.num_elevation, source
        )


def _require_same(name: str, found: int, expected: int, source: str) -> None:
    if found != expected:
        raise UserError(
            f"config.{name} is {found}, expected {expected}, as {source} has"
        )
