"""PyTorch networks in a second process, for comparison in alternation.

While one process runs, the other waits, so that threads and memory do not interfere. The code of
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
    """PyTorch in another process; `columns` are measured next to radejax.

    Args:
        device: "cpu" or "cuda".
    """

    def __init__(self, device):
        key = os.urandom(16)
        with multiprocessing.connection.Listener(authkey=key) as listener:
            ours = "GLIBC_TUNABLES"  # of radejax.core.memory: torch has the defaults
            theirs = {k: v for k, v in os.environ.items() if k != ours}
            code = "import sys, torch_half; torch_half.serve(*sys.argv[1:])"
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, listener.address, key.hex(), device],
                cwd=pathlib.Path(__file__).parent,
                env=theirs,
            )
            self._connection = listener.accept()
        self.is_there = self._connection.recv()

    def ask(self, *message):
        """Send a message and return the answer; an exception there is raised here."""
        self._connection.send(message)
        answer = self._connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def columns(self, what, *arguments):
        """Name -> function that gives wall and CPU seconds of what is built."""
        names = self.ask("build", what, *arguments)
        return {name: functools.partial(self.ask, "time", name) for name in names}

    def outputs(self):
        """Arrays that a call gives."""
        return self.ask("outputs", "torch")

    def close(self):
        self._connection.send(None)
        self._process.wait()


def start(platform):
    """Start PyTorch on the device of JAX; None if it is not installed or lacks the device."""
    if importlib.util.find_spec("torch") is None:
        return None
    rival = Rival("cpu" if platform == "cpu" else "cuda")
    if rival.is_there:
        return rival
    rival.close()
    return None
