"""Corrupted inputs are read, or rejected by one line."""

import pytest

from . import engine
from .readers import READERS


def check(name: str, start: int, count: int) -> None:
    counts, wrong = engine.counts(name, start, count)
    assert not wrong, f"{name}: {wrong[:3]}"
    assert sum(counts.values()) == count
    assert len(counts) > 1 or count < 200, counts  # both read and refused


@pytest.mark.parametrize("name", READERS)
def test_corrupted_inputs_are_read_or_rejected(name: str) -> None:
    check(name, 0, READERS[name].count)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_ten_times_as_many(name: str) -> None:
    check(name, READERS[name].count, 10 * READERS[name].count)


def test_the_corpus_belongs_to_readers() -> None:
    assert {folder.name for folder in engine.CORPUS.iterdir()} <= set(READERS)
