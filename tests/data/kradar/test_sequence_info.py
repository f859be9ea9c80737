import pathlib

import pytest

from radejax.data.kradar import write
from radejax.data.kradar.findings import Findings
from radejax.data.kradar.folders import SequenceFolder
from radejax.data.kradar.sequences import camera_folders, read_sequence_info


@pytest.fixture
def read(tmp_path):
    def function(number=1, folder=tmp_path, **options):
        findings = Findings(strict=False)
        info = read_sequence_info(
            number,
            None if folder is None else SequenceFolder([folder]),
            findings,
            **{
                "radar_from_lidar": None,
                "z_offset_m": 0.7,
                "camera_folders": [tmp_path],
                **options,
            },
        )
        return info, findings

    return function


def test_own_files_come_first(read, tmp_path):
    calibration = tmp_path / "info_calib/calib_radar_lidar.txt"
    write.write_calibration(calibration, 1, -2.0, 0.5)
    write.write_description(tmp_path / "description.txt", "a", "b", "c")
    (tmp_path / "seq_01").mkdir()
    (tmp_path / "seq_01/cam_1.yml").write_text("")
    info, findings = read()
    assert info.radar_from_lidar_m == (-2.0, 0.5, 0.7)
    assert info.conditions.weather == "c"
    assert info.camera_calibration_path == tmp_path / "seq_01/cam_1.yml"
    assert not findings.problems
    assert not findings.counts


def test_a_misspelt_weather_is_reported(read, tmp_path):
    for weather, count in (("fog", 0), ("fogg", 1)):
        write.write_description(tmp_path / "description.txt", "urban", "day", weather)
        info, findings = read()
        assert info.conditions.weather == weather
        assert len(findings.notes) == count
    assert "weather 'fogg' is none of K-Radar's: normal, " in findings.notes[0]


def test_what_is_not_there_is_filled_in_and_counted(read):
    info, findings = read(number=38)
    assert info.radar_from_lidar_m == (-2.54, 0.3, 0.7)
    assert info.conditions.weather == "fog"
    assert info.camera_calibration_path is None
    assert findings.counts["sequences with the default calibration"] == 1
    assert findings.counts["sequences with built-in conditions"] == 1
    assert findings.summary().problem_counts() == {"calibration missing": 1}
    # Without folders there is no file to miss.
    info, findings = read(number=99, folder=None)
    assert info.conditions.weather == "unknown"
    assert not findings.problems
    assert findings.counts["sequences with the default calibration"] == 1


def test_an_offset_given_by_hand_replaces_the_file(read):
    info, findings = read(radar_from_lidar=(1, 2))
    assert info.radar_from_lidar_m == (1.0, 2.0, 0.7)
    assert not findings.problems


def test_where_camera_calibrations_are_looked_for():
    folders = camera_folders([pathlib.Path("r")], [pathlib.Path("own")])
    assert [str(folder) for folder in folders] == [
        "own",
        "r/calib",
        "r/cam_calib",
        "r/resources/cam_calib",
    ]
