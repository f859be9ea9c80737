"""Configs: every field and preset, conditions between fields, files, texts and JSON."""

import itertools
import json
import math
import pathlib
import re
from typing import Any

import pytest

from radejax import models
from radejax.config import (
    Config,
    config_file,
    config_name,
    load_config,
    load_module,
    parse_options,
    with_texts,
)
from radejax.core.errors import UserError
from radejax.models.options import DinoRadeOptions

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
NAN, INF = math.nan, math.inf

# Values ------------------------------------------------------------------------------

WHOLE = load_config("quickstart_fusion").with_fields(
    {
        "decode.roi": (0.0, 72.0, -6.4, 6.4, -2.0, 6.0),
        "train.max_steps": 10,
        "train.gradient_clip_norm": 1.0,
        "train.ema_decay": 0.9,
        **dict.fromkeys(
            (f"data.{x}" for x in ("labels", "records", "embeddings")), "x"
        ),
        "data.image_backbone": "x",
        "data.camera_calibration": "x",
        "data.release": "rpc",
        "data.num_threads": 1,
        "data.label_permutation_seed": 1,
        "data.camera.radar_from_lidar_m": (-2.5, 0.3, 0.7),
        "data.camera.radar_from_lidar_z_m": 0.7,
        "simulation.grid.max_azimuth_deg": 50.0,
        "simulation.grid.max_elevation_deg": 18.0,
        "simulation.grid.max_doppler_mps": 4.0,
    }
)
"""A config with all sections, in which all fields but `simulation.sequences` have values."""

_WRONG: list[tuple[Any, str]] = [
    (
        0,
        "model.decoder_width model.num_groups model.pad_multiple model.image.num_heads "
        "decode.max_detections train.batch_size train.num_epochs train.max_steps "
        "train.gradient_accumulation_steps train.log_every_steps train.checkpoints_to_keep "
        "train.checkpoint_every_steps data.max_objects evaluation.batch_size",
    ),
    (
        0.0,
        "model.input_scale loss.heatmap_sigma_bins loss.gwd_tau train.learning_rate "
        "train.gradient_clip_norm",
    ),
    (
        1.0,
        "model.heatmap_prior model.fusion.dropout train.ema_decay "
        "train.final_learning_rate",
    ),
    (1.5, "decode.nms_iou data.mirror_probability train.max_steps"),
    (1, "simulation.grid.num_range logging.wandb"),
    ((), "classes model.widths evaluation.protocols"),
    (
        "other",
        "model.name model.input_stem model.backbone loss.heatmap_sigma_mode "
        "loss.gwd_transform train.schedule train.parameter_sharding data.format "
        "data.label_version data.camera.projection simulation.output "
        "simulation.camera_mode",
    ),
]
WRONG: list[tuple[str, Any]] = [
    *((field, value) for value, fields in _WRONG for field in fields.split()),
    ("seed", 2**32),
    ("classes", ("Sedan", "Sedan")),
    ("classes", ("Tank",)),
    ("model.num_classes", 4),
    ("model.widths", (32, 0)),
    ("model.pad_multiple", 2),
    ("model.doppler_bins", "64"),
    ("model.image.size", (720,)),
    ("model.fusion.num_heads", 3),
    ("model.query_grid.range_m", (0.0, NAN)),
    ("loss.own_terms", ("focal",)),
    ("loss.weights", {"giou": 1.0}),
    ("loss.weights", {"focal": -1.0}),
    ("loss.weights", {"focal": 0.0, "gwd": 0.0, "smooth_l1": 0.0}),
    ("decode.roi", (0.0, 72.0)),
    ("data.roots", ("",)),
    ("data.visibility", ("X",)),
    ("data.sequences", (1, 1)),
    ("data.weather", ("mist",)),
    *(("data.validation", value) for value in (0.1, (1.0,), (0.1, 0.2), (5, 5))),
    ("data.camera.radar_from_lidar_m", (1.0, 2.0)),
    ("evaluation.roi", (72.0, 0.0, -6.4, 6.4, -2.0, 6.0)),
    ("evaluation.empty_frames", None),
    *(("evaluation.iou_thresholds", value) for value in ((2.0,), (0.3, 0.3), (NAN,))),
    ("logging.profile_steps", (5, 2)),
    ("simulation.radar_from_lidar_m", (0.0, 0.0)),
]


def _refused(field: str, value: Any, named: str | None = None) -> None:
    with pytest.raises(UserError) as refused:
        WHOLE.with_fields({field: value})
    message = str(refused.value)
    assert re.match(rf"config\.{re.escape(named or field)}(\[\d+\])* is ", message)
    assert "\n" not in message


@pytest.mark.parametrize(("field", "value"), WRONG)
def test_an_impossible_value_is_named(field: str, value: Any) -> None:
    # A mapping changes the named weights only.
    is_one = field == "loss.weights" and len(value) == 1 and "giou" not in value
    _refused(field, value, "loss.weights.focal" if is_one else None)


FIELDS = {name: value for name, value in WHOLE.fields() if value is not None}
ANY_NUMBER = ("input_center", "radar_from_lidar_z_m", "layer_scale")


@pytest.mark.parametrize("field", FIELDS)
def test_a_value_of_a_wrong_type_or_range_is_named(field: str) -> None:
    value = FIELDS[field]
    wrong: list[Any] = [{"a": 1}, "many" if not isinstance(value, str) else 1]
    if type(value) is int:
        wrong += [2.5, -1]
    elif isinstance(value, float):
        wrong += [NAN, INF] + [-1.0] * (field.rpartition(".")[2] not in ANY_NUMBER)
    for other in wrong:
        _refused(field, other)


def test_sections_and_fields_that_do_not_exist_are_named() -> None:
    for fields, message in (
        (
            {"train.num_epoch": 3},
            "train.num_epoch is not a field; did you mean config.t",
        ),
        ({"trian.batch_size": 3}, "trian is not a field; did you mean config.train"),
        ({"model.image.kin": "vit"}, "model.image.kin is not a field"),
        ({"train": 3}, "train is 3, expected "),
        ({"model": 3}, "model is 3, expected "),
        ({"simulation": "kradar"}, "simulation is 'kradar', expected "),
    ):
        with pytest.raises(UserError, match=rf"^config\.{re.escape(message)}"):
            WHOLE.with_fields(fields)
    with pytest.raises(UserError, match=r"^config\.train\.batch_size cannot be set"):
        WHOLE.train.batch_size = 3
    with pytest.raises(UserError, match=r"^config\.seed cannot be set.*replace"):
        WHOLE.seed = 3


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"train.best_metric": "map_3d_iou70"}, None),  # no validation, no best one
        (
            {"train.best_metric": "map_3d_iou70", "train.evaluate_every_epochs": 1},
            "train.best_metric is 'map_3d_iou70', expected one of .*map_bev_iou30",
        ),
        (
            {"model.doppler_bins": 64},
            "model.doppler_bins is 64, expected 16, as config",
        ),
        (
            {"classes": ("Sedan",)},
            "model.num_classes is 5, expected 1, the number of config.classes",
        ),
        ({"classes": ("Sedan",), "model.num_classes": 1}, None),
        (
            {"train.learning_rate": 1e-5},
            "train.final_learning_rate is .*, expected at most config.train.learning_rate",
        ),
        ({"train.learning_rate": 1e-5, "train.final_learning_rate": 0.0}, None),
        (
            {"simulation.scenes": "labels.zip", "simulation.vru_density_scale": 2.0},
            "simulation.vru_density_scale is 2.0, expected 1",
        ),
        (
            {"model.fusion.out_of_view": "official", "model.image.size": (80, 512)},
            r"model.image.size is \(80, 512\), expected a width above 560",
        ),
    ],
)
def test_what_one_field_requires_of_another(
    fields: dict[str, Any], message: str | None
) -> None:
    if message is None:
        assert dict(WHOLE.with_fields(fields).fields()).items() >= fields.items()
        return
    with pytest.raises(UserError, match=rf"^config\.{message}"):
        WHOLE.with_fields(fields)


def test_a_model_has_the_options_of_its_class() -> None:
    config = Config().replace(model={"name": "dinorade"})
    assert config.model == DinoRadeOptions()
    with pytest.raises(UserError, match=r"^config\.model\.image is not a field"):
        Config().with_fields({"model.image.kind": "vit"})


# Presets -----------------------------------------------------------------------------


def _words(name: str) -> list[str]:
    module = load_module(CONFIGS / f"{name}.py")
    if name.startswith("quickstart"):
        words = ["radar", "radar,short", "silhouettes", "silhouettes,short"]
        words += ["pretrained", "resnet50", "long"]
        return ["", "short"] + words * name.endswith("fusion")
    groups = [
        ["", *getattr(module, names, ())]
        for names in ("VARIANTS", "PRESETS", "CLASS_SETS")
    ]
    return [",".join(filter(None, words)) for words in itertools.product(*groups)]


@pytest.mark.parametrize("name", sorted(path.stem for path in CONFIGS.glob("*.py")))
def test_every_preset_can_be_built_and_stored_as_json(name: str) -> None:
    assert config_file(name).samefile(CONFIGS / f"{name}.py")
    choices = _words(name)
    for words in choices:
        config = load_config(f"{name}:{words}")
        assert Config(**json.loads(config.model_dump_json())) == config
        assert models.build(config.model).options == config.model
    if name in ("radenet", "dinorade"):
        assert (
            len(choices) > 40
        )  # every row with the presets of the paper and the released code


@pytest.mark.parametrize(
    ("name", "field", "expected"),
    [
        ("radenet:base,paper", "model.cbam", "off"),  # the row has no attention
        ("radenet:base,official", "model.cbam", "off"),
        ("radenet:sedan", "classes", ("Sedan",)),
        *((f"dinorade:{x}", "loss.heatmap_sigma_bins", 0.75) for x in ("r", "rcw")),
        ("dinorade:official", "loss.heatmap_sigma_bins", 3.0),
    ],
)
def test_fields_of_presets(name: str, field: str, expected: Any) -> None:
    assert dict(load_config(name).fields())[field] == expected


def test_options_of_a_config_are_of_different_groups() -> None:
    assert parse_options("b, a", ("a",), ("b", "c")) == ["a", "b"]
    assert parse_options(None, ("a",)) == [None]
    for words, message in (
        ("base,stem", "'base' and 'stem' exclude each other"),
        ("big", r"unknown config option 'big'; available"),
    ):
        with pytest.raises(UserError, match=message):
            load_config(f"radenet:{words}")


# Files and texts ---------------------------------------------------------------------


def test_a_file_that_is_no_config_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "mine.py").write_text("x = 1\n")
    (tmp_path / "other.py").write_text("def get_config(arg=None): return {'seed': 1}\n")
    for name, message in (
        (f"{tmp_path / 'mine.py'}:word", r"mine\.py has no function get_config"),
        (
            f"{tmp_path / 'other.py'}",
            r"get_config\(\) is {'seed': 1}, expected a Config",
        ),
        (str(tmp_path / "radenet"), r"no such .* a \.py file.*mean radenet\?"),
        ("configs_of_mine/radnet.py", r"no such .* a \.py file.*mean radenet\?"),
    ):
        with pytest.raises(UserError, match=message):
            load_config(name)


def test_names_of_runs() -> None:
    assert config_name("configs/quickstart.py") == "quickstart"
    assert config_name("a/b/radenet.py:stem,sedan") == "radenet-stem-sedan"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("train.batch_size", "4", 4),
        ("train.learning_rate", "1", 1.0),
        ("train.learning_rate", "2e-3", 2e-3),
        ("train.ema_decay", "none", None),
        ("data.label_permutation_seed", "7", 7),
        ("data.label_version", "2.1", "2.1"),
        ("data.weather", "fog", ("fog",)),
        ("data.weather", "fog, rain", ("fog", "rain")),
        ("data.weather", "('fog', 'rain')", ("fog", "rain")),
        ("data.sequences", "[1, 58]", (1, 58)),
        ("data.sequences", "()", ()),
        ("data.validation", "0.1", (0.1,)),
        ("data.visibility", "none", None),
        ("model.cbam", "off", "off"),
        ("model.input_stem", "true", True),
        ("evaluation.iou_thresholds", "0.5", (0.5,)),
        ("loss.weights.focal", "3", 3.0),
        ("logging.wandb_project", "123", "123"),
        ("simulation.seed", "5", 5),
        ("model.image.kind", "vit", "vit"),
    ],
)
def test_a_text_becomes_the_value_of_a_field(
    name: str, text: str, expected: Any
) -> None:
    found = dict(with_texts(WHOLE, {name: text}).fields())[name]
    assert found == expected
    assert type(found) is type(expected)


def test_texts_are_set_together() -> None:
    texts = {"classes": "Sedan", "model.num_classes": "1"}
    assert with_texts(Config(), texts).classes == ("Sedan",)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("train.batch_size", "many", "is 'many', expected an integer"),
        ("train.batch_size", "2.5", "is 2.5, expected an integer"),
        ("train.batch_size", "true", "is True, expected an integer"),
        ("model.input_stem", "1", "is 1, expected a boolean"),
        ("train", "1", "config.train is not a field of this config"),
        ("train.batchsize", "1", "did you mean config.train.batch_size?"),
        ("train.learning_rate", "((((" * 300, "expected a number"),
    ],
)
def test_other_texts_are_rejected_by_name(name: str, text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"^config\.train|^config\.model") as refused:
        with_texts(Config(), {name: text})
    assert message in str(refused.value)


def test_data_paths_differ_from_machine_to_machine() -> None:
    values = WHOLE.replace(data={"roots": ("/a",)}).without_data_paths()
    assert values == WHOLE.without_data_paths()
    assert values["data"]["embeddings"] is None
    assert values["train"]["batch_size"] == WHOLE.train.batch_size
