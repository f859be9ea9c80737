"""The folder of compiled programs: where it is, its size, and what leaves it alone."""

import os
import pathlib
import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest

from radejax.core import compilation_cache


@pytest.mark.parametrize(
    ("home", "caches", "found"),
    [
        ("~", "", None),  # no home folder
        ("~", "/caches", "/caches/radejax/jax"),
        ("/home/me", "", "/home/me/.cache/radejax/jax"),
    ],
)
def test_compiled_programs_are_stored_with_and_without_a_home_folder(
    home: str, caches: str, found: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    values: dict[str, object] = {"jax_compilation_cache_dir": None}
    config = SimpleNamespace(values=values, update=values.__setitem__)
    monkeypatch.setattr(jax, "config", config)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", home))
    monkeypatch.setenv("XDG_CACHE_HOME", caches)
    compilation_cache.enable_compilation_cache()
    assert values["jax_compilation_cache_dir"] == found
    values["jax_compilation_cache_dir"] = "/mine"
    compilation_cache.enable_compilation_cache()
    assert values["jax_compilation_cache_dir"] == "/mine"


def test_programs_used_least_recently_are_deleted(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation_cache, "_MAX_BYTES", 250)
    folder = tmp_path / "radejax" / "jax"
    folder.mkdir(parents=True)
    for hours, name in enumerate(("read", "old", "new")):
        (folder / f"{name}-cache").write_bytes(bytes(100))
        os.utime(folder / f"{name}-cache", (3600 * hours, 3600 * hours))
    os.utime(folder / "read-cache", (9e9, 0))  # written first, read last
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    values: dict[str, object] = {"jax_compilation_cache_dir": None}
    config = SimpleNamespace(values=values, update=values.__setitem__)
    monkeypatch.setattr(jax, "config", config)
    compilation_cache.enable_compilation_cache()
    assert {path.name for path in folder.iterdir()} == {"read-cache", "new-cache"}


_PROGRAM = """
import jax, radejax
radejax.enable_compilation_cache()
jax.jit(lambda x: x + 1)(1.0)
"""


def test_files_of_a_killed_process_do_not_stop_the_cache(
    tmp_path: pathlib.Path,
) -> None:
    folder = tmp_path / "radejax" / "jax"
    folder.mkdir(parents=True)
    (folder / "orphan-cache").write_bytes(b"half a program")
    (folder / "orphan-atime").write_bytes(b"")
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    assert len(list(folder.iterdir())) > 2
