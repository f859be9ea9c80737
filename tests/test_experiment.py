"""Work folders, names and messages of whole runs."""

import json
import pathlib

import pytest

from radejax import experiment
from radejax.config import base_config
from radejax.errors import UserError


def test_names_of_runs() -> None:
    assert experiment.config_name("configs/quickstart.py") == "quickstart"
    assert experiment.config_name("a/b/radenet.py:stem,sedan") == "radenet-stem-sedan"


def test_a_work_folder_keeps_its_config(tmp_path: pathlib.Path) -> None:
    config = base_config()
    experiment.claim_workdir(tmp_path / "run", config)
    experiment.claim_workdir(tmp_path / "run", config)
    loaded = experiment.load_config(tmp_path / "run")
    assert json.loads(loaded.to_json()) == json.loads(config.to_json())


def test_another_config_is_refused_and_the_difference_named(
    tmp_path: pathlib.Path,
) -> None:
    config = base_config()
    experiment.claim_workdir(tmp_path, config)
    config.train.batch_size = 3
    config.seed = 5
    with pytest.raises(
        UserError,
        match=r"config\.seed is 0 there and 5 here; "
        r"config\.train\.batch_size is 10 there and 3 here.*--workdir",
    ):
        experiment.claim_workdir(tmp_path, config)


def test_without_data_and_simulation_the_flag_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match=r"give --data ROOT"):
        experiment.prepare_data(base_config(), data=None, labels=None, records=None)


def test_a_missing_data_folder_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*nowhere"):
        experiment.prepare_data(
            base_config(), data=[str(tmp_path / "nowhere")], labels=None, records=None
        )


def test_no_run_in_a_folder(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no run in .*config\.json is missing"):
        experiment.load_run(tmp_path)
