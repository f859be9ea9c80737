"""`radejax train`, which train.py also runs: configs by name, fields, messages."""

import json

import click
import pytest
from matplotlib.figure import Figure

from radejax.cli.train import train

from ..commands import run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "one", "two"], "unexpected extra argument (two)"),
        (["--num-processes=2", "--process-id=1"], "give --coordinator HOST:PORT,"),
        (["--sequences=1,x"], "'1,x', expected 1,5,58"),
        (["--weather=fog", "--weather=mist"], "config.data.weather is ('fog', 'mist')"),
        (["--config.train.batchsize=4"], "did you mean config.train.batch_size?"),
        (
            ["--config.evaluation.roi=(0,1)"],
            "error: config.evaluation.roi is (0.0, 1.0)",
        ),
        (["--config=radnet:official"], "did you mean radenet?"),
    ],
)
def test_wrong_use_is_one_line_and_writes_nothing(arguments, message, tmp_path):
    words = ["--config=quickstart:short", f"--workdir={tmp_path / 'run'}", *arguments]
    assert message in run("train", *words, code=2).stderr
    assert not any(tmp_path.iterdir())


def test_samples_are_drawn_instead_of_training(tmp_path, monkeypatch):
    asked = []

    def draw(config):
        asked.append(config)
        return Figure()

    monkeypatch.setattr("radejax.runs.figures.draw_training_samples", draw)
    words = ["train", "--config=quickstart:short", f"--workdir={tmp_path / 'run'}"]
    words.append("--config.data.mirror_probability=1.0")
    ended = run(*words, f"--draw-samples={tmp_path / 'samples.txt'}", code=2)
    assert "cannot write a figure as 'samples.txt'" in ended.stderr
    assert not asked
    run(*words, f"--draw-samples={tmp_path / 'samples.png'}")
    assert asked[0].data.mirror_probability == 1.0
    assert (tmp_path / "samples.png").is_file()
    assert not (tmp_path / "run").exists()


def test_train_takes_a_part_of_the_data(tmp_path):
    words = ["--config=radenet", "--config.train.batch_size=8", f"--data={tmp_path}"]
    words += [f"--workdir={tmp_path / 'run'}", "--sequences=1,58"]
    words += ["--weather=fog", "--weather=rain"]
    assert "no sequence" in run("train", *words, code=2).stderr
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["data"]["sequences"] == [1, 58]
    assert config["data"]["weather"] == ["fog", "rain"]


def test_fields_are_read_in_every_spelling():
    context = click.Context(train, **train.context_settings)
    words = ["--config=radenet", "--config.seed=1", "--config.seed=2", "--init-from=a"]
    train.parse_args(context, [*words, "--config.logging.wandb", "--weather=fog"])
    fields = context.params["fields"]
    assert fields == {"seed": "2", "logging.wandb": "true"}
    assert context.params["init_from"] == "a"
