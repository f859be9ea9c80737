"""What opening a data set found: counts, problems with file and line, notes."""

from __future__ import annotations

import collections
import dataclasses
from typing import Any

from radejax.data.labels import Problem


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
