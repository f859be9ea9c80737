"""Positions of echoes between bins, and overlaps of boxes at these positions."""

import pathlib

import numpy as np
import pytest
from click.testing import CliRunner

from radejax.config import load_module

ROOT = pathlib.Path(__file__).resolve().parents[2]
echo_accuracy = load_module(ROOT / "examples" / "echo_accuracy.py")


@pytest.mark.parametrize("beside", [(0, 0), (1, -1), (-1, 0)])
def test_an_echo_is_found_from_the_next_cell(beside: tuple[int, int]) -> None:
    row, column = np.mgrid[:20, :16]
    place = np.array([9.3, 7.8])
    power = 90.0 - 2.0 * (row - place[0]) ** 2 - 3.0 * (column - place[1]) ** 2
    cell = np.round(place).astype(int) + beside
    np.testing.assert_allclose(echo_accuracy.locate(power, cell), place)


def test_boxes_are_moved_along_and_across_the_line_of_sight() -> None:
    # Ahead and to the left; the footprints lie along the line of sight.
    boxes = np.array([[10.0, 0, 0, 2, 1, 1, 0], [0, 10.0, 0, 2, 1, 1, np.pi / 2]])
    half, none = np.full(2, 0.5), np.zeros(2)
    np.testing.assert_allclose(echo_accuracy.overlap(boxes, none, none), 1.0)
    along = echo_accuracy.overlap(boxes, half, none)
    np.testing.assert_allclose(along, 1.5 / 2.5)
    np.testing.assert_allclose(echo_accuracy.overlap(boxes, none, half), 1 / 3)


def test_scenes_are_measured() -> None:
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
