"""AP by the distance of centers, and errors of centers along and across the line of sight."""

import json
import pathlib

import numpy as np
from click.testing import CliRunner

from radejax.config import load_module

ROOT = pathlib.Path(__file__).resolve().parents[2]
center_distance = load_module(ROOT / "examples" / "center_distance.py")


def columns(*rows: tuple, scored: bool = False) -> dict[str, np.ndarray]:
    """Columns frame, class, x, y (and score) of boxes with edges of half a meter."""
    found = {
        "frame": np.array([row[0] for row in rows]),
        "cls": np.array([row[1] for row in rows]),
        "box": np.array([[row[2], row[3], 0, 0.5, 0.5, 1.8, 0.3] for row in rows]),
    }
    return found | ({"score": np.array([row[4] for row in rows])} if scored else {})


TRUTH = columns(
    (0, "Pedestrian", 10.0, 0.0), (0, "Pedestrian", 30.0, 0.0), (1, "Sedan", 20.0, 5.0)
)
FOUND = columns(
    (0, "Pedestrian", 10.8, 0.3, 0.9),  # near the first
    (0, "Pedestrian", 10.1, 0.0, 0.5),  # nearer, and too late
    (0, "Sedan", 30.0, 0.0, 0.8),  # of another class
    (1, "Pedestrian", 10.0, 0.0, 0.7),  # in another frame
    (0, "Pedestrian", 30.0, -2.5, 0.6),
    scored=True,
)


def test_a_report_gives_two_tables(tmp_path: pathlib.Path) -> None:
    np.savez(tmp_path / "ground_truth.npz", **TRUTH)
    np.savez(tmp_path / "predictions.npz", **FOUND)
    (tmp_path / "frames.json").write_text(json.dumps({"frame": [0, 1]}))
    within = [word for x in ("0.2", "1", "3") for word in ("--within", x)]
    result = CliRunner().invoke(center_distance.main, [str(tmp_path), *within])
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    # One of two objects at the fourth prediction; at the first; both, at the first and third.
    assert "Pedestrian 2 12.5 50.0 83.3" in lines
    none = "0 % 0 % 0 % 0 %"  # 0.5 m wide
    assert f"Pedestrian 0-20 m 1 1 0.80 0.30 {none}" in lines
    assert "Pedestrian 20-40 m 1 1 0.00 2.50 0 % 0 % 100 % 0 %" in lines
