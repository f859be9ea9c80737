"""Configs: every field and preset, conditions between fields, files, texts and JSON."""

import itertools
import json
import math
import pathlib
import re

import pytest

from radejax import config as configs
from radejax import models
from radejax.config import Config, load_config, with_texts
from radejax.core.errors import UserError
from radejax.detection.decode import DecodeOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.options import DinoRadeOptions
from radejax.simulation.config import SimulationOptions

CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"
NAN, INF = math.nan, math.inf

# Values ------------------------------------------------------------------------------

WHOLE = load_config("quickstart_fusion").with_fields(
    {
        "decode.roi": (0.0, 72.0, -6.4, 6.4, -2.0, 6.0),
        "train.max_steps": 10,
        "train.gradient_clip_norm": 1.0,
        "train.ema_decay": 0.9,
        "data.labels": "x",
        "data.records": "x",
        "data.embeddings": "x",
        "data.image_backbone": "x",
        "data.camera_calibration": "x",
        "data.release": "rpc",
        "data.num_threads": 1,
        "data.random_gain_db": 3.0,
        "data.label_permutation_seed": 1,
        "data.camera.radar_from_lidar_m": (-2.5, 0.3, 0.7),
        "data.camera.radar_from_lidar_z_m": 0.7,
        "simulation.grid.max_azimuth_deg": 50.0,
        "simulation.grid.max_elevation_deg": 18.0,
        "simulation.grid.max_doppler_mps": 4.0,
    }
)
"""A config with all sections, in which all fields but `simulation.sequences` have values."""


FIELDS = {name: value for name, value in WHOLE.fields() if value is not None}
ANY_NUMBER = ("input_center", "radar_from_lidar_z_m", "layer_scale")


def _check_rejected(fields, message):
    with pytest.raises(UserError, match=rf"^config\.{message}") as rejected:
        WHOLE.with_fields(fields)
    assert "\n" not in str(rejected.value)


@pytest.mark.parametrize("field", FIELDS)
def test_a_value_of_a_wrong_type_or_range_is_named(field):
    value = FIELDS[field]
    wrong = [{"a": 1}, "many" if not isinstance(value, str) else 1]
    if type(value) is int:
        wrong += [2.5, -1]
    elif isinstance(value, float):
        wrong += [NAN, INF] + [-1.0] * (field.rpartition(".")[2] not in ANY_NUMBER)
    for other in wrong:
        _check_rejected({field: other}, rf"{re.escape(field)}(\[\d+\])* is ")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("classes", ("Tank",)),
        ("model.query_grid.elevation_deg", (-1.0, 0.0, 1.0)),
        ("loss.own_terms", ("focal",)),
        ("loss.weights", {"focal": 0.0, "gwd": 0.0, "smooth_l1": 0.0}),
        ("data.camera.radar_from_lidar_m", (1.0, 2.0)),
        ("evaluation.roi", (72.0, 0.0, -6.4, 6.4, -2.0, 6.0)),
    ],
)
def test_a_value_that_its_type_allows_is_named(field, value):
    _check_rejected({field: value}, rf"{re.escape(field)}(\[\d+\])* is ")


BEST = {"train.best_metric": "map_3d_iou70", "train.evaluate_every_epochs": 1}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"train.num_epoch": 3}, "train.num_epoch is not a field; did you mean conf"),
        ({"trian.batch_size": 3}, "trian is not a field; did you mean config.train"),
        (BEST, "train.best_metric is 'map_3d_iou70', expected one of .*map_bev_iou30"),
        ({"model.doppler_bins": 64}, "model.doppler_bins is 64, expected 16, as conf"),
        ({"model.num_groups": 64}, r"model.widths\[0\] is 32, expected a multiple of"),
        ({"classes": ("Sedan",)}, "model.num_classes is 5, expected 1, the number of"),
        ({"train.learning_rate": 1e-5}, "train.final_learning_rate is .*, expected at"),
    ],
)
def test_what_one_field_requires_of_another(fields, message):
    _check_rejected(fields, message)


@pytest.mark.parametrize(
    "fields",
    [
        {"train.best_metric": "map_3d_iou70"},  # no validation, no best one
        {"classes": ("Sedan",), "model.num_classes": 1},
        {"train.learning_rate": 1e-5, "train.final_learning_rate": 0.0},
        {
            "model.elevation_bins": 0,
            "model.fusion.weighting": "off",
            "simulation": None,
        },
    ],
)
def test_fields_that_fit_each_other(fields):
    assert dict(WHOLE.with_fields(fields).fields()).items() >= fields.items()


def _set(section, field):
    setattr(section, field, 3)


def test_other_user_errors(tmp_path):
    mine, other = tmp_path / "mine.py", tmp_path / "other.py"
    mine.write_text("x = 1\n")
    other.write_text("def get_config(arg=None): return {'seed': 1}\n")
    plain, deep = Config(), {"train.learning_rate": "((((" * 300}
    for call, message in (
        (lambda: _set(WHOLE.train, "batch_size"), r"config\.train\.batch_size cannot"),
        (lambda: load_config("radenet:base,stem"), "'base' and 'stem' exclude each"),
        (lambda: load_config("radenet:big"), r"unknown config option 'big'; available"),
        (lambda: load_config(f"{mine}:word"), r"mine\.py has no function get_config"),
        (lambda: load_config(f"{tmp_path}/radenet"), r"a \.py file.*mean radenet\?"),
        (lambda: with_texts(plain, {"train.batchsize": "1"}), "train.batch_size?"),
        (lambda: with_texts(plain, {"train.batch_size": "2.5"}), "is 2.5, expected"),
        (lambda: with_texts(plain, deep), "expected a number"),
        (lambda: with_texts(plain, {"simulation.radar.leakage": "1"}), "not a field"),
        (lambda: with_texts(WHOLE, {"simulation.radar.noise": "1"}), "radar.noise_db?"),
        (lambda: with_texts(WHOLE, {"simulation.radar.leakage": "a"}), "a number"),
    ):
        with pytest.raises(UserError, match=message):
            call()


# Presets -----------------------------------------------------------------------------


def _words(name):
    module = configs.load_module(CONFIGS / f"{name}.py")
    if name.startswith("quickstart"):
        words = ["radar", "radar,short", "silhouettes", "silhouettes,short"]
        words += ["pretrained", "resnet50", "long"]
        return ["", "short"] + words * name.endswith("fusion")
    kinds = ("VARIANTS", "PRESETS", "CLASS_SETS")
    groups = [["", *getattr(module, names, ())] for names in kinds]
    return [",".join(filter(None, words)) for words in itertools.product(*groups)]


@pytest.mark.parametrize("name", sorted(path.stem for path in CONFIGS.glob("*.py")))
def test_every_preset_can_be_built_and_stored_as_json(name):
    assert configs.config_file(name).samefile(CONFIGS / f"{name}.py")
    choices = _words(name)
    for words in choices:
        config = load_config(f"{name}:{words}")
        assert Config(**json.loads(config.model_dump_json())) == config
        assert models.build(config.model).options == config.model
    if name in ("radenet", "dinorade"):  # every row with both presets
        assert len(choices) > 40


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
def test_fields_of_presets(name, field, expected):
    assert dict(load_config(name).fields())[field] == expected


# Files and texts ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("train.batch_size", "4", 4),
        ("train.learning_rate", "1", 1.0),
        ("train.learning_rate", "2e-3", 2e-3),
        ("train.ema_decay", "none", None),
        ("data.weather", "fog, rain", ("fog", "rain")),
        ("data.weather", "('fog', 'rain')", ("fog", "rain")),
        ("data.sequences", "[1, 58]", (1, 58)),
        ("model.cbam", "off", "off"),
        ("evaluation.iou_thresholds", "0.5", (0.5,)),
        ("loss.weights.focal", "3", 3.0),
        ("simulation.radar.preset", "ideal", "ideal"),
        ("simulation.radar.leakage", "0.05", 0.05),
        ("simulation.radar.noise_db", "105,113", (105, 113)),
    ],
)
def test_a_text_becomes_the_value_of_a_field(name, text, expected):
    found = dict(with_texts(WHOLE, {name: text}).fields())[name]
    assert found == expected
    assert type(found) is type(expected)


def test_texts_are_set_together_and_models_have_the_options_of_their_class():
    texts = {"classes": "Sedan", "model.num_classes": "1"}
    assert with_texts(Config(), texts).classes == ("Sedan",)
    assert Config().replace(model={"name": "dinorade"}).model == DinoRadeOptions()


def test_names_of_runs():
    assert configs.config_name("configs/quickstart.py") == "quickstart"
    assert configs.config_name("a/b/radenet.py:stem,sedan") == "radenet-stem-sedan"


def test_data_paths_differ_from_machine_to_machine():
    values = WHOLE.replace(data={"roots": ("/a",)}).without_data_paths()
    assert values == WHOLE.without_data_paths()
    assert values["data"]["embeddings"] is None
    assert values["train"]["batch_size"] == WHOLE.train.batch_size


def test_axes_replace_the_arguments_of_a_reduced_grid():
    """The field has two kinds of sections, whose fields are not merged."""
    grid = RadarGrid.kradar()
    options = SimulationOptions()
    changed = options.replace(grid=grid.to_dict())
    assert changed.make_grid() == grid
    assert options.with_fields({"grid": grid.to_dict()}) == changed
    assert options.replace(grid={"num_range": 32}).make_grid().num_range == 32
    with pytest.raises(UserError, match=r"^config\.simulation\.grid\.num_"):
        options.replace(grid={"num_rang": 32})


def test_every_class_may_have_its_threshold_and_calibration():
    texts = {"decode.score_threshold": "0.1,0.2,0.3,0.4,0.5"}
    found = with_texts(Config(), texts).decode.score_threshold
    assert found == (0.1, 0.2, 0.3, 0.4, 0.5)
    pairs = ((0.5, -1.0), (1.0, 0.0))
    for name, value in (("score_threshold", (0.1, 0.2)), ("calibration", pairs)):
        expected = f"config.decode.{name} is {value}, expected 5, one per class"
        with pytest.raises(UserError, match=re.escape(expected)):
            Config(decode=DecodeOptions(**{name: value}))
