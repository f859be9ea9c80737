"""Data folders of a run: found, checked, projected once."""

import pathlib
import re
import shutil
from types import SimpleNamespace

import pytest

from radejax import models
from radejax.config import Config
from radejax.core.errors import UserError
from radejax.data.kradar import KRadar
from radejax.runs import data as run_data
from radejax.runs.data import data_of_run, located, open_data
from radejax.simulation.config import SimulationOptions

from .. import small_models as small


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Sequences 1 and 2 of the train split, 3 of the test split, of two frames."""
    sizes = {"train_sequences": 2, "test_sequences": 1, "frames_per_sequence": 2}
    return small.simulate(tmp_path_factory.mktemp("simulated") / "sim", **sizes)


@pytest.fixture
def root(simulated, tmp_path):
    return pathlib.Path(shutil.copytree(simulated, tmp_path / "sim"))


def _config(*roots, batch_size=1, **fields):
    return Config().replace(
        model={"doppler_bins": 16, "elevation_bins": 9},
        train={"batch_size": batch_size},
        data={"roots": tuple(map(str, roots)), **fields},
    )


def _open(config):
    return open_data(located(config))


def test_without_data_and_simulation_the_flag_is_named():
    with pytest.raises(UserError, match=r"give --data ROOT"):
        located(Config())


def test_a_missing_folder_is_named(tmp_path):
    nowhere = str(tmp_path / "nowhere")
    names = ("labels", "embeddings", "image_backbone", "camera_calibration")
    configs = [_config(tmp_path, **{name: nowhere}) for name in names]
    for config in (_config(nowhere), *configs):
        with pytest.raises(FileNotFoundError, match=r"no such file .*nowhere"):
            located(config)


def test_paths_are_absolute_and_simulations_named_by_their_config(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "v2.zip").touch()
    config = _config(labels="v2.zip").replace(simulation=SimulationOptions())
    here = located(config).data
    (root,) = here.roots
    assert root.startswith(str(tmp_path / "data" / "simulated-"))
    assert here.records == f"{root}/records"
    assert here.labels == str(tmp_path / "v2.zip")
    assert located(config.replace(simulation={"seed": 1})).data.roots != here.roots
    with pytest.raises(UserError, match="expected one folder, as the config simulates"):
        located(config.replace(data={"roots": ("a", "b")}))


def test_frames_are_projected_beside_their_data_once(root, monkeypatch, capsys, caplog):
    monkeypatch.chdir(root.parent)
    bins = _config("sim").replace(model={"doppler_bins": 64})
    nothing = _config("sim", batch_size=4, visibility=())
    for wrong, message in (
        (bins, "doppler_bins is 64, expected 16, as the rad"),
        (_config("sim", batch_size=5), "4 frames are fewer than one batch"),
        (nothing, "4 frames of the train split have no object of"),
    ):
        with pytest.raises(UserError, match=message):
            _open(wrong)
    assert not (root / "records").exists()
    config = _config("sim", batch_size=4)
    with caplog.at_level("INFO", "radejax"):
        data = _open(config)
        text = r"input: 0\.64\d ± 0\.04\d in the frames to train"
        assert re.search(text, caplog.text)
        assert "the network sees" not in caplog.text
    assert data.options.roots == (str(root),)
    assert data.options.records == str(root / "records")
    assert len(data.records.keys()) == 6
    assert len(data.split("test")) == 2

    def written():
        return {p: p.stat().st_mtime_ns for p in (root / "records").rglob("*.npy")}

    before = written()
    assert "preprocess: 100%" in capsys.readouterr().err
    _open(config)
    assert "preprocess" not in capsys.readouterr().err
    assert written() == before


def test_frames_of_the_splits_without_labels_are_counted(root, caplog):
    min(root.glob("1/info_label_v2_1/*")).unlink()
    shutil.rmtree(root / "3" / "info_label_v2_1")
    with caplog.at_level("INFO", "radejax"):
        _open(_config(root))
    assert "frames of the splits without labels: 1: 1/000" in caplog.text
    assert "1  sequences without labels" in caplog.text
    assert "split entries of sequences that are not here: 2" in caplog.text


def test_frames_without_a_radar_tensor_that_can_be_read_are_left_out(root, caplog):
    corrupted = next(frame for frame in KRadar(root) if frame.sequence == 1)
    corrupted.projection_path.write_bytes(b"half")
    with caplog.at_level("WARNING", "radejax"):
        data = _open(_config(root))
    assert "6 frames: 0 were done, 5 preprocessed, 1 skipped" in caplog.text
    assert corrupted.key not in [frame.key for frame in data.split("train")]
    assert len(data.split("all")) == len(data.records.keys()) == 5
    part = _open(_config(root, sequences=(1, 3)))  # the same records
    assert len(part.split("all")) == 3


def test_a_run_is_evaluated_on_its_part_or_on_all_of_other_folders(
    root, tmp_path, monkeypatch, caplog
):
    frames, copy = KRadar(root), str(shutil.copytree(root, tmp_path / "copy"))
    given = str(tmp_path / "copy")  # any folder that exists
    own = located(_config(root, sequences=(1, 3), labels=given, embeddings=given))
    saved = SimpleNamespace(config=own, grid=frames.grid)
    saved.model = models.build(own.model)
    with monkeypatch.context() as patch:
        patch.setattr(run_data, "Data", lambda *_: SimpleNamespace(frames=frames))
        chosen, _ = data_of_run(saved, {"roots": (str(root),), "label_version": "v2.0"})
        other, _ = data_of_run(saved, {"roots": (copy,)})
    assert (chosen.data.embeddings, chosen.data.sequences) == (given, (1, 3))
    assert (chosen.data.label_version, own.data.label_version) == ("v2.0", "v2.1")
    assert (other.data.embeddings, other.data.labels) == (None, None)
    assert other.data.records == f"{copy}/records"
    saved.config = own.replace(data={"labels": None, "embeddings": None})
    for changes, expected in (
        (None, {1, 3}),
        ({"label_version": "v2.1"}, {1, 3}),
        ({"sequences": (2,)}, {2}),
        ({"weather": tuple({frame.weather for frame in frames})}, {1, 3}),
        ({"roots": (copy,)}, {1, 2, 3}),
        ({"roots": (copy,), "sequences": (3,)}, {3}),
    ):
        _, found = data_of_run(saved, changes)
        assert {frame.sequence for frame in found.frames} == expected


def test_sequences_are_held_out_for_validation(root, caplog):
    with caplog.at_level("INFO", "radejax"):
        data = _open(_config(root, validation=(1,)))
    names = ("train", "validation", "test")
    found = [[f.sequence for f in data.split(name)] for name in names]
    assert found == [[2, 2], [1, 1], [3, 3]]
    assert data.choosing_split == "validation"
    assert "frames left out: held out for validation" in data.split("train").counts
    expected = "sequences 1 of the train split are held out, 2 frames beside 2 to train"
    assert expected in caplog.text
    with pytest.raises(UserError, match=r"sequences \[3\], which have no frames in"):
        _open(_config(root, validation=(3,)))
    data = _open(_config(root))
    assert (len(data.split("train")), data.choosing_split) == (4, "test")
    with pytest.raises(UserError, match="there is no validation split"):
        data.split("validation")
