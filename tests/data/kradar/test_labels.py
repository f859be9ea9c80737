import math
import re

import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar.labels import (
    VERSIONS,
    LabelHeader,
    normalize_version,
    read_label_file,
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


@pytest.fixture(scope="module")
def parse(tmp_path_factory):
    """Reads text, or bytes, as a label file."""
    path = tmp_path_factory.mktemp("labels") / "f.txt"

    def read(content, version="v2.1", **options):
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return read_label_file(path, version, **options)

    return read


# Numbers worked out by hand --------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
def test_one_object_of_every_version(parse, version):
    (label,) = parse(f"{HEADER}\n{LINES[version]}\n", version).labels
    assert label.cls == "Sedan"
    assert label.box == (10.5, -2.25, 0.5, 4.0, 2.0, 1.5, math.pi / 2)
    assert label.visibility == ("L" if version in ("v1.1", "v2.1") else "R")
    assert label.track_id == 4


def test_headers_of_the_data_set_and_of_the_annotation_tool(parse):
    header = parse(HEADER).header
    time_s = pytest.approx(1643292946.710046, abs=1e-6)
    assert header == LabelHeader(time_s, 33, 1, 2, 3, 4)
    text = (
        "* radar idx: 00857, lidar idx: 00834, camera idx: 02499, time: 1643184534.69,"
        f" prev lidar idx: -1, sequence: 9\r\n*, 0, -1, Sedan, {BOX}"
    )
    file = parse(text, "v1.0")
    assert file.header == LabelHeader(1643184534.69, 857, 834, 2499)
    assert len(file.labels) == 1


def test_object_on_the_header_line_and_single_id_of_version_1_0(parse):
    text = f"{HEADER}{LINES['v2.0']}\n{LINES['v2.0'].replace('4,', '5,', 1)}"
    for version in ("v1.0", "v2.0"):
        assert [label.track_id for label in parse(text, version).labels] == [4, 5]


@pytest.mark.parametrize("version", ["v1.0", "v1.1"])
def test_disabled_objects_are_skipped_and_counted(parse, version):
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
def test_oddities_are_read(parse, text):
    labels = parse(text).labels
    assert len(labels) == ("Sedan" in text)
    assert all(label.box[2] == 0.5 for label in labels)


# Bad input --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' is not a header"),
        (LINES["v2.1"], "is not a header"),
        (HEADER.replace("00033", "9" * 5000), "is not a header"),
        (HEADER.encode() + b"\n*, \xff", r"f\.txt:2: byte 0xff is not UTF-8"),
        (bytes(1 << 19), "more than 262144 bytes"),
    ],
)
def test_files_that_are_no_label_files_are_errors(parse, text, message):
    with pytest.raises(DataError, match=message):
        parse(text)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (LINES["v2.0"], r".* expected \*, visibility, track_id, cls, x, y, z"),
        (f"L, 4, Sedan, {BOX}", ".* is not an object of v2.1 labels"),
        (f"*, L, 4, Sedam, {BOX}", "'.*Sedam.*' is not an object"),
        (f"*, L, 4, Sedan, {BOX[:-4]}nan", ".* is not an object"),
        (f"*, L, 4, Sedan, {BOX[:-4]}1e999", "box .* positive"),
        (f"*, L, 4, Sedan, {BOX[:-4]}-1.0", "box .* positive"),
        (f"*, L, 4, Sedan, {'9' * 5000}{BOX[4:]}", "box .* up to 10000"),
    ],
)
def test_malformed_lines_are_skipped_and_described(parse, line, message):
    file = parse(f"{HEADER}\n{line}\n\n{LINES['v2.1']}\n{line}")
    assert len(file.labels) == 1
    assert len(file.problems) == 2
    assert re.search(rf"/f\.txt:2: {message}", file.problems[0])
    assert "/f.txt:5: " in file.problems[1]


def test_missing_and_malformed_files_and_versions(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.txt"):
        read_labels(tmp_path / "none.txt")
    (tmp_path / "a.txt").write_text(f"{HEADER}\n*, nonsense\n")
    with pytest.raises(DataError, match=r"a\.txt:2: '\*, nonsense' is not an object"):
        read_labels(tmp_path / "a.txt")
    with pytest.raises(UserError, match=r"'v3' does not exist; choose from v1\.0"):
        read_labels(tmp_path / "none.txt", "v3")
    assert normalize_version("2.1") == normalize_version("V2_1") == "v2.1"


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
