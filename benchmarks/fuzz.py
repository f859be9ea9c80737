"""Reads randomly corrupted files with every reader of foreign files.

    python benchmarks/fuzz.py --minutes 30 [--readers labels,split] [--out FILE.json]

All readers get the same time. Inputs are numbered, and `--start` selects the first one, so that a
later run can use other inputs. An input that is neither read nor rejected with a documented
exception is printed after its block of 1,000 inputs, and the exit code is 1.
`--keep READER:NUMBER` adds an input to tests/fuzz/corpus.
"""

import argparse
import collections
import json
import pathlib
import sys
import tempfile
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

from tests.fuzz import engine
from tests.fuzz.readers import READERS

AT_ONCE = 1000


def fuzz(name, seconds, start):
    """Runs a reader on corrupted files; returns counts of outcomes and the wrong outcomes."""
    total, all_wrong, end = collections.Counter(), [], time.time() + seconds
    while not total or time.time() < end:
        counts, wrong = engine.counts([(name, start, AT_ONCE)])[name]
        for _, number, kind, text in wrong:
            print(f"{name} {number}: {kind}: {text}", file=sys.stderr)
        total, all_wrong, start = total + counts, all_wrong + wrong, start + AT_ONCE
    return total, all_wrong


def keep(name, number):
    """Adds an input to the corpus."""
    with tempfile.TemporaryDirectory() as folder:
        case = engine.Case(name, READERS[name], pathlib.Path(folder))
        path, content = case.content(number)
    target = engine.CORPUS / name / f"{path.name}.{number}"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(content)


def table(results):
    """Returns a Markdown table with the number of inputs per reader and outcome."""
    lines = ["| reader | inputs | read | rejected | wrong |", "|---|---|---|---|---|"]
    for name, (counts, wrong) in results.items():
        rejected = counts.total() - counts["read"] - len(wrong)
        cells = (
            f"{n:,}" for n in (counts.total(), counts["read"], rejected, len(wrong))
        )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument(
        "--readers",
        default="",
        help="parts of the names of readers, separated by commas",
    )
    parser.add_argument("--start", type=int, default=0, help="first input's number")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--keep", help="READER:NUMBER of an input for the corpus")
    args = parser.parse_args(argv)
    if args.keep:
        name, number = args.keep.rsplit(":", 1)
        return keep(name, int(number))
    words = args.readers.split(",")
    names = [name for name in READERS if any(word in name for word in words)]
    if not names:
        parser.error(f"no reader of {args.readers}; there are {', '.join(READERS)}")
    seconds = 60 * args.minutes / len(names)
    results = {name: fuzz(name, seconds, args.start) for name in names}
    print(table(results))
    if args.out:
        content = {name: dict(counts) for name, (counts, _) in results.items()}
        args.out.write_text(json.dumps(content, indent=1) + "\n")
    return int(any(wrong for _, wrong in results.values()))


if __name__ == "__main__":
    sys.exit(main())
