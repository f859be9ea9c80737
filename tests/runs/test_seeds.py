"""Several seeds in one command: who runs, and mean and spread."""

import json
import pathlib
from typing import Any

import click.testing
import pytest

from radejax.cli.train import train
from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.runs import experiment

HEAD = "protocol,condition,cls,space,iou,ap,num_gt\n"


def test_every_seed_runs_in_its_folder_and_the_spread_is_reported(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aps = {0: 50.0, 1: 53.0, 2: 59.0}
    seen = []

    def run(config: Any, *, workdir: Any, **options: Any) -> pathlib.Path:
        seen.append((config.seed, pathlib.Path(workdir).name, options["init_from"]))
        folder = pathlib.Path(workdir) / "evaluation"
        folder.mkdir(parents=True)
        (folder / "metrics.csv").write_text(
            HEAD
            + f"all_point,all,Sedan,3d,0.3,{aps[config.seed]},10\n"
            + "all_point,all,Bicycle,3d,0.3,,0\n"
            + f"all_point,rain,Sedan,3d,0.3,{config.seed},3\n"
        )
        return pathlib.Path(workdir)

    monkeypatch.setattr(experiment, "run", run)
    config = base_config()
    experiment.run_seeds(
        config, range(3), name="x", workdir=tmp_path / "runs", init_from="w"
    )
    assert seen == [(i, f"seed{i}", "w") for i in range(3)]
    rows = json.loads((tmp_path / "runs" / "seeds.json").read_text())
    assert [row["cls"] for row in rows] == ["Sedan", "Sedan"]
    assert rows[0]["mean"] == pytest.approx(54.0)
    assert rows[0]["std"] == pytest.approx(21**0.5)  # (16 + 1 + 25) / 2
    assert rows[0]["values"] == {"0": 50.0, "1": 53.0, "2": 59.0}
    text = (tmp_path / "runs" / "seeds.txt").read_text()
    assert "54.00" in text
    assert "4.58" in text
    assert "rain" not in text


def test_a_seed_twice_is_refused() -> None:
    with pytest.raises(UserError, match=r"--seeds is \(1, 2, 1\), expected different"):
        experiment.run_seeds(base_config(), (1, 2, 1), name="x")


def test_train_takes_several_seeds(tmp_path: pathlib.Path) -> None:
    arguments = ["--config=quickstart:short", "--seeds=1,2,1"]
    done = click.testing.CliRunner().invoke(
        train, [*arguments, f"--workdir={tmp_path / 'run'}"]
    )
    assert done.exit_code == 2
    assert done.stderr.startswith(
        "error: --seeds is (1, 2, 1), expected different seeds"
    )
    assert done.stderr.count("\n") == 1
