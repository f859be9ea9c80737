"""The example of another radar: its reader, its config, and a whole run."""

import json
import pathlib
import re

import numpy as np
import own_radar
import pytest
from click.testing import CliRunner
from own_radar import GRID, OwnRadar

from radejax.core.errors import DataError, UserError
from radejax.data.options import DataOptions
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB
from radejax.data.records import preprocess

# 10 m ahead of the radar and 2 m to the left of its boresight, with its heading.
COS, SIN = np.cos(own_radar.MOUNTING_YAW_RAD), np.sin(own_radar.MOUNTING_YAW_RAD)
X, Y, Z = np.add(own_radar.MOUNTING_M, (10 * COS - 2 * SIN, 10 * SIN + 2 * COS, 0.3))
YAW_DEG = np.rad2deg(own_radar.MOUNTING_YAW_RAD)
BOX = f"{X},{Y},{Z},4,1.8,1.6,{YAW_DEG}"


def write(root: pathlib.Path, lines: list[str], power: np.ndarray) -> pathlib.Path:
    (root / "radar").mkdir()
    for stem in ("0004_0001", "0005_0001"):
        np.save(root / "radar" / f"{stem}.npy", power)
    head = ",".join(("frame", "class", *own_radar.FIELDS))
    (root / "boxes.csv").write_text("\n".join([head, *lines]) + "\n")
    return root


def read(root: pathlib.Path) -> OwnRadar:
    return OwnRadar.from_options(DataOptions(roots=(str(root),)), own_radar.CLASSES)


@pytest.fixture
def power() -> np.ndarray:
    return np.random.default_rng(0).exponential(1e7, (64, 48, 16))


def test_boxes_are_in_the_radar_frame_and_power_in_decibels(
    tmp_path: pathlib.Path, power: np.ndarray
) -> None:
    lines = [f"0004_0001,car,{BOX}", f"0004_0001,pedestrian,{BOX}", f"9_1,car,{BOX}"]
    root = write(tmp_path, lines, power)
    frames = read(root).with_valid_boxes(own_radar.CLASSES)
    assert frames.summary().counts["objects left out: class 'pedestrian'"] == 1
    assert frames[0].classes.tolist() == ["car"]
    np.testing.assert_allclose(
        frames[0].boxes, [[10, 2, 0.3, 4, 1.8, 1.6, 0]], atol=1e-9
    )
    assert frames[1].boxes.shape == (0, 7)
    counts = frames.summary().counts
    assert counts["frames of boxes.csv without a radar file"] == 1
    assert [frame.key for frame in frames.of_split("train")] == ["4/0001"]
    assert [frame.key for frame in frames.of_split("test")] == ["5/0001"]
    with pytest.raises(UserError, match="split is 'val', expected train or test"):
        frames.of_split("val")
    projection = frames[0].read_projection(GRID)
    assert projection.shape == GRID.projection_shape == (64, 48, 16)
    level = (10 * np.log10(power) + LOG_OFFSET_DB) / LOG_SCALE_DB
    np.testing.assert_allclose(projection, level, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda power: 10 * np.log10(power + 2), "values are between 1 and 300, as in"),
        (lambda power: power - 1e7, "as 'power': some values are negative"),
        (np.sqrt, "as if values were 'amplitude'"),
        (lambda power: power[:, :40], r"shape \(64, 40, 16\), not \(64, 48, 16\)"),
    ],
)
def test_wrong_radar_files_are_skipped_with_the_reason(
    change, message: str, tmp_path: pathlib.Path, power: np.ndarray
) -> None:
    frames = read(write(tmp_path, [], change(power)))
    report = preprocess(frames, tmp_path / "records", progress=False)
    assert len(report.skipped) == 2
    assert all(re.search(message, reason) for reason in report.skipped.values())


def test_a_wrong_line_is_named(tmp_path: pathlib.Path, power: np.ndarray) -> None:
    lines = [f"0004_0001,car,{BOX}", f"0004_0001,car,east{BOX}"]
    with pytest.raises(DataError, match=r"boxes.csv, line 3: .*convert string"):
        read(write(tmp_path, lines, power))


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
def test_a_simulated_recording_is_trained_evaluated_and_drawn(
    tmp_path: pathlib.Path,
) -> None:
    root, run = tmp_path / "data", tmp_path / "run"
    arguments = [str(root), "--workdir", str(run), "--drives", "120", "--epochs", "1"]
    result = CliRunner().invoke(own_radar.main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert len(list((root / "radar").glob("*.npy"))) == 120
    assert (root / "frame.png").stat().st_size > 10_000
    assert (run / "evaluation" / "scenes.png").stat().st_size > 10_000
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["options"]["classes"] == ["car", "truck"]
    # In every drive with a car, it is where the power is.
    frames = read(root)
    gains = []
    for frame in frames.with_valid_boxes(("car",)):
        level = frame.read_projection(GRID).max(-1)
        r, a = GRID.nearest_bin(frame.boxes[:, 0], frame.boxes[:, 1]).T
        near = [
            level[max(i - 2, 0) : i + 3, max(j - 1, 0) : j + 2]
            for i, j in zip(r, a, strict=True)
        ]
        gains += [patch.max() - np.median(level) for patch in near]
    assert np.median(gains) * LOG_SCALE_DB > 10  # decibels
