"""Cache of compiled programs on the disk."""

from __future__ import annotations

import contextlib
import os
import pathlib

_MAX_BYTES = 4 * 2**30


def enable_compilation_cache() -> None:
    """Lets JAX store compiled programs on the disk, so that later starts need not compile.

    The commands call this function. Scripts and notebooks call it once, before they use
    JAX.

    The folder is `radejax/jax` in `XDG_CACHE_HOME` or `~/.cache`. If it is larger than
    4 GiB, the programs that were used least recently are deleted. Without a home folder,
    programs are not stored. If JAX has a folder already, such as that of
    `JAX_COMPILATION_CACHE_DIR`, that folder is used and nothing in it is deleted.
    """
    import jax  # `--help` imports this module and must be fast

    # Small programs are cached too: compiling the fifty at the start of a run takes a
    # second.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    is_set = jax.config.values["jax_compilation_cache_dir"]
    if not is_set and os.path.isabs(home):
        folder = pathlib.Path(home, "radejax", "jax")
        _limit_size(folder, _MAX_BYTES)
        jax.config.update("jax_compilation_cache_dir", str(folder))


def _limit_size(folder: pathlib.Path, max_bytes: int) -> None:
    """Deletes the files that were used least recently, until the folder is small enough.

    `jax_compilation_cache_max_size` is not used, because JAX then stores nothing any more
    once a killed process has left a program without the file with its time.
    """
    entries = []
    for path in folder.glob("*"):
        # Another process may delete files at the same time.
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            used = max(status.st_atime, status.st_mtime)
            entries.append((used, status.st_size, path))
    excess = sum(size for _, size, _ in entries) - max_bytes
    for _, size, path in sorted(entries):
        if excess <= 0:
            break
        path.unlink(missing_ok=True)
        excess -= size
