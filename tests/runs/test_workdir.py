"""What a work folder keeps of a run, and weights taken from another."""

import json
import pathlib
import subprocess
import sys

import pytest

from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.runs import experiment


def test_a_work_folder_keeps_its_config(tmp_path: pathlib.Path) -> None:
    config = base_config()
    for _ in range(2):
        with experiment.claimed(tmp_path / "run", config):
            kept = json.loads((tmp_path / "run" / "config.json").read_text())
            assert kept == json.loads(config.to_json())


def test_another_config_is_refused_and_the_difference_named(
    tmp_path: pathlib.Path,
) -> None:
    config = base_config()
    with experiment.claimed(tmp_path, config):
        pass
    config.train.num_epochs = 7  # nothing is trained: the folder takes it
    with experiment.claimed(tmp_path, config):
        kept = json.loads((tmp_path / "config.json").read_text())
        assert kept["train"]["num_epochs"] == 7
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    config.train.batch_size = 3
    config.seed = 5
    with (
        pytest.raises(
            UserError,
            match=r"config\.seed is 0 there and 5 here; "
            r"config\.train\.batch_size is 10 there and 3 here.*--workdir",
        ),
        experiment.claimed(tmp_path, config),
    ):
        pass


def test_a_second_training_in_a_work_folder_is_refused(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "run"
    with (
        experiment.claimed(folder, base_config()),
        pytest.raises(UserError, match=r"another training is at work in .*run: wait"),
        experiment.claimed(folder, base_config()),
    ):
        pass
    with experiment.claimed(folder, base_config()):  # let go, though the file is there
        pass


def test_a_killed_training_lets_go_of_its_work_folder(tmp_path: pathlib.Path) -> None:
    code = (
        "import sys, fcntl, time\n"
        "file = open(sys.argv[1], 'w')\n"
        "fcntl.flock(file, fcntl.LOCK_EX)\n"
        "print('held', flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "lock")], stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(UserError), experiment.claimed(tmp_path, base_config()):
            pass
        other.kill()
        other.wait()
        with experiment.claimed(tmp_path, base_config()):
            pass


def test_what_a_run_started_from_is_kept(tmp_path: pathlib.Path) -> None:
    info = experiment.run_info(tmp_path, str(tmp_path / "model.pth"))
    assert info["init_from"] == str(tmp_path / "model.pth")
    (tmp_path / "run.json").write_text(json.dumps(info))
    again = experiment.run_info(tmp_path)
    assert again["init_from"] == info["init_from"]
