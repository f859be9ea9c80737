"""Terms that were replaced by standard ones do not come back (CONTRIBUTING.md, Code)."""

import pathlib
import re

ROOT = pathlib.Path(__file__).resolve().parents[1]

REPLACED = {
    r"\breleased code\b": "authors' code",
    r"\breference implementation": "authors' code",
    r"\bhouse\b": "architecture",
    r"\brooms?\b": "package",
    r"\bdoors?\b": "entry point",
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\bseldom\b": "less often",
    r"\bcircles of\b": "reference cycles",
    r"\b(labels?|images?) exchanged\b": "shuffled",
    r"\bof before\b": "of earlier versions",
    r"\bin turns\b": "alternating",
    r"\bradar alone\b": "radar only",
    r"\bprocessor (time|minutes|seconds)\b": "CPU time",
    r"\bfalling score\b": "descending score",
    r"\bscore cuts?\b": "score threshold",
    r"\bcomes along\b": "bundled",
    r"\bat hand\b": "available",
    r"\bwithout a word\b": "silently",
    r"\bsmall road users?\b": "VRU",
    r"\bpictures?\b": "figure or image",
    r"\bdamaged\b": "corrupted",
    r"\bis no (number|file|header|folder)\b": "is not a",
}


def test_replaced_terms_do_not_come_back():
    files = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
    files += [
        path
        for folder, ending in (("docs", "md"), ("radejax", "py"), ("configs", "py"))
        for path in (ROOT / folder).rglob(f"*.{ending}")
    ]
    assert len(files) > 100
    any_term = re.compile("|".join(REPLACED), re.IGNORECASE)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {match[0]!r}, see REPLACED"
        for path in files
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        for match in any_term.finditer(line)
    ]
    assert not found, "\n".join(found)
