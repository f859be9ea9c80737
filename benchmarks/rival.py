"""PyTorch networks in a second process, for interleaved comparison.

While one process computes, the other one waits, so that their threads do not compete. The code of
the second process is `torch_half.py`.
"""

import functools
import importlib.util
import multiprocessing.connection
import os
import pathlib
import subprocess
import sys

ATTENTION = 128, 4, 4
"""Channels, heads and points of DinoRADE's deformable attention."""


class Rival:
    """PyTorch in another process, whose `columns` are measured next to radejax.

    Args:
        device: "cpu" or "cuda". `is_there` is False if PyTorch does not find it.
    """

    def __init__(self, device):
        key = os.urandom(16)
        with multiprocessing.connection.Listener(authkey=key) as listener:
            code = "import sys, torch_half; torch_half.serve(*sys.argv[1:])"
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, listener.address, key.hex(), device],
                cwd=pathlib.Path(__file__).parent,
            )
            self._connection = listener.accept()
        self.is_there = self._connection.recv()

    def ask(self, *message):
        """Sends a message and returns the answer, or raises it if it is an exception."""
        self._connection.send(message)
        answer = self._connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def columns(self, what, *arguments):
        """Builds a network; returns functions that run it and return wall and CPU seconds."""
        names = self.ask("build", what, *arguments)
        return {name: functools.partial(self.ask, "time", name) for name in names}

    def outputs(self):
        """Runs the network that was built last and returns its outputs as arrays."""
        return self.ask("outputs", "torch")

    def close(self):
        self._connection.send(None)
        self._process.wait()


def start(platform):
    """Starts PyTorch on the device of JAX; None if it is not installed or lacks the device."""
    if importlib.util.find_spec("torch") is None:
        return None
    rival = Rival("cpu" if platform == "cpu" else "cuda")
    if rival.is_there:
        return rival
    rival.close()
    return None
