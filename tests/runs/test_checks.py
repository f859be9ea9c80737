"""Every field of every section is checked before a run does anything."""

import dataclasses
import itertools
import json
import math
import pathlib
import re
from typing import Any

import pytest
from ml_collections import ConfigDict

from radejax import models
from radejax.core.config import base_config, fields_of, load_config, load_module
from radejax.core.errors import UserError
from radejax.models.lifting import LiftingAxes
from radejax.runs import experiment
from radejax.runs.checks import check
from radejax.training import distributed

from .. import small_models as small

CONFIGS = pathlib.Path(__file__).resolve().parents[2] / "configs"
NAN, INF = math.nan, math.inf

WRONG = [
    ("seed", 2**32 - 1),
    ("seed", True),
    ("classes", ()),
    ("classes", ("Sedan", "Sedan")),
    ("classes", ("Tank",)),
    ("model.name", "yolo"),
    ("model.num_classes", 4),
    ("model.widths", ()),
    ("model.widths", (32, 0)),
    ("model.decoder_width", 0),
    ("model.num_groups", 0),
    ("model.pad_multiple", 0),
    ("model.input_stem", "no"),
    ("model.cbam", False),
    ("model.doppler_bins", "64"),
    ("model.heatmap_prior", 1.0),
    ("model.input_center", NAN),
    ("model.input_scale", 0.0),
    ("loss.heatmap_sigma_mode", "adaptiv"),
    ("loss.heatmap_sigma_bins", 0.0),
    ("loss.gwd_tau", 0.0),
    ("loss.gwd_transform", "log"),
    ("loss.weights", {"focal": 1.0, "giou": 1.0}),
    ("loss.weights", {"focal": -1.0}),
    ("loss.weights", {}),
    ("decode.max_detections", 0),
    ("train.batch_size", 0),
    ("train.num_epochs", 0),
    ("train.max_steps", 0),
    ("train.max_steps", 1.5),
    ("train.learning_rate", 0.0),
    ("train.final_learning_rate", 1.0),
    ("train.gradient_clip_norm", 0.0),
    ("train.ema_decay", 1.0),
    ("train.schedule", "step"),
    ("train.gradient_accumulation_steps", 0),
    ("train.log_every_steps", 0),
    ("train.checkpoint_every_steps", 0),
    ("train.checkpoints_to_keep", 0),
    ("train.parameter_sharding", "zero"),
    ("data.roots", ("",)),
    ("data.format", "nuscenes"),
    ("data.label_version", "v3"),
    ("data.visibility", ("X",)),
    ("data.validation", 0.1),
    ("data.validation", (1.0,)),
    ("data.validation", (0.1, 0.2)),
    ("data.validation", (5, 5)),
    ("data.max_objects", 0),
    ("data.mirror_probability", 1.5),
    ("evaluation.roi", (0, 1, 2)),
    ("evaluation.roi", (72.0, 0.0, -6.4, 6.4, -2.0, 6.0)),
    ("evaluation.protocols", ("nope",)),
    ("evaluation.protocols", ()),
    ("evaluation.empty_frames", None),
    ("evaluation.iou_thresholds", (2.0,)),
    ("evaluation.iou_thresholds", (0.3, NAN)),
    ("evaluation.batch_size", 0),
    ("logging.wandb", 1),
    ("logging.profile_steps", (5, 2)),
    ("simulation.output", "video"),
    ("simulation.camera_mode", "boxes"),
    ("simulation.radar_from_lidar_m", (0.0, 0.0)),
    ("model.image.num_heads", 0),
    ("model.image.size", (720,)),
    ("model.fusion.dropout", 1.0),
    ("model.query_grid.range_m", (0.0, NAN)),
    ("data.camera.projection", "fisheye"),
    ("data.camera.radar_from_lidar_m", (1.0, 2.0)),
]


def _with(field: str, value: Any) -> ConfigDict:
    """A good config, of types that a hand-written file may mix up, with one value."""
    config = load_config(str(CONFIGS / "quickstart_fusion.py"))
    with config.ignore_type():
        section, _, name = field.rpartition(".")
        place = config
        for part in filter(None, section.split(".")):
            place = place[part]
        with place.unlocked():
            place[name] = value
    return config


@pytest.mark.parametrize(("field", "value"), WRONG)
def test_an_impossible_value_is_named_with_what_is_expected(
    field: str, value: Any
) -> None:
    with pytest.raises(UserError, match=rf"config\.{re.escape(field)}\b") as raised:
        check(_with(field, value))
    assert "\n" not in str(raised.value)


def test_nothing_is_written_or_built_for_a_wrong_config(tmp_path: pathlib.Path) -> None:
    config = _with("evaluation.protocols", ("nope",))
    with pytest.raises(UserError, match=r"evaluation.protocols"):
        experiment.run_seeds(config, tmp_path / "run", (0, 1))
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_for_paths_that_do_not_exist(tmp_path: pathlib.Path) -> None:
    config = base_config()
    config.train.batch_size = 8
    config.data.roots = (str(tmp_path / "nope"),)
    with pytest.raises(FileNotFoundError, match=r"no such file or folder: .*nope"):
        experiment.run(config, tmp_path / "run")
    config.data.roots = (str(tmp_path),)
    with pytest.raises(FileNotFoundError, match=r"weights\.pth"):
        experiment.run(config, tmp_path / "run", init_from=tmp_path / "weights.pth")
    assert not list(tmp_path.iterdir())


def test_a_batch_that_does_not_divide_is_rejected_first(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = distributed.make_mesh(4)
    monkeypatch.setattr(distributed, "make_mesh", lambda *_: mesh)
    with pytest.raises(
        UserError, match=r"batch_size is 2, expected a multiple of 4 devices"
    ):
        experiment.run(_with("train.batch_size", 2), tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_fields_that_are_missing_or_unknown() -> None:
    config = _with("train.num_epoch", 3)
    with pytest.raises(UserError, match=r"num_epoch is not .* config.train.num_epochs"):
        check(config)
    config = base_config()
    del config.train["num_epochs"]
    with pytest.raises(UserError, match=r"config.train.num_epochs is missing"):
        check(config)


FIELDS = dict(fields_of(load_config("quickstart_fusion")))
ANY_NUMBER = ("input_center", "radar_from_lidar_z_m", "layer_scale")


@pytest.mark.parametrize("field", FIELDS)
def test_a_value_of_a_wrong_type_or_range_is_one_line_that_names_the_field(
    field: str,
) -> None:
    kind = FIELDS[field]
    # A section is the type of no field.
    wrong: list[Any] = [{"a": 1}, 2.5 if kind is int else 1 if kind is str else "many"]
    if kind in (int, float) and field.rpartition(".")[2] not in ANY_NUMBER:
        wrong += [-1] if kind is int else [-1.0, NAN, INF]
    named = re.escape(re.sub(r"weights\..*", "weights", field))
    for value in wrong:
        with pytest.raises(UserError, match=rf"config\.{named}\b") as raised:
            check(_with(field, value))
        assert "\n" not in str(raised.value)


def test_what_one_field_asks_of_another() -> None:
    config = _with("train.best_metric", "map_3d_iou70")
    check(config)  # no validation, no best one
    config.train.evaluate_every_epochs = 1
    with pytest.raises(UserError, match=r"one of .*map_bev_iou30"):
        check(config)
    with pytest.raises(UserError, match="doppler_bins is 64, expected 16"):
        check(_with("model.doppler_bins", 64))


def test_axes_are_given_as_tuples_of_bin_centers() -> None:
    grid, config = small.uneven_grid(), load_config("quickstart_fusion").unlock()
    config.simulation.grid = grid.to_dict()
    axes = LiftingAxes.of_grid(grid)
    config.model.query_grid.update(range_m=axes.range_m, azimuth_deg=axes.azimuth_deg)
    with pytest.raises(UserError, match="doppler_bins is 16, expected 4, as"):
        check(config)
    config.model.update(doppler_bins=4, elevation_bins=0)
    config.model.fusion.weighting = "off"
    check(config)
    saved = ConfigDict(json.loads(config.to_json()))
    check(saved)
    built = models.build(saved.model).query_grid
    assert built == dataclasses.replace(
        axes, elevation_deg=(-6.0, 6.0), num_elevation=4
    )


def _words(name: str) -> list[str]:
    module = load_module(CONFIGS / f"{name}.py")
    if name.startswith("quickstart"):
        words = ["radar", "radar,short", "silhouettes", "silhouettes,short"]
        return ["", "short"] + words * name.endswith("fusion")
    groups = [
        ["", *getattr(module, names, ())]
        for names in ("VARIANTS", "PRESETS", "CLASS_SETS")
    ]
    return [",".join(filter(None, words)) for words in itertools.product(*groups)]


@pytest.mark.parametrize("name", sorted(path.stem for path in CONFIGS.glob("*.py")))
def test_every_preset_passes(name: str) -> None:
    choices = _words(name)
    for words in choices:
        check(load_config(f"{CONFIGS / name}.py:{words}"))
    check(base_config())
    if name in ("radenet", "dinorade"):
        assert len(choices) > 40  # every row in both worlds
