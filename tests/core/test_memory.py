"""Memory that is freed and taken again."""

import os
import pathlib
import platform
import subprocess
import sys

import pytest

from radejax.core import memory

PROGRAM = """
import ctypes, resource, threading
from radejax.core import memory
memory.restart_with_huge_pages()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.free.argtypes = libc.memset.argtypes = None
faults = []
def take():
    for _ in range(4):
        block = ctypes.c_void_p(libc.malloc(400 << 20))
        libc.memset(block, 1, ctypes.c_size_t(400 << 20))
        libc.free(block)
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
thread = threading.Thread(target=take)  # as JAX's steps do
thread.start()
thread.join()
print(faults[-1] - faults[0])
"""


def _taken(**said: str) -> float:
    """Share of the pages of three blocks that were new."""
    theirs = ("MALLOC_", "GLIBC_TUNABLES")
    others = {k: v for k, v in os.environ.items() if not k.startswith(theirs)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=others | said,
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout) / (3 * (400 << 20) // os.sysconf("SC_PAGE_SIZE"))


def _is_asked() -> bool:
    name, version = platform.libc_ver()
    pages = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return (
        (name, tuple(map(int, version.split(".")))) >= ("glibc", (2, 35))
        and pages.exists()
        and "[madvise]" in pages.read_text()
    )


@pytest.mark.skipif(not _is_asked(), reason="this system decides on huge pages itself")
def test_pages_are_huge_after_a_restart() -> None:
    assert _taken() < 0.05
    assert _taken(MALLOC_TOP_PAD_="131072") > 0.5


@pytest.mark.parametrize(
    ("mode", "said", "is_restarted"),
    [
        ("always [madvise] never", {}, True),
        ("[always] madvise never", {}, False),
        ("always madvise [never]", {}, False),
        ("always [madvise] never", {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}, False),
        ("always [madvise] never", {"MALLOC_ARENA_MAX": "1"}, False),
        (None, {}, False),
    ],
)
def test_a_program_is_restarted_once_and_with_its_own_words(
    mode: str | None,
    said: dict[str, str],
    is_restarted: bool,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []
    pages = tmp_path / "enabled"
    if mode is not None:
        pages.write_text(mode)
    monkeypatch.setattr(memory, "_PAGES", pages)
    monkeypatch.setattr(os, "environ", {"HOME": "/h"} | said)
    monkeypatch.setattr(os, "execve", lambda *given: calls.append(given))
    monkeypatch.setattr(
        sys, "orig_argv", ["python", "-u", "train.py", "--config", "a b"]
    )
    memory.restart_with_huge_pages()
    assert len(calls) == is_restarted
    if is_restarted:
        program, words, environment = calls[0]
        assert (program, words[0]) == (sys.executable, sys.executable)
        assert words[1:] == ["-u", "train.py", "--config", "a b"]
        assert environment["HOME"] == "/h"
        monkeypatch.setattr(os, "environ", environment)
        memory.restart_with_huge_pages()
        assert len(calls) == 1
