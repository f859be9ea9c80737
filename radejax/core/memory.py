"""How this process asks for memory and looks for what it can free."""

from __future__ import annotations

import ctypes
import gc
import os
import pathlib
import platform
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # mallopt's, of malloc.h
_LARGEST = 2**31 - 1  # of the int that mallopt takes
_PAGES = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")
_HUGE_AND_KEPT = ":".join(
    f"glibc.malloc.{name}={value}"
    for name, value in {
        "hugetlb": 1,
        "arena_max": 1,
        "mmap_threshold": 2**32,
        "trim_threshold": 2**63 - 1,
    }.items()
)


def restart_with_huge_pages() -> None:
    """Starts this program again, its memory in pages of 2 MB, where that takes asking.

    What a step takes is then mapped in few large pieces, and what is freed stays for the
    next one, up to blocks of 4 GiB: on a CPU a training step of DinoRADE takes two
    thirds of the time that it takes with `keep_freed`, RADE-Net's 0.6 of its memory.
    glibc (2.35) reads the wish from the environment when a process begins, so this must
    be called before anything else, by a program's own first lines. Where the system
    decides for all programs, or the environment says how to allocate, nothing is done.
    """
    name, version = platform.libc_ver()
    can_ask = name == "glibc" and [*map(int, version.split(".")[:2])] >= [2, 35]
    if _is_said() or not (can_ask and sys.executable and _PAGES.exists()):
        return
    if "[madvise]" in _PAGES.read_text():
        words = [sys.executable, *sys.orig_argv[1:]]
        os.execve(
            sys.executable, words, os.environ | {"GLIBC_TUNABLES": _HUGE_AND_KEPT}
        )


def _is_said() -> bool:
    return any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ)


def keep_freed() -> None:
    """Memory that is freed stays with the process, for the next array of that size.

    For programs that have not their memory in huge pages, which is better. By default
    glibc gives large blocks back at once and gets them anew from the kernel, cleared page
    by page: of the quickstart's training on a CPU that is a seventh of the processor
    time, of RADE-Net's at full size a quarter. What is kept may be broken up by small
    blocks: RADE-Net's step of one frame, 1.7 GiB, then has 6.2 GiB in all in place of
    3.2. Blocks of 2 GiB and more are given back. Without glibc, or where the environment
    says how it is to allocate (MALLOC_..., GLIBC_TUNABLES), nothing is changed.
    """
    if sys.platform != "linux" or _is_said():
        return
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(_ARENA_MAX, 1)  # other arenas than the first have no large blocks
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, -1)


def collect_seldom() -> None:
    """Python looks for objects that only refer to each other after more of them.

    Imports and tracing make millions of objects, which stay: by default Python looks
    through the new ones at every 700 to 2,000, and JAX's with them, which takes a fifth of
    the time from a command to its first step. Arrays are in no such circles; they are
    freed at once, as ever.
    """
    gc.set_threshold(50_000, 20, 50)
