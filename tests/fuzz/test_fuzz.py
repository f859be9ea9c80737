"""Corrupted inputs are read, or rejected by one line."""

import pytest

from . import engine
from .readers import READERS


@pytest.fixture(scope="module")
def found():
    """Outcomes of all readers, from one process."""
    return engine.counts([(name, 0, reader.count) for name, reader in READERS.items()])


def check(name, count, outcomes):
    counts, wrong = outcomes
    assert not wrong, f"{name}: {wrong[:3]}"
    assert sum(counts.values()) == count
    assert len(counts) > 1 or count < 90, counts  # both read and refused


@pytest.mark.parametrize("name", READERS)
def test_corrupted_inputs_are_read_or_rejected(name, found):
    check(name, READERS[name].count, found[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_more(name):
    count = 50 * READERS[name].count
    check(name, count, engine.counts([(name, READERS[name].count, count)])[name])


def test_the_corpus_belongs_to_readers():
    assert {folder.name for folder in engine.CORPUS.iterdir()} <= set(READERS)
