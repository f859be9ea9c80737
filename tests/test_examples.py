"""The scripts of `examples/`, on data of their own making."""

import json
import os
import pathlib
import subprocess

import numpy as np
import pytest

from radejax.core.config import load_module
from radejax.data.encoding import decode
from radejax.data.kradar import KRadar
from radejax.data.records.job import project_dataset
from radejax.data.records.projections import RecordSource
from radejax.simulation.baseline import detect
from radejax.simulation.dataset import default_config, simulate_dataset

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A small data set without images, projected."""
    root = tmp_path_factory.mktemp("data")
    config = default_config() | {
        "train_sequences": 2,
        "test_sequences": 1,
        "frames_per_sequence": 8,
        "image_width": 0,
        "output": "projection",
    }
    simulate_dataset(config, root, progress=False)
    project_dataset(KRadar(root), root / "records", num_workers=0, progress=False)
    return root


def load(name: str):
    return load_module(EXAMPLES / f"{name}.py")


def test_cfar_baseline_fits_detects_and_reports(data, tmp_path, capsys):
    module = load("cfar_baseline")
    report = module.run_baseline(data, tmp_path, protocols=("exact",))
    assert "Sedan from" in capsys.readouterr().out
    assert (tmp_path / "report.txt").read_text() == report.text
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    sedan = next(r for r in metrics["ap"] if r["cls"] == "Sedan" and r["kind"] == "all")
    assert sedan["num_det"] > 0
    assert 0.0 < sedan["ap"] < 95.0

    # Fitted on training frames; each frame's predictions are those of the detector.
    records = RecordSource(data / "records")
    settings = module.fit(records, KRadar(data, split="train"))
    levels = [least for _, least in settings.rcs_steps]
    assert levels == sorted(levels, reverse=True)
    frames = KRadar(data, split="test")
    found = module.predict(records, frames, settings)
    last = len(frames) - 1
    projection = decode(records[records.index_of()[frames[last].key]]["projection"])
    expected = detect(projection, records.grid, module.PARAMETERS, settings)
    assert len(expected["score"]) > 0
    np.testing.assert_array_equal(found["box"][found["frame"] == last], expected["box"])


@pytest.mark.parametrize(
    ("status", "is_evaluated", "is_requeued"),
    [
        (0, True, False),
        (0, False, True),  # stopped while training
        (143, False, True),  # stopped while evaluating
        (143, True, True),  # ... and drawing
        (1, False, False),
        (2, True, False),
    ],
)
def test_a_slurm_job_goes_back_into_the_queue_where_it_was_stopped(
    status: int, is_evaluated: bool, is_requeued: bool, tmp_path: pathlib.Path
) -> None:
    programs = {
        "srun": f"#!/bin/sh\nexit {status}\n",
        "scontrol": f"#!/bin/sh\necho $* > {tmp_path}/requeued\n",
    }
    for name, text in programs.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    if is_evaluated:
        (tmp_path / "evaluation").mkdir()
        (tmp_path / "evaluation" / "metrics.json").touch()
    ended = subprocess.run(
        ["bash", EXAMPLES / "slurm.sh"],
        env={
            "PATH": f"{tmp_path}:{os.environ['PATH']}",
            "DATA": "d",
            "WORKDIR": str(tmp_path),
            "SLURM_JOB_ID": "7",
        },
    )
    assert ended.returncode == status
    assert (tmp_path / "requeued").exists() == is_requeued
    if is_requeued:
        assert (tmp_path / "requeued").read_text() == "requeue 7\n"
