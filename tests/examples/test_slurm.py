"""The job script requeues itself after a stop."""

import os
import pathlib
import subprocess

import pytest

SCRIPT = pathlib.Path(__file__).resolve().parents[2] / "examples" / "slurm.sh"


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
        ["bash", SCRIPT],
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
