"""How this process asks the system for memory."""

from __future__ import annotations

import ctypes
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # mallopt's, of malloc.h
_LARGEST = 2**31 - 1  # of the int that mallopt takes


def keep_freed() -> None:
    """Memory that is freed stays with the process, for the next array of that size.

    By default glibc gives large blocks back at once and gets them anew from the kernel,
    cleared page by page: of the quickstart's training on a CPU that is a seventh of the
    processor time, of RADE-Net's at full size a quarter. What is kept may be broken up
    by small blocks: RADE-Net's step of one frame, 1.7 GiB, then has 6.2 GiB in all in
    place of 3.2. Blocks of 2 GiB and more are given back. Without glibc, or where the
    environment says how it is to allocate (MALLOC_..., GLIBC_TUNABLES), nothing is
    changed.
    """
    is_said = any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ)
    if sys.platform != "linux" or is_said:
        return
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(_ARENA_MAX, 1)  # other arenas than the first have no large blocks
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, -1)
