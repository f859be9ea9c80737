"""`radejax train`, the door that train.py is too: configs by name, fields, messages."""

import json
import pathlib

import click
import pytest
from click.testing import CliRunner, Result

from radejax.cli import entry
from radejax.cli.main import main
from radejax.cli.train import train


def _train(*arguments: str) -> Result:
    return CliRunner().invoke(train, list(arguments), prog_name="train")


def test_the_script_is_the_command() -> None:
    text = pathlib.Path(__file__).parents[2].joinpath("train.py").read_text()
    assert "from radejax.cli.train import train" in text
    assert main.commands["train"] is train


def test_a_second_folder_without_its_flag_is_wrong_use(tmp_path: pathlib.Path) -> None:
    run = tmp_path / "run"
    ended = _train("--config=quickstart", f"--workdir={run}", "--data", "one", "two")
    assert ended.exit_code == entry.WRONG_USE
    assert "unexpected extra argument (two)" in ended.stderr
    assert not run.exists()


def test_processes_without_a_coordinator_are_wrong_use(tmp_path: pathlib.Path) -> None:
    run = tmp_path / "run"
    place = ["--num-processes=2", "--process-id=1"]
    ended = _train("--config=quickstart:short", f"--workdir={run}", *place)
    assert ended.exit_code == entry.WRONG_USE
    assert "give --coordinator HOST:PORT, --num-processes and" in ended.stderr
    assert not run.exists()


def test_train_takes_a_part_of_the_data(tmp_path: pathlib.Path) -> None:
    run = tmp_path / "run"
    arguments = ["--config=radenet", "--config.train.batch_size=8"]
    arguments += [f"--data={tmp_path}", f"--workdir={run}"]
    for words, message in (
        (["--sequences=1,x"], "'1,x', expected 1,5,58"),
        (["--weather=fog", "--weather=mist"], "config.data.weather is ('fog', 'mist')"),
        (["--sequences=1,58", "--weather=fog", "--weather=rain"], "no sequence"),
    ):
        ended = _train(*arguments, *words)
        assert ended.exit_code == entry.WRONG_USE
        assert message in ended.stderr
    config = json.loads((run / "config.json").read_text())
    assert config["data"]["sequences"] == [1, 58]
    assert config["data"]["weather"] == ["fog", "rain"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config.train.batchsize=4"], "did you mean config.train.batch_size?"),
        (
            ["--config.evaluation.roi=(0,1)"],
            "error: config.evaluation.roi is (0.0, 1.0), expected x0, x1, y0, y1, z0, z1",
        ),
        (["--config=radnet:official"], "did you mean radenet?"),
    ],
)
def test_near_misses_are_answered(arguments: list[str], message: str) -> None:
    ended = _train("--config=radenet", *arguments)
    assert ended.exit_code == entry.WRONG_USE
    assert message in ended.stderr
    assert "Traceback" not in ended.output


def test_fields_are_read_in_every_spelling() -> None:
    context = click.Context(train, **train.context_settings)
    words = ["--config=radenet", "--config.seed=1", "--config.seed=2", "--init-from=a"]
    train.parse_args(context, [*words, "--config.logging.wandb", "--weather=fog"])
    fields = context.meta["fields"]
    assert fields == {"seed": "2", "logging.wandb": "true"}
    assert context.params["init_from"] == "a"


def test_the_install_page_says_how_to_see_training_curves() -> None:
    """TensorBoard is not a dependency; runs are written below the folder that it names."""
    page = pathlib.Path(__file__).parents[2] / "docs" / "install.md"
    assert "`tensorboard --logdir runs` | `pip install tensorboard`" in page.read_text()
    (workdir,) = (param for param in train.params if param.name == "workdir")
    assert "Default: runs/" in workdir.help
