"""Configs: words, presets, the rows of the papers' tables; every one can be built."""

import pathlib
from typing import Any

import jax
import pytest
from ml_collections.config_flags import config_path

from radejax import models
from radejax.core.config import (
    base_config,
    config_file,
    config_name,
    find_part,
    load_config,
    load_module,
    override,
    parse_options,
)
from radejax.core.errors import UserError

CONFIGS = pathlib.Path(__file__).resolve().parents[2] / "configs"
RADENET = ("base", "cbam", "cbam_heads", "model", "no_cbam", "stem", "expand")


def _get(name: str, words: str | None = None) -> Any:
    return load_module(CONFIGS / f"{name}.py").get_config(words)


def _fields(config: Any) -> set[str]:
    flat = config.to_dict()
    return {f"{s}.{f}" for s, v in flat.items() if isinstance(v, dict) for f in v}


def test_parts_are_known_or_imported_and_of_one_kind() -> None:
    known = {"floats": float}
    assert find_part("floats", "config.x", known, float) is float
    assert (
        find_part("pathlib:Path", "config.x", known, pathlib.PurePath) is pathlib.Path
    )
    assert find_part("math:pi", "config.x", {}, float) > 3
    for name, message in (
        ("floats:", r"is 'floats:', expected 'floats' or module:Object"),
        (":Path", r"is ':Path', expected 'floats' or module:Object"),
        (None, r"is None, expected 'floats' or module:Object"),
        (
            "pathlib:Paths",
            "no attribute 'Paths'; run this in the folder of pathlib",
        ),
        ("no.such:Thing", "No module named 'no'"),
        ("pathlib:Path", "is 'pathlib:Path', expected the name of a float"),
    ):
        with pytest.raises(UserError, match=rf"^config\.x .*{message}"):
            find_part(name, "config.x", known, float)


@pytest.mark.parametrize(
    "words", [*RADENET, "paper", "official", "official,sedan,stem"]
)
def test_every_radenet_config_builds_and_has_the_same_fields(words: str) -> None:
    config = _get("radenet", words)
    assert _fields(config) == _fields(base_config())
    model = models.build(config.model)
    assert model.num_classes == len(config.classes)


def test_parameters_of_the_papers_model() -> None:
    model = models.build(_get("radenet").model)
    projection = jax.ShapeDtypeStruct((1, 256, 107, 101), "float32")
    shapes = jax.eval_shape(model.init, jax.random.key(0), projection)
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 28_336_878


def test_the_base_row_has_no_attention_in_either_world() -> None:
    for preset in ("paper", "official"):
        assert _get("radenet", f"base,{preset}").model.cbam == "off"


def test_the_quickstart_fits_its_own_sensor() -> None:
    config = _get("quickstart")
    grid = config.simulation.grid
    assert config.model.doppler_bins == grid.num_doppler
    assert config.model.elevation_bins == grid.num_elevation
    assert _fields(config) >= _fields(base_config())


@pytest.mark.parametrize("words", ["r", "rc", "rcw", "rcw_resnet50", "official"])
def test_every_dinorade_config_builds(words: str) -> None:
    config = _get("dinorade", words)
    models.build(config.model)
    assert config.loss.heatmap_sigma_bins == (3.0 if words == "official" else 0.75)


def test_contradictory_options_are_rejected() -> None:
    with pytest.raises(UserError, match="'base' and 'stem' exclude each other"):
        _get("radenet", "base,stem")
    with pytest.raises(UserError, match=r"unknown config option 'big'; available"):
        _get("radenet", "big")
    assert parse_options("b, a", ("a",), ("b", "c")) == ["a", "b"]
    assert parse_options(None, ("a",)) == [None]


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
        ("data.visibility", "none", None),
        ("model.cbam", "off", "off"),
        ("model.input_stem", "true", True),
        ("evaluation.iou_thresholds", "0.5", (0.5,)),
        ("loss.weights.focal", "3", 3.0),
        ("logging.wandb_project", "123", "123"),
    ],
)
def test_a_text_becomes_the_value_of_a_field(
    name: str, text: str, expected: Any
) -> None:
    config = base_config()
    override(config, {name: text})
    found = config_path.get_value(name, config)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("train.batch_size", "many", "is 'many', expected a value of type int"),
        ("train.batch_size", "2.5", "is '2.5', expected a value of type int"),
        ("train.batch_size", "true", "is 'true', expected a value of type int"),
        ("model.input_stem", "1", "is '1', expected a value of type bool"),
        ("train", "1", "config.train is not a field of this config"),
        ("train.batchsize", "1", "did you mean config.train.batch_size?"),
        ("train.learning_rate", "((((" * 300, "expected a value of type float"),
    ],
)
def test_other_texts_are_rejected_by_name(name: str, text: str, message: str) -> None:
    with pytest.raises(UserError) as refused:
        override(base_config(), {name: text})
    assert message in str(refused.value)


def test_configs_that_come_along_are_those_of_the_repository() -> None:
    for path in CONFIGS.glob("*.py"):
        found = config_file(path.stem)
        assert "radejax" in found.parent.parent.name
        assert found.samefile(path)
    assert load_config("radenet:sedan").classes == ("Sedan",)


def test_a_file_that_is_no_config_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "mine.py").write_text("x = 1\n")
    with pytest.raises(UserError, match=r"mine\.py has no function get_config"):
        load_config(f"{tmp_path / 'mine.py'}:word")
    for name in (str(tmp_path / "radenet"), "configs_of_mine/radnet.py"):
        with pytest.raises(UserError, match=r"no such .* a \.py file.*mean radenet\?"):
            load_config(name)
