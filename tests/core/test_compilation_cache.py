"""The folder of compiled programs: where it is, its size, and what leaves it alone."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest

from radejax.core import compilation_cache


@pytest.fixture
def values(monkeypatch):
    """Settings of JAX, of which the cache is not set."""
    found = {"jax_compilation_cache_dir": None}
    config = SimpleNamespace(values=found, update=found.__setitem__)
    monkeypatch.setattr(jax, "config", config)
    return found


@pytest.mark.parametrize(
    ("home", "caches", "found"),
    [
        ("~", "", None),  # no home folder
        ("~", "/caches", "/caches/radejax/jax"),
        ("/home/me", "", "/home/me/.cache/radejax/jax"),
    ],
)
def test_compiled_programs_are_stored_with_and_without_a_home_folder(
    home, caches, found, values, monkeypatch
):
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", home))
    monkeypatch.setenv("XDG_CACHE_HOME", caches)
    for expected in (found, "/mine"):
        compilation_cache.enable_compilation_cache()
        assert values["jax_compilation_cache_dir"] == expected
        values["jax_compilation_cache_dir"] = "/mine"


def test_programs_used_least_recently_are_deleted(values, tmp_path, monkeypatch):
    monkeypatch.setattr(compilation_cache, "_MAX_BYTES", 250)
    folder = tmp_path / "radejax" / "jax"
    folder.mkdir(parents=True)
    for hours, name in enumerate(("read", "old", "new")):
        (folder / f"{name}-cache").write_bytes(bytes(100))
        os.utime(folder / f"{name}-cache", (3600 * hours, 3600 * hours))
    os.utime(folder / "read-cache", (9e9, 0))  # written first, read last
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compilation_cache.enable_compilation_cache()
    assert {path.name for path in folder.iterdir()} == {"read-cache", "new-cache"}


_PROGRAM = """
import jax, radejax
radejax.enable_compilation_cache()
jax.jit(lambda x: x + 1)(1.0)
"""


def test_files_of_a_killed_process_do_not_stop_the_cache(tmp_path):
    folder = tmp_path / "radejax" / "jax"
    folder.mkdir(parents=True)
    (folder / "orphan-cache").write_bytes(b"half a program")
    (folder / "orphan-atime").write_bytes(b"")
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    options = {"env": environment, "capture_output": True, "check": True}
    assert subprocess.run([sys.executable, "-c", _PROGRAM], **options).stderr == b""
    assert len(list(folder.iterdir())) > 2
