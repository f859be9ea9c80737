"""How this process asks the system for memory."""

from __future__ import annotations

import ctypes
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # mallopt's, of malloc.h
_LARGEST = 256 << 20


def keep_freed() -> None:
    """Memory that is freed stays with the process, for the next array of that size.

    By default glibc gives large blocks back at once and gets them anew from the kernel,
    cleared page by page: of the quickstart's training on a CPU that is a seventh of the
    processor time. Blocks above 256 MiB are still given back, as small ones would break
    them up. Without glibc, or where the environment says how it is to allocate
    (MALLOC_..., GLIBC_TUNABLES), nothing is changed.
    """
    is_said = any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ)
    if sys.platform != "linux" or is_said:
        return
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(_ARENA_MAX, 1)  # other arenas than the first have no large blocks
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, -1)
