"""`radejax train`, which train.py also runs: configs by name, fields, messages."""

import json

import click
import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

from radejax.cli import entry
from radejax.cli.train import train


def _train(*arguments):
    return CliRunner().invoke(train, list(arguments), prog_name="train")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "one", "two"], "unexpected extra argument (two)"),
        (
            ["--num-processes=2", "--process-id=1"],
            "give --coordinator HOST:PORT, --num-processes and",
        ),
        (["--sequences=1,x"], "'1,x', expected 1,5,58"),
        (["--weather=fog", "--weather=mist"], "config.data.weather is ('fog', 'mist')"),
        (["--config.train.batchsize=4"], "did you mean config.train.batch_size?"),
        (
            ["--config.evaluation.roi=(0,1)"],
            "error: config.evaluation.roi is (0.0, 1.0), expected x0, x1, y0, y1, z0, z1",
        ),
        (["--config=radnet:official"], "did you mean radenet?"),
    ],
)
def test_wrong_use_is_one_line_and_writes_nothing(arguments, message, tmp_path):
    run = tmp_path / "run"
    ended = _train("--config=quickstart:short", f"--workdir={run}", *arguments)
    assert ended.exit_code == entry.WRONG_USE
    assert message in ended.stderr
    assert "Traceback" not in ended.output
    assert not run.exists()


def test_samples_are_drawn_instead_of_training(tmp_path, monkeypatch):
    asked = []

    def draw(config):
        asked.append(config)
        return Figure()

    monkeypatch.setattr("radejax.runs.figures.draw_training_samples", draw)
    words = ["--config=quickstart:short", f"--workdir={tmp_path / 'run'}"]
    words.append("--config.data.mirror_probability=1.0")
    ended = _train(*words, f"--draw-samples={tmp_path / 'samples.txt'}")
    assert ended.exit_code == entry.WRONG_USE
    assert "cannot write a figure as 'samples.txt'" in ended.stderr
    assert not asked
    ended = _train(*words, f"--draw-samples={tmp_path / 'samples.png'}")
    assert ended.exit_code == 0, ended.output
    assert asked[0].data.mirror_probability == 1.0
    assert (tmp_path / "samples.png").is_file()
    assert not (tmp_path / "run").exists()


def test_train_takes_a_part_of_the_data(tmp_path):
    run = tmp_path / "run"
    arguments = ["--config=radenet", "--config.train.batch_size=8"]
    arguments += [f"--data={tmp_path}", f"--workdir={run}", "--sequences=1,58"]
    ended = _train(*arguments, "--weather=fog", "--weather=rain")
    assert ended.exit_code == entry.WRONG_USE
    assert "no sequence" in ended.stderr
    config = json.loads((run / "config.json").read_text())
    assert config["data"]["sequences"] == [1, 58]
    assert config["data"]["weather"] == ["fog", "rain"]


def test_fields_are_read_in_every_spelling():
    context = click.Context(train, **train.context_settings)
    words = ["--config=radenet", "--config.seed=1", "--config.seed=2", "--init-from=a"]
    train.parse_args(context, [*words, "--config.logging.wandb", "--weather=fog"])
    fields = context.params["fields"]
    assert fields == {"seed": "2", "logging.wandb": "true"}
    assert context.params["init_from"] == "a"
