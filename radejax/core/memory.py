"""Settings of a process: huge memory pages and the cache of compiled programs."""

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


def cache_compiled_programs() -> None:
    """Let JAX store compiled programs in the user's cache folder, unless a folder is set.

    The folder is `radejax/jax` in `XDG_CACHE_HOME` or `~/.cache`. Without a home folder,
    programs are not stored. JAX itself reads JAX_COMPILATION_CACHE_DIR.
    """
    import jax  # `--help` imports this module and must be fast

    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    is_set = jax.config.values["jax_compilation_cache_dir"]
    if not is_set and os.path.isabs(home):
        folder = os.path.join(home, "radejax", "jax")
        jax.config.update("jax_compilation_cache_dir", folder)


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
