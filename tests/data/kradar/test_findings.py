import json

import pytest

from radejax.core.errors import DataError
from radejax.data.kradar.findings import Findings


def test_lenient_findings_are_counted_and_shortened():
    findings = Findings(strict=False)
    findings.counts["frames"] += 1234
    findings.counts["nothing"] += 0
    findings.notes.append("by rule")
    for i in range(5):
        findings.report("label line", f"a.txt:{i}", f"a.txt:{i}: bad")
    findings.report("calibration", "c.txt", "missing")
    summary = findings.summary()
    assert summary.problem_counts() == {"label line": 5, "calibration": 1}
    assert summary.to_text(max_problems=2).splitlines() == [
        "    1,234  frames",
        "note: by rule",
        "problem: label line: 5",
        "    a.txt:0: bad",
        "    a.txt:1: bad",
        "    ... and 3 more",
        "problem: calibration: 1",
        "    c.txt: missing",
    ]
    plain = json.loads(json.dumps(summary.to_dict()))
    assert plain["problems"][5] == "c.txt: missing"
    findings.report("late", "d", "e")
    assert len(summary.problems) == 6  # a summary is a copy


def test_strict_findings_raise():
    findings = Findings(strict=True)
    with pytest.raises(DataError, match=r"^a\.txt:1: bad$"):
        findings.report("label line", "a.txt:1", "bad")
    with pytest.raises(FileNotFoundError, match="gone"):
        findings.report("tesseract", "a", "gone", error=FileNotFoundError)
    assert not findings.problems
