"""Work folders, names and messages of whole runs."""

import pathlib

import pytest

from radejax import experiment
from radejax.config import base_config
from radejax.errors import UserError


def test_names_of_runs() -> None:
    assert experiment.config_name("configs/quickstart.py") == "quickstart"
    assert experiment.config_name("a/b/radenet.py:stem,sedan") == "radenet-stem-sedan"


def test_without_data_and_simulation_the_flag_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match=r"give --data ROOT"):
        experiment.prepare_data(base_config(), data=None, labels=None, records=None)


def test_a_missing_data_folder_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*nowhere"):
        experiment.prepare_data(
            base_config(), data=[str(tmp_path / "nowhere")], labels=None, records=None
        )
