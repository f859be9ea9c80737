"""Tests of training on simulated frames without a dataset."""

import jax
import numpy as np
import online_training
import pytest
from click.testing import CliRunner
from online_training import train_online

from radejax import Detector
from radejax.config import load_config
from radejax.training.checkpoints import Checkpoints

from .. import small_models as small


def _config():
    every_step = {"log_every_steps": 1, "checkpoint_every_steps": 1}
    return small.shrink_run(load_config("quickstart:short")).replace(
        simulation={"frames_per_sequence": 2},
        train={"batch_size": 2, "num_epochs": 2} | every_step,
    )


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_training_resumes_with_identical_results(tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    result = train_online(_config(), whole, num_sequences=2)
    assert result.step == 4  # 4 frames per epoch
    # Stops after the first checkpoint as if killed, then resumes.
    saved = []

    save = Checkpoints.save

    def stop(self, step, *args, **options):
        save(self, step, *args, **options)
        saved.append(step)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", stop)
        with pytest.raises(KeyboardInterrupt):
            train_online(_config(), parts, num_sequences=2)
    assert saved == [1]
    monkeypatch.setattr(online_training, "load_config", lambda _: _config())
    options = ["--config", "small", "--workdir", str(parts), "--sequences", "2"]
    resumed = CliRunner().invoke(online_training.main, options, catch_exceptions=False)
    assert "4 steps" in resumed.output
    expected = Detector.from_workdir(whole / "checkpoints")
    found = Detector.from_workdir(parts / "checkpoints")
    jax.tree.map(np.testing.assert_array_equal, found.variables, expected.variables)
