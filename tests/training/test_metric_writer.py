"""Logs that agree with the step a run starts from."""

import json
import math
import pathlib
import sys
from unittest import mock

import pytest
from matplotlib.figure import Figure

from radejax.config import Config
from radejax.core import devices
from radejax.core.errors import DiskFullError, UserError
from radejax.training.metric_writer import MetricWriter


def _steps(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["step"] for line in lines]


def _writer(folder, start, **logging):
    return MetricWriter(folder, Config().replace(logging=logging), start)


def test_records_after_the_restored_step_are_written_anew(tmp_path):
    with _writer(tmp_path, 0) as writer:
        for step in (2, 4, 6):
            writer.write(step, {"focal": float(step)})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 8, "foc')  # killed while writing
    with _writer(tmp_path, 4) as writer:
        assert _steps(tmp_path) == [2, 4]
        writer.write(6, {"focal": 60.0, "gwd": math.nan})
    assert _steps(tmp_path) == [2, 4, 6]
    last = (tmp_path / "metrics.jsonl").read_text().splitlines()[-1]
    assert last.endswith(', "focal": 60.0, "gwd": null}')  # NaN is not JSON
    assert 0 <= json.loads(last)["minutes"] < 1


def test_other_processes_write_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "is_main", lambda: False)
    with _writer(tmp_path, 0) as writer:
        writer.write(1, {"focal": 1.0})
    assert not list(tmp_path.iterdir())


FULL = pathlib.Path("/dev/full")  # every write to it is "no space left"
needs_full = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")


@needs_full
def test_metrics_on_a_full_disk_are_one_clear_error(tmp_path):
    with _writer(tmp_path, 0) as writer:
        (tmp_path / "metrics.jsonl").symlink_to(FULL)
        with pytest.raises(DiskFullError, match="no space left"):
            writer.write(1, {"focal": 1.0})


def test_weights_and_biases_copies_tensorboard_and_gets_the_config(
    tmp_path, monkeypatch
):
    fake = mock.Mock()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for start in (0, 2):  # the second time, the same run goes on
        with _writer(tmp_path, start, wandb=True, wandb_project="p") as writer:
            writer.write(start + 1, {"focal": 2.5})
            writer.write(start + 2, {"ap/exact": 7.0}, {"frame": Figure()})
    first, second = (call.kwargs for call in fake.init.call_args_list)
    assert first == second
    assert first["sync_tensorboard"]
    assert first["project"] == "p"
    assert first["config"]["train"]["batch_size"] == Config().train.batch_size
    assert fake.init.return_value.finish.call_count == 2
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"wandb is not installed: pip install"):
        _writer(tmp_path, 0, wandb=True)
