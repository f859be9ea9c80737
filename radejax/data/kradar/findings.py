"""What reading a data set found: counts, problems with file and line, notes."""

from __future__ import annotations

import collections
import dataclasses
from typing import Any

from radejax.core.errors import DataError
from radejax.data.kradar.labels import Problem


@dataclasses.dataclass(frozen=True, slots=True)
class Summary:
    """Counts and problems of a data set.

    Attributes:
        counts: What was read and what was left out, by reason.
        problems: Everything missing or malformed.
        notes: Decisions that were made for want of a file.
    """

    counts: dict[str, int]
    problems: list[Problem]
    notes: list[str]

    def problem_counts(self) -> dict[str, int]:
        """Number of problems of every kind."""
        return dict(collections.Counter(problem.kind for problem in self.problems))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "counts": dict(self.counts),
            "problem_counts": self.problem_counts(),
            "problems": [str(problem) for problem in self.problems],
            "notes": list(self.notes),
        }

    def to_text(self, max_problems: int = 3) -> str:
        """Lines for a terminal: all counts, the first problems of every kind."""
        lines = [
            f"{number:>9,}  {what}" for what, number in self.counts.items() if number
        ]
        lines += [f"note: {note}" for note in self.notes]
        for kind, number in self.problem_counts().items():
            lines.append(f"problem: {kind}: {number:,}")
            examples = [p for p in self.problems if p.kind == kind][:max_problems]
            lines += [f"    {problem}" for problem in examples]
            if number > max_problems:
                lines.append(f"    ... and {number - max_problems:,} more")
        return "\n".join(lines)


class Findings:
    """Collects a `Summary` while files are read; `strict` raises the first problem."""

    def __init__(self, *, strict: bool) -> None:
        self.strict = strict
        self.counts: collections.Counter[str] = collections.Counter()
        self.problems: list[Problem] = []
        self.notes: list[str] = []

    def report(
        self,
        kind: str,
        where: str,
        message: str,
        error: type[Exception] = DataError,
    ) -> None:
        """Keeps a problem, or raises it when strict.

        Args:
            kind: What is counted together.
            where: File, line or frame.
            message: What was found and what was expected; may begin with `where`.
            error: What strict reading raises.
        """
        problem = Problem(kind, where, message)
        if self.strict:
            raise error(str(problem))
        self.problems.append(problem)

    def summary(self) -> Summary:
        """A copy of everything so far."""
        return Summary(dict(self.counts), list(self.problems), list(self.notes))
