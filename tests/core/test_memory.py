"""The restart with huge pages."""

import os
import pathlib
import sys
from types import SimpleNamespace

import jax
import pytest

from radejax.core import memory


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
    memory.cache_compiled_programs()
    assert values["jax_compilation_cache_dir"] == found
    values["jax_compilation_cache_dir"] = "/mine"
    memory.cache_compiled_programs()
    assert values["jax_compilation_cache_dir"] == "/mine"
