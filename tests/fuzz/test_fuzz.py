"""Damaged inputs are read, or refused by one line; docs/reliability.md has the long run."""

import random
from collections.abc import Iterator

import pytest

from .engine import CORPUS, Child
from .mutate import mutate
from .readers import READERS

FACTOR_OF_SLOW = 10


@pytest.fixture(scope="module")
def child() -> Iterator[Child]:
    with Child() as child:
        yield child


def check(child: Child, name: str, start: int, count: int) -> None:
    counts, wrong = child.counts(name, start, count)
    assert not wrong, f"{name}: {wrong[:3]}"
    assert sum(counts.values()) == count
    assert len(counts) > 1 or count < 200, counts  # not all were read, nor all refused


@pytest.mark.parametrize("name", [n for n, r in READERS.items() if r.count > 5])
def test_damaged_inputs_are_read_or_refused(child: Child, name: str) -> None:
    check(child, name, 0, READERS[name].count)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_more_are(child: Child, name: str) -> None:
    count = READERS[name].count
    check(child, name, count, FACTOR_OF_SLOW * count)


def test_the_corpus_belongs_to_readers() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} <= set(READERS)


def test_inputs_are_the_same_everywhere_and_damaged() -> None:
    content = b'{"a": [1, 2.5], "b": "x"}'
    inputs = [mutate(random.Random(f"x/{n}"), content) for n in range(300)]
    assert inputs == [mutate(random.Random(f"x/{n}"), content) for n in range(300)]
    assert len(set(inputs)) > 200
