"""The job script gives srun its resources, and is queued again only after a stop."""

import os
import pathlib
import re
import signal
import subprocess
import time

import pytest

from radejax.cli.train import train

SCRIPT = pathlib.Path(__file__).resolve().parents[2] / "examples" / "slurm.sh"
DIRECTIVES = dict(re.findall(r"(?m)^#SBATCH --([\w-]+)=(.*)$", SCRIPT.read_text()))
# Writes its arguments. It ends with `first`, or after SIGTERM with `second`.
SRUN = """#!/bin/bash
printf '%s\\n' "$@" > {folder}/arguments
trap 'exit {second}' TERM
echo $$ > {folder}/pid
[ {first} = waits ] || exit {first}
while :; do sleep 0.05; done
"""
SCANCEL = """#!/bin/bash
echo "$@" >> {folder}/scancel
kill -TERM "$(cat {folder}/pid)"
"""
SCONTROL = """#!/bin/bash
echo "$@" >> {folder}/scontrol
"""


def _start(folder, first="waits", second=0, arguments=(), **variables):
    (folder / "bin").mkdir()
    (folder / "scontrol").touch()
    for name, text in (("srun", SRUN), ("scancel", SCANCEL), ("scontrol", SCONTROL)):
        path = folder / "bin" / name
        path.write_text(text.format(folder=folder, first=first, second=second))
        path.chmod(0o755)
    return subprocess.Popen(
        ["bash", SCRIPT, *arguments],
        env={
            "PATH": f"{folder}/bin:{os.environ['PATH']}",
            "DATA": "/disk1,/disk2",
            "WORKDIR": str(folder / "run"),
            "SLURM_JOB_ID": "7",
            "SLURM_CPUS_PER_TASK": DIRECTIVES["cpus-per-task"],
            **variables,
        },
    )


@pytest.mark.parametrize(
    ("status", "is_requeued"), [(0, True), (143, True), (1, False)]
)
def test_a_job_at_its_time_limit_stops_and_is_queued_again(
    status, is_requeued, tmp_path
):
    process = _start(tmp_path, second=status)
    while not (tmp_path / "pid").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGUSR1)
    assert process.wait(timeout=20) == status
    assert (tmp_path / "scancel").read_text() == "--signal=TERM 7\n"
    assert (tmp_path / "scontrol").read_text() == "requeue 7\n" * is_requeued


def test_srun_starts_the_preset_with_all_resources(tmp_path):
    extra = ["--seeds", "0,1,2", "--config.train.max_steps=100"]
    process = _start(tmp_path, first=0, arguments=extra, CONFIG="dinorade:rc")
    assert process.wait(timeout=20) == 0
    words = (tmp_path / "arguments").read_text().splitlines()
    assert f"--cpus-per-task={DIRECTIVES['cpus-per-task']}" in words
    start = words.index("radejax")
    assert words[start : start + 2] == ["radejax", "train"]
    context = train.make_context("train", words[start + 2 :], resilient_parsing=True)
    assert context.params["config"] == "dinorade:rc"
    assert context.params["roots"] == ("/disk1", "/disk2")
    assert context.params["records"] == "/disk1/records"
    assert context.params["seeds"] == (0, 1, 2)
    assert context.params["fields"] == {"train.max_steps": "100"}
