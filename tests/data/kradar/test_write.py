import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.data.kradar import conditions, folders, write
from radejax.data.kradar.labels import LABEL_CLASSES, VERSIONS, Label, read_label_file

position, extent = [st.floats(-200, 200)] * 3, [st.floats(1e-3, 40)] * 3
labels = st.builds(
    Label,
    st.sampled_from(LABEL_CLASSES),
    st.tuples(*position, *extent, st.floats(-8.0, 8.0)),
    st.sampled_from(["R", "L", "L1", "LL"]),
    st.integers(-1, 500),
)


@settings(deadline=None, max_examples=30)
@given(objects=st.lists(labels, max_size=4), version=st.sampled_from(VERSIONS))
def test_labels_survive_writing_and_reading(tmp_path_factory, objects, version):
    path = tmp_path_factory.getbasetemp() / "round_trip" / "00033_00001.txt"
    write.write_labels(path, (33, 1, 2, 3, 4), 1643292946.71, objects, version)
    file = read_label_file(path, version)
    assert (file.header.radar, file.header.camera_lrr) == (33, 4)
    assert file.header.timestamp_s == pytest.approx(1643292946.71, abs=1e-6)
    assert len(file.labels) == len(objects)
    for found, wanted in zip(file.labels, objects, strict=True):
        assert found.cls == wanted.cls
        assert found.box[:6] == wanted.box[:6]  # halving and doubling are exact
        assert found.box[6] == pytest.approx(wanted.box[6], abs=1e-14)
        assert found.track_id == wanted.track_id
        if version in ("v1.1", "v2.1"):
            assert found.visibility == wanted.visibility


def test_calibration_description_and_splits_survive(tmp_path):
    write.write_calibration(tmp_path / "c.txt", 32, -2.54, np.float64(0.3))
    assert folders.read_calibration(tmp_path / "c.txt") == (32, -2.54, 0.3)
    write.write_description(tmp_path / "d.txt", "urban", "night", "heavysnow")
    expected = conditions.Conditions("urban", "night", "heavysnow")
    assert conditions.read_description(tmp_path / "d.txt") == expected
    write.write_splits(tmp_path, [(1, "00033_00001")], [(2, "00034_00002")])
    assert folders.read_split(tmp_path / "train.txt") == [(1, "00033_00001")]
    assert folders.read_split(tmp_path / "test.txt") == [(2, "00034_00002")]


@pytest.mark.parametrize("compress", [False, True])
def test_tesseract_is_what_matlab_writes(tmp_path, compress):
    tesseract = np.random.default_rng(0).random((3, 4, 2, 5), np.float32)
    path = tmp_path / "a/tesseract_00001.mat"
    write.write_tesseract(path, tesseract, compress=compress)
    stored = scipy.io.loadmat(path)["arrDREA"]
    np.testing.assert_array_equal(stored, tesseract)
    assert stored.dtype == np.float32
    assert stored.flags.f_contiguous
    first = path.read_bytes()
    write.write_tesseract(path, tesseract, compress=compress)
    assert path.read_bytes() == first  # no date in it
