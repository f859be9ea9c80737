"""Huge memory pages for the programs of this package."""

from __future__ import annotations

import os
import pathlib
import sys

_PAGES = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")
_TUNABLES = (
    "glibc.malloc.hugetlb=1:glibc.malloc.arena_max=1:"
    "glibc.malloc.mmap_threshold=4294967296:"
    "glibc.malloc.trim_threshold=9223372036854775807"
)


def restart_with_huge_pages() -> None:
    """Restart this program with `GLIBC_TUNABLES` that enable pages of 2 MB.

    Arrays are then mapped to few large pages, and freed memory is kept for the next step.
    glibc reads the variable when a process starts, so programs call this function first.
    It does nothing if the environment already configures the allocator (`MALLOC_...`,
    `GLIBC_TUNABLES`), or if the kernel does not let programs choose (`madvise`). C
    libraries other than glibc ignore the variable.
    """
    allocator = ("MALLOC_", "GLIBC_TUNABLES")
    is_set = any(v for n, v in os.environ.items() if n.startswith(allocator))
    if is_set or not sys.executable or not _PAGES.exists():
        return
    if "[madvise]" in _PAGES.read_text():
        arguments = [sys.executable, *sys.orig_argv[1:]]
        environment = os.environ | {"GLIBC_TUNABLES": _TUNABLES}
        os.execve(sys.executable, arguments, environment)
