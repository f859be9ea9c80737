import csv

import pytest

from radejax.core.errors import DataError
from radejax.data.kradar import sequences
from radejax.data.kradar.sequences import KRADAR_CONDITIONS, split_by_rule


def test_conditions_of_the_published_sequences(shared):
    with open(shared / "data/kradar/sequences.csv") as file:
        rows = list(csv.DictReader(file))
    assert sorted(KRADAR_CONDITIONS) == [int(row["seq"]) for row in rows]
    for row in rows:
        found = KRADAR_CONDITIONS[int(row["seq"])]
        assert (found.environment, found.time, found.weather) == (
            row["environment"],
            row["time"],
            row["weather"],
        )
    assert {row["weather"] for row in rows} == set(sequences.WEATHERS)


def test_rule_gives_alternating_quarters():
    names = [f"{i:05d}_00000" for i in range(10)]  # cuts at 2, 5, 7
    assert split_by_rule(names, "train") == names[:2] + names[5:7]
    assert split_by_rule(reversed(names), "test") == names[2:5] + names[7:]


def test_rule_equals_the_official_split(shared):
    folder = shared / "data/kradar/split"
    splits = {s: sequences.read_split(folder / f"{s}.txt") for s in ("train", "test")}
    names = {}
    for sequence, name in splits["train"] + splits["test"]:
        names.setdefault(sequence, []).append(name)
    for split, frames in splits.items():
        ruled = [(s, n) for s in sorted(names) for n in split_by_rule(names[s], split)]
        assert ruled == sorted(frames)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (
            sequences.read_calibration,
            "frame difference,x,y\n",
            r":2: the file ends here",
        ),
        (sequences.read_calibration, "", r":1: the file ends here"),
        (sequences.read_calibration, "h\n1,2", r":2: '1,2', expected three numbers"),
        (sequences.read_calibration, "h\n1.5,2,3", r":2: .* \(whole\)"),
        (sequences.read_calibration, "h\n1,nan,3", r":2: '1,nan,3'"),
        (sequences.read_description, "", r":1: '', expected 'environment"),
        (sequences.read_description, "urban,night", r":1: 'urban,night'"),
        (sequences.read_description, "urban,,fog", r":1: 'urban,,fog'"),
        (sequences.read_split, "1,00033_00001.txt\n1;x", r":2: '1;x', expected"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path, read, text, message):
    (tmp_path / "f.txt").write_text(text)
    with pytest.raises(DataError, match=r"f\.txt" + message):
        read(tmp_path / "f.txt")


@pytest.mark.parametrize(
    "read",
    [sequences.read_calibration, sequences.read_description, sequences.read_split],
)
def test_binary_files_are_data_errors(tmp_path, read):
    (tmp_path / "f.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"f\.txt:1: byte 0xff is not UTF-8"):
        read(tmp_path / "f.txt")


def test_readers_accept_what_is_on_the_disks(tmp_path):
    path = tmp_path / "f.txt"
    path.write_bytes(b"frame difference,x,y\r\n 32, -2.54, 0.3\r\n")
    assert sequences.read_calibration(path).dx_m == -2.54
    path.write_text("Urban, Day ,Normal")
    assert sequences.read_description(path).environment == "urban"
    path.write_text("1,00033_00001.txt\n2,00034_00002.txt")
    assert sequences.read_split(path) == [(1, "00033_00001"), (2, "00034_00002")]
