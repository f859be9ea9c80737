"""Own scenes: what the file says is what is simulated, and wrong files are named."""

import csv
import pathlib
import re
import runpy

import numpy as np
import pytest

import radejax
from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES, Boxes
from radejax.inference import detect_files
from radejax.simulation.config import SimulationOptions
from radejax.simulation.simulator import LabelSource
from radejax.simulation.world.own_scenes import SceneObject, read_scenes, write_scenes

PAGE = pathlib.Path(__file__).resolve().parents[3] / "docs" / "simulator.md"
BOX = "4.5,1.9,1.6"
HEAD = "frame,cls,x,y,z,l,w,h,yaw,track_id,vx_mps,vy_mps,ego_speed_mps,weather"
ROWS = [
    f"2/1,Sedan,30,1,-1.2,{BOX},0.1,7,,,5,rain",
    f"2/0,Sedan,31,1,-1.2,{BOX},0.1,7,,,4,rain",  # rows need no order
    f"2/0,Sedan,9,-3,-1.2,{BOX},0,-1,2.5,-1,4,rain",
    f"2/1,Bicycle,9,3,-1.2,{BOX},0,-1,,,5,rain",
]


def write(folder, lines):
    path = folder / "scenes.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_scene_has_the_boxes_velocities_and_conditions_of_the_file(tmp_path):
    path = write(tmp_path, [HEAD, *ROWS])
    source = LabelSource(SimulationOptions(scenes=str(path)))
    assert source.numbers == [2]
    assert source.conditions(2) == ("urban", "day", "rain")
    specs = source.frames(2)
    assert [spec.name for spec in specs] == ["00000_00000", "00001_00001"]
    assert [spec.timestamp_s for spec in specs] == [0.0, 0.1]
    sequence = source.make(2)
    assert sequence.ground_m == pytest.approx(-1.3)  # lower sides of the boxes
    assert sequence.ego_speed_mps.tolist() == [4.0, 5.0]
    first = sequence.frame(0)
    order = np.argsort(first.boxes[:, 0])
    # z of the file is the LiDAR's, which is 0.7 m above the radar.
    expected = [[9, -3, -0.5, 4.5, 1.9, 1.6, 0.0], [31, 1, -0.5, 4.5, 1.9, 1.6, 0.1]]
    np.testing.assert_allclose(first.boxes[order], expected, atol=1e-9)
    # Given; and by the positions of the track, 1 m nearer after 0.1 s.
    velocity = first.relative_velocity_mps[order]
    np.testing.assert_allclose(velocity, [[2.5, -1.0], [-10.0, 0.0]], atol=1e-9)
    # A bicycle without velocity and track.
    last = sequence.frame(1)
    still = last.relative_velocity_mps[last.cls == CLASSES.index("Bicycle")]
    np.testing.assert_allclose(still, [[0.0, 0.0]], atol=1e-9)


def test_what_is_written_is_read(tmp_path):
    given = []
    for row in csv.DictReader([HEAD, *ROWS]):
        given.append(SceneObject(**{name: x for name, x in row.items() if x}))
    write_scenes(tmp_path / "again.csv", given)
    read = read_scenes(tmp_path / "again.csv")
    assert read == [given[1], given[2], given[0], given[3]]
    assert [one.model_fields_set for one in read[:1]] == [given[1].model_fields_set]


def test_predictions_are_scenes(tmp_path, caplog):
    boxes = Boxes.one_frame([[20.0, 1, 0, 4, 2, 1.5, 0.3]], ["Sedan"], [0.5])
    detect_files._write_csv(tmp_path / "boxes.csv", [boxes], ["3/00033_00001"])
    (one,) = read_scenes(tmp_path / "boxes.csv")
    assert one.numbers == (3, 33, 1)
    assert (one.cls, one.x, one.yaw) == ("Sedan", 20.0, 0.3)
    assert "boxes.csv: columns score are not used" in caplog.text
    source = LabelSource(SimulationOptions(scenes=str(tmp_path / "boxes.csv")))
    assert [spec.name for spec in source.frames(3)] == ["00033_00001"]
    center_m = source.make(3).frame(0).boxes[0, :3]
    np.testing.assert_allclose(center_m, [20.0, 1.0, 0.7])  # from the radar


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEAD, f"2/0,Sedan,east,1,0,{BOX},0"], "line 2: column.x is 'east', expected a n"),
        ([HEAD, *ROWS, f"2/1,car,3,1,0,{BOX},0"], "line 6: column.cls is 'car', expected 'S"),
        ([HEAD, f"2/0,Sedan,3,1,0,{BOX},90"], "line 2: column.yaw is '90', expected a number"),
        ([HEAD, ROWS[0] + "y"], "line 2: column.weather is 'rainy', expected 'normal'"),
        ([HEAD, ROWS[0], f"2/1,Sedan,3,1,0,{BOX},0,,,,6,rain"], r"line 3: .*'ego_speed_mps': 6.0"),
        ([HEAD, ROWS[0], f"2/1,Sedan,3,1,0,{BOX},0,,,,5,fog"], r"line 3: .*'fog'.*'rain'"),
    ],
)  # fmt: skip
def test_wrong_rows_are_named(lines, message, tmp_path):
    with pytest.raises(DataError, match=f"scenes.csv, {message}"):
        read_scenes(write(tmp_path, lines))


def test_wrong_choices_are_errors(tmp_path):
    path = str(write(tmp_path, [HEAD, *ROWS]))
    with pytest.raises(UserError, match=r"scenes.csv: no frames of \(5,\)"):
        LabelSource(SimulationOptions(scenes=path, sequences=(5,)))
    with pytest.raises(UserError, match=r"frames_per_sequence is 3, expected 0, all"):
        SimulationOptions(scenes=path, frames_per_sequence=3)
    with pytest.raises(UserError, match=r"scenes.csv is 'empty', expected a row per"):
        read_scenes(write(tmp_path, [HEAD]))


def test_people_near_an_indoor_radar_are_in_most_frames(tmp_path, monkeypatch, capsys):
    """The example of the page, as it is."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    (code,) = (block for block in blocks if "write_scenes" in block)
    monkeypatch.chdir(tmp_path)
    pathlib.Path("indoor.py").write_text(code)
    names = runpy.run_path("indoor.py", run_name="__main__")
    assert re.search(r"\d+ of \d+ people seen", capsys.readouterr().out)
    frames = names["frames"]
    seen = [len(frame.boxes) for frame in frames]
    assert len(seen) == 40
    assert np.mean(np.array(seen) > 0) > 0.9
    assert sum(seen) > 0.8 * len(names["people"])
    # Echoes are where the people are: on their near sides.
    grid, excess = frames.grid, []
    assert grid.shape_drea == (16, 200, 1, 32)
    for frame in frames:
        level = frame.read_projection(grid).max(-1)
        distance = np.hypot(frame.boxes[:, 0], frame.boxes[:, 1])
        r, a = grid.nearest_bin(frame.boxes[:, 0], frame.boxes[:, 1]).T
        for i, j in zip(r[distance > 2], a[distance > 2], strict=True):
            near = level[max(i - 8, 0) : i + 4, max(j - 1, 0) : j + 2].max()
            excess.append(near - np.median(level[i]))
    assert np.median(excess) * 184.3 > 6  # decibels
    # The dataset is that of the file's content.
    lines = pathlib.Path("people.csv").read_text().splitlines()
    write(tmp_path, lines[:-1]).rename("people.csv")
    with pytest.raises(UserError, match=r"data/people holds .*scenes_sha256"):
        radejax.simulate(names["options"], "data/people")
