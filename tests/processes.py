"""Processes of one run, all of them on this machine."""

import os
import pathlib
import socket
import subprocess
import sys

REPOSITORY = pathlib.Path(__file__).resolve().parents[1]

# The start of a script that `start` can run.
JOIN = """
import sys

from radejax.cli.train import join_processes
from radejax.core import devices

coordinator, count, index = (word.partition("=")[2] for word in sys.argv[-3:])
index = int(index)
join_processes(coordinator, int(count), index)
"""


def start(count: int, *command: str, num_devices: int = 1) -> list[subprocess.Popen]:
    """Start a Python program in several processes, whose last arguments are their places.

    Standard output and errors of each are in its `stdout`.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    run = [f"--coordinator={coordinator}", f"--num-processes={count}"]
    places = [[*run, f"--process-id={i}"] for i in range(count)] if count > 1 else [[]]
    environment = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(num_devices)}
    return [
        subprocess.Popen(
            [sys.executable, *command, *place],
            cwd=REPOSITORY,
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for place in places
    ]


def outputs_of(started: list[subprocess.Popen], timeout_s: float) -> list[str]:
    """Wait until all processes have ended, and return their outputs."""
    try:
        return [process.communicate(timeout=timeout_s)[0] for process in started]
    finally:
        for process in started:
            process.kill()


def wait_for(word: str, started: list[subprocess.Popen]) -> None:
    """Read the output of all processes up to the first line that contains a word."""
    for process in started:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if word in line:
                break
        else:
            raise AssertionError("".join(lines))


def lost(index: int) -> str:
    """The line with which the others end when a process is killed."""
    name = f"process {index} ({socket.gethostname()})"
    return f"error: {name} was lost; start all processes again to continue"
