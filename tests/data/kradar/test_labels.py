import math
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.core.errors import DataError, UserError
from radejax.data.kradar.labels import (
    VERSIONS,
    normalize_version,
    parse_label_file,
    read_labels,
)

HEADER = (
    "* idx(tesseract_os2-64_cam-front_os1-128_cam-lrr)=00033_00001_00002_00003_00004, "
    "timestamp=1643292946.710046076"
)
BOX = "10.5, -2.25, 0.5, 90.0, 2.0, 1.0, 0.75"
LINES = {
    "v1.0": f"*, 4, -1, Sedan, {BOX}",
    "v1.1": f"*, L, 4, -1, Sedan, {BOX}",
    "v2.0": f"*, 4, Sedan, {BOX}",
    "v2.1": f"*, L, 4, Sedan, {BOX}",
}


def parse(text: str, version: str = "v2.1", **options):
    return parse_label_file(text.encode(), version, where="f.txt", **options)


# Numbers worked out by hand --------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
def test_one_object_of_every_version(version):
    (label,) = parse(f"{HEADER}\n{LINES[version]}\n", version).labels
    assert label.cls == "Sedan"
    assert label.box == (10.5, -2.25, 0.5, 4.0, 2.0, 1.5, math.pi / 2)
    assert label.visibility == ("L" if version in ("v1.1", "v2.1") else "R")
    assert label.track_id == 4
    assert label.previous_track_id == (-1 if version.startswith("v1") else None)


def test_header_of_the_data_set():
    header = parse(HEADER).header
    numbers = (header.radar, header.lidar, header.camera_front)
    assert numbers == (33, 1, 2)
    assert (header.lidar_long, header.camera_lrr) == (3, 4)
    assert header.timestamp_s == pytest.approx(1643292946.710046, abs=1e-6)


def test_header_of_the_annotation_tool():
    text = (
        "* radar idx: 00857, lidar idx: 00834, camera idx: 02499, time: 1643184534.69,"
        f" prev lidar idx: -1, sequence: 9\r\n*, 0, -1, Sedan, {BOX}"
    )
    file = parse(text, "v1.0")
    assert (file.header.radar, file.header.lidar) == (857, 834)
    assert file.header.lidar_long is None
    assert len(file.labels) == 1


def test_object_on_the_header_line():
    text = f"{HEADER}{LINES['v2.0']}\n{LINES['v2.0'].replace('4,', '5,', 1)}"
    assert [label.track_id for label in parse(text, "v2.0").labels] == [4, 5]


def test_single_id_of_version_1_0():
    (label,) = parse(f"{HEADER}\n*, 7, Sedan, {BOX}", "v1.0").labels
    assert (label.track_id, label.previous_track_id) == (7, None)


@pytest.mark.parametrize("version", ["v1.0", "v1.1"])
def test_disabled_objects_are_skipped_and_counted(version):
    line = LINES[version]
    file = parse(f"{HEADER}\n#{line[1:]}\n{line}\n", version)
    assert (len(file.labels), file.num_unstarred) == (1, 1)
    text = f"{HEADER}\n#{line[1:]}\n{line}\n# no, object\n"
    file = parse(text, version, include_unstarred=True)
    assert (len(file.labels), file.num_unstarred) == (2, 1)
    assert file.labels[0] == file.labels[1]


@pytest.mark.parametrize(
    "text",
    [
        HEADER,
        HEADER + "\n",
        HEADER + " \n" + LINES["v2.1"] + "\n",
        HEADER + "\r\n" + LINES["v2.1"] + "\r\n",
        "\ufeff" + HEADER + "\n\n" + LINES["v2.1"],
        HEADER + "\n" + LINES["v2.1"].replace(", ", ","),
        HEADER + "\n" + LINES["v2.1"].replace("0.5", "5e-1").replace("90.0", "90"),
    ],
)
def test_oddities_are_read(text):
    labels = parse(text).labels
    assert len(labels) == ("Sedan" in text)
    assert all(label.box[2] == 0.5 for label in labels)


# Bad input --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"f\.txt:1: the file is empty"),
        ("hello", r"f\.txt:1: 'hello' is not a header"),
        (LINES["v2.1"], r"f\.txt:1: .* is not a header"),
        (HEADER.replace("_00004", ""), r"f\.txt:1: .* is not a header"),
        (HEADER[:-9] + ".1.2", r"f\.txt:1: .* is not a header"),
        (HEADER.replace("00033", "9" * 5000), r"f\.txt:1: .* is not a header"),
        (HEADER.replace("1643292946.", "9" * 400), r"f\.txt:1: .* is not a header"),
        (HEADER.replace("00033", "٠٠٠٣٣"), r"f\.txt:1: .* is not a header"),
        (f"{HEADER}\n\n{LINES['v2.0']}", r"f\.txt:3: .* has the layout of v1\.0"),
        (f"{HEADER}\nL, 4, Sedan, {BOX}", r"f\.txt:2: .* not an object line of v2\.1"),
        (f"{HEADER}\n*, L, 4, Sedan, 1, 2, 3", r"f\.txt:2: 7 fields"),
        (f"{HEADER}\n*, L, 4, Sedam, {BOX}", r"f\.txt:2: class 'Sedam' is unknown"),
        (f"{HEADER}\n*, L, 4, Sedan, {BOX[:-4]}nan", r"f\.txt:2: 11 fields .*nan"),
        (f"{HEADER}\n*, L, 4, Sedan, {BOX[:-4]}1_0", r"f\.txt:2: 11 fields .*1_0"),
        (f"{HEADER}\n*, L, 4, Sedan, {BOX[:-4]}1e999", r"f\.txt:2: box .* positive"),
        (f"{HEADER}\n*, L, 4, Sedan, {BOX[:-4]}-1.0", r"f\.txt:2: box .* positive"),
        (f"{HEADER}\n*, L, 4, Sedan, 1e308{BOX[4:]}", r"f\.txt:2: box .* up to 10000"),
        (f"{HEADER}\n*, L, 4, Sedan, {'9' * 5000}{BOX[4:]}", r"50\d\d characters"),
        (f"{HEADER}\n*, L, {'9' * 500}, Sedan, {BOX}", r"f\.txt:2: 11 fields"),
        (f"{HEADER}\n*, L, x, Sedan, {BOX}", r"is not an object line of v2\.1"),
    ],
)
def test_malformed_files_name_file_and_line(text, message):
    with pytest.raises(DataError, match=message):
        parse(text)


def test_numbers_of_64_kb_take_no_time():
    text = f"{HEADER}\n*, L, 4, Sedan, {'1' * 65536}x, 2"
    text += f"\n*, L, 4, Sedan{' ' * 65536}x"
    problems: list[str] = []
    began = time.process_time()
    parse(text, problems=problems)
    assert time.process_time() - began < 1
    assert len(problems) == 2


def test_undecodable_file_names_the_line():
    with pytest.raises(DataError, match=r"f\.txt:2: byte 0xff is not UTF-8"):
        parse_label_file(HEADER.encode() + b"\n*, \xff", where="f.txt")


def test_lenient_reading_reports_and_goes_on():
    problems: list[str] = []
    text = f"{HEADER}\n*, nonsense\n{LINES['v2.1']}\n*, L, 1"
    file = parse(text, problems=problems)
    assert len(file.labels) == 1
    assert [problem.split(" ")[0] for problem in problems] == ["f.txt:2:", "f.txt:4:"]
    assert problems[0].startswith("f.txt:2: 2 fields")


def test_missing_file_folder_and_version(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.txt: no such label file"):
        read_labels(tmp_path / "none.txt")
    with pytest.raises(DataError, match="is a folder"):
        read_labels(tmp_path)
    with pytest.raises(UserError, match=r"'v3' does not exist; choose from v1\.0"):
        read_labels(tmp_path / "none.txt", "v3")
    assert normalize_version("2.1") == normalize_version("V2_1") == "v2.1"


# Properties -------------------------------------------------------------------------

PIECES = st.sampled_from(
    [
        *(
            HEADER,
            *LINES.values(),
            "\n",
            "\r\n",
            ",",
            ", ",
            "*",
            "#",
            "Sedan",
            "R",
            "1",
        ),
        *("1e5", "nan", "\ufeff", "\x00", "é", " ", "\t", "\x1c", "\u2028", "٣", "-"),
    ]
)


@settings(deadline=None, max_examples=300)
@given(
    content=st.one_of(
        st.binary(max_size=200),
        st.text(max_size=200).map(str.encode),
        st.lists(PIECES, max_size=12).map("".join).map(str.encode),
        st.lists(PIECES, max_size=8).map(
            lambda x: (HEADER + "\n" + "".join(x)).encode()
        ),
        st.text(max_size=80).map(lambda x: x.encode("utf-16")),
    ),
    version=st.sampled_from(VERSIONS),
)
def test_fuzzed_files_never_crash(content, version):
    problems: list[str] = []
    try:
        strict = parse_label_file(content, version)
    except DataError:
        strict = None
    try:
        lenient = parse_label_file(content, version, problems=problems)
    except DataError:
        assert strict is None  # nothing but a damaged header stops lenient reading
        return
    assert (strict is None) == bool(problems)
    for label in lenient.labels:
        assert all(math.isfinite(value) for value in label.box)
        assert min(label.box[3:6]) > 0


# The reference data -----------------------------------------------------------------


def test_real_examples_of_every_version(shared):
    folder = shared / "data/kradar/label_examples"
    counts = {
        "v1_0.txt": 10,
        "v1_0_tool_header.txt": 6,
        "v1_1_constructed.txt": 10,
        "v2_0.txt": 11,
        "v2_0_merged_header.txt": 1,
        "v2_1.txt": 11,
        "v2_1_trailing_space.txt": 1,
        "v2_1_header_only.txt": 0,
    }
    for name, count in counts.items():
        assert len(read_labels(folder / name, name[:4])) == count, name
    # The same boxes in two revisions, apart from the flag.
    old = [label.box for label in read_labels(folder / "v1_0.txt", "v1.0")]
    new = read_labels(folder / "v1_1_constructed.txt", "v1.1")
    assert old == [label.box for label in new]
