"""Fields of a config as text: what the field takes decides what the text means."""

from typing import Any

import pytest

from radejax.core.config import base_config, load_config
from radejax.core.errors import UserError
from radejax.runs import check_config
from radejax.runs.override import override


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("seed", "3", 3),
        ("train.learning_rate", "1e-4", 1e-4),
        ("train.learning_rate", "1", 1.0),
        ("train.ema_decay", "0.99", 0.99),
        ("train.ema_decay", "None", None),
        ("data.label_permutation_seed", "7", 7),
        ("data.label_version", "2.1", "2.1"),
        ("data.weather", "fog", ("fog",)),
        ("data.weather", "fog, rain", ("fog", "rain")),
        ("data.weather", "('fog', 'rain')", ("fog", "rain")),
        ("data.sequences", "[1, 58]", (1, 58)),
        ("data.visibility", "none", None),
        ("model.cbam", "off", "off"),
        ("model.input_stem", "true", True),
        ("model.input_stem", "False", False),
        ("evaluation.iou_thresholds", "0.5", (0.5,)),
        ("evaluation.protocols", "all_point,coco101", ("all_point", "coco101")),
        ("logging.wandb_project", "123", "123"),
    ],
)
def test_a_text_becomes_what_the_field_takes(
    name: str, text: str, expected: Any
) -> None:
    config = base_config()
    override(config, {name: text})
    found = config.to_dict()
    for key in name.split("."):
        found = found[key]
    assert found == expected
    assert type(found) is type(expected)
    check_config.check(config)


def test_fields_inside_of_a_field_keep_their_type() -> None:
    config = load_config("quickstart")
    name = next(iter(config.simulation.radar))
    override(config, {f"simulation.radar.{name}": "1"})
    assert config.simulation.radar[name] == 1
    assert isinstance(config.simulation.radar[name], float)
    with pytest.raises(UserError, match=f"radar.{name} is 'x', expected a value like"):
        override(config, {f"simulation.radar.{name}": "x"})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "loss.heatmap_sigma_mode",
            "foo",
            "config.loss.heatmap_sigma_mode is 'foo', expected one of 'fixed'",
        ),
        ("train.batch_size", "many", "is 'many', expected an integer of at least 1"),
        ("train.batch_size", "1.5", "is '1.5', expected an integer of at least 1"),
        ("model.input_stem", "1", "is '1', expected True or False"),
        ("train", "1", "config.train is not a field of this config"),
        ("train.batchsize", "1", "did you mean config.train.batch_size?"),
        ("train.learning_rate", "((((" * 300, "expected a number above 0"),
    ],
)
def test_other_texts_are_refused_by_name(name: str, text: str, message: str) -> None:
    with pytest.raises(UserError) as refused:
        override(base_config(), {name: text})
    assert message in str(refused.value)
