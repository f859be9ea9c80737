"""Damaged inputs for every reader of the package, for minutes; what became of them.

    python benchmarks/fuzz.py --minutes 30 [--readers labels,plan] [--out FILE.json] [--keep]

Each reader gets its share of the time, in two processes. Every input has a number: a later
run with `--start` has others. What is neither read nor refused as it should is shown at
once, and kept in tests/fuzz/corpus with `--keep`; exit code 1. The table at the end is that
of docs/reliability.md.
"""

import argparse
import collections
import concurrent.futures
import json
import pathlib
import queue
import sys
import time

from tqdm import tqdm

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

from tests.fuzz import engine
from tests.fuzz.readers import READERS

MOST_AT_ONCE = 200


class Run:
    """Readers that take turns until the time is over."""

    def __init__(self, minutes, names, workers, start, keeps):
        self.results = {}
        self._names, self._workers, self._start, self._keeps = (
            names,
            workers,
            start,
            keeps,
        )
        self._left, self._began, self._seconds = len(names), time.time(), 60 * minutes
        self._bar = tqdm(total=round(self._seconds), unit="s", miniters=1)
        self._children = queue.Queue()

    def __call__(self):
        for _ in range(self._workers):
            self._children.put(engine.Child())
        with self._bar, concurrent.futures.ThreadPoolExecutor(self._workers) as pool:
            list(pool.map(self._read, self._names))
        while not self._children.empty():
            self._children.get().close()
        return {name: self.results[name] for name in self._names}

    def _read(self, name):
        """One reader in its share of the time that is left, some inputs at least."""
        child = self._children.get()
        now, some = time.time(), min(MOST_AT_ONCE, max(READERS[name].count // 50, 1))
        left = self._began + self._seconds - now
        end, self._left = now + left * self._workers / self._left, self._left - 1
        counts, wrong = self.results[name] = collections.Counter(), []
        number = self._start
        while number == self._start or time.time() < end:
            found, bad = child.counts(name, number, some)
            counts.update(found)
            number += some
            for outcome in bad:
                self._tell(name, outcome, wrong)
            total = sum(c.total() for c, _ in self.results.values())
            faults = sum(len(w) for _, w in self.results.values())
            self._bar.set_postfix(
                reader=name, inputs=total, wrong=faults, refresh=False
            )
            self._bar.update(round(time.time() - self._began) - self._bar.n)
        self._children.put(child)

    def _tell(self, name, outcome, wrong):
        number, kind, text = outcome
        if not any((kind, text[:60]) == (k, t[:60]) for _, k, t in wrong):
            self._bar.write(f"{name} {number}: {kind}: {text}", file=sys.stderr)
            if self._keeps:
                engine.keep(name, READERS[name], number)
        wrong.append(outcome)


def table(results):
    """Markdown: a row a reader, and what they raised."""
    lines = ["| reader | inputs | read | refused | wrong |", "|---|---|---|---|---|"]
    for name, (counts, wrong) in results.items():
        refused = ", ".join(
            f"`{kind.removeprefix('refused ')}` {n:,}"
            for kind, n in sorted(counts.items())
            if kind.startswith("refused")
        )
        lines.append(
            f"| {name} | {counts.total():,} | {counts['read']:,} | {refused} | {len(wrong)} |"
        )
    total = sum(counts.total() for counts, _ in results.values())
    return "\n".join([*lines, f"| all | {total:,} | | | |"])


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--readers", default="", help="words that their names have")
    parser.add_argument(
        "--start", type=int, default=0, help="number of the first input"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument(
        "--keep", action="store_true", help="put what broke into the corpus"
    )
    args = parser.parse_args(argv)
    words = [word for word in args.readers.split(",") if word]
    names = [n for n in READERS if not words or any(word in n for word in words)]
    results = Run(args.minutes, names, args.workers, args.start, args.keep)()
    print(table(results))
    if args.out:
        content = {name: dict(counts) for name, (counts, _) in results.items()}
        args.out.write_text(json.dumps(content, indent=1) + "\n")
    return int(any(wrong for _, wrong in results.values()))


if __name__ == "__main__":
    sys.exit(main())
