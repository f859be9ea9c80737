"""Who works and who waits; with real processes in tests/test_two_processes.py."""

from typing import Any

import jax
import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.training import processes


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes this process one of two; returns what happens between them, in order."""
    events: list[str] = []

    def become(index: int, *, main_is_fine: bool = True) -> list[str]:
        def broadcast(value: np.ndarray) -> np.ndarray:
            events.append("told")
            return value if index == 0 else np.int32(main_is_fine)

        monkeypatch.setattr(jax, "process_count", lambda: 2)
        monkeypatch.setattr(jax, "process_index", lambda: index)
        monkeypatch.setattr(processes, "wait_for_all", lambda _: events.append("wait"))
        monkeypatch.setattr(
            processes.multihost_utils, "broadcast_one_to_all", broadcast
        )
        return events

    return become


def test_the_others_wait_while_the_main_process_works(two: Any) -> None:
    events = two(0)
    assert processes.main_only(lambda: events.append("work") or 5) == 5
    assert events == ["work", "wait", "told"]
    events.clear()
    two(1)
    assert processes.main_only(lambda: events.append("work")) is None
    assert events == ["wait", "told"]


def test_an_error_of_the_main_process_reaches_the_others(two: Any) -> None:
    def fail() -> None:
        raise OSError("broken")

    events = two(0)
    with pytest.raises(OSError, match="broken"):
        processes.main_only(fail)
    assert events == ["wait", "told"]
    two(1, main_is_fine=False)
    with pytest.raises(UserError, match="process 0 stopped with an error"):
        processes.main_only(fail)


def test_what_the_main_process_prepared_is_found_by_the_others(two: Any) -> None:
    events = two(1)
    assert processes.main_first(lambda: events.append("work") or "found") == "found"
    assert events == ["wait", "told", "work", "wait"]
