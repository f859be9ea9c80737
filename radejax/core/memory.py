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
    """Restart this program with `GLIBC_TUNABLES` for pages of 2 MB, where they help.

    Arrays are then mapped in few large pieces, and freed memory stays for the next
    step. glibc reads the variable when a process begins, so a program calls this first.
    Nothing happens where the environment sets how to allocate (`MALLOC_...`,
    `GLIBC_TUNABLES`), or where the kernel does not leave the choice to programs. Other
    C libraries ignore the variable.
    """
    is_set = any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ)
    if is_set or not sys.executable or not _PAGES.exists():
        return
    if "[madvise]" in _PAGES.read_text():
        arguments = [sys.executable, *sys.orig_argv[1:]]
        environment = os.environ | {"GLIBC_TUNABLES": _TUNABLES}
        os.execve(sys.executable, arguments, environment)
