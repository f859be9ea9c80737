"""Positions of echoes between bins, and overlaps of boxes at these positions."""

import pathlib

from click.testing import CliRunner

from radejax.config import load_module

ROOT = pathlib.Path(__file__).resolve().parents[2]
echo_accuracy = load_module(ROOT / "examples" / "echo_accuracy.py")


def test_scenes_are_measured():
    arguments = ["--scenes", "4", "--range-bins", "32", "--cls", "Bicycle"]
    result = CliRunner().invoke(echo_accuracy.main, arguments)
    assert result.exit_code == 0, result.output
    assert "echo position of class Bicycle, 32 range bins" in result.output
    rows = [line.split() for line in result.output.splitlines() if " %" in line]
    assert [row[0] for row in rows] == ["5-20", "20-40"]
    for row in rows:
        assert int(row[2]) > 0
        assert all(abs(float(value)) < 1.5 for value in row[3:6])
        assert 0 <= int(row[6]) <= 100
