"""Data folders of a run: found, checked, projected once."""

import pathlib

import pytest

from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.data.records.projections import RecordSource
from radejax.runs.data import DataPaths, OtherData, prepare_data
from radejax.simulation.dataset import default_config, simulate_dataset


def test_without_data_and_simulation_the_flag_is_named() -> None:
    with pytest.raises(UserError, match=r"give --data ROOT"):
        prepare_data(base_config(), data=None, labels=None, records=None)


@pytest.mark.parametrize("missing", ["data", "camera_calibration"])
def test_a_missing_folder_is_named(missing: str, tmp_path: pathlib.Path) -> None:
    nowhere = str(tmp_path / "nowhere")
    given = {"data": [str(tmp_path)]} | {
        missing: [nowhere] if missing == "data" else nowhere
    }
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*nowhere"):
        prepare_data(base_config(), labels=None, records=None, **given)


@pytest.mark.parametrize("data", [[], [""], "/data/kradar"])
def test_no_list_of_folders_is_an_error(data: object) -> None:
    with pytest.raises(UserError, match="must be a list of folders"):
        prepare_data(base_config(), data=data, labels=None, records=None)


def test_frames_are_projected_beside_their_data_once(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = default_config()
    simulation.update(train_sequences=1, test_sequences=1, frames_per_sequence=2)
    simulation["output"] = "projection"
    simulate_dataset(simulation, tmp_path / "sim", progress=False)
    monkeypatch.chdir(tmp_path)

    def prepare() -> DataPaths:
        return prepare_data(base_config(), data=["sim"], labels=None, records=None)

    paths = prepare()
    assert paths.roots == (str(tmp_path / "sim"),)
    assert paths.records == str(tmp_path / "sim" / "records")
    assert len(RecordSource(paths.records)) == 4
    assert len(paths.open(base_config(), "test")) == 2

    def written() -> dict[pathlib.Path, int]:
        files = (tmp_path / "sim" / "records").iterdir()
        return {p: p.stat().st_mtime_ns for p in files if p.suffix != ".json"}

    before = written()
    assert prepare() == paths
    assert written() == before


def test_other_data_keep_what_the_run_had_of_the_same_folders(
    tmp_path: pathlib.Path,
) -> None:
    own = DataPaths((str(tmp_path),), "l", "/fast/records", embeddings="/embeddings")
    for data in ((), (str(tmp_path),)):
        found = OtherData(data=data, labels=str(tmp_path / "v2.zip")).paths(own)
        assert found.records == "/fast/records"
        assert found.embeddings == "/embeddings"
        assert found.labels == str(tmp_path / "v2.zip")
    (tmp_path / "b").mkdir()
    other = OtherData(data=(str(tmp_path / "b"),)).paths(own)
    assert other == DataPaths((str(tmp_path / "b"),), None, str(tmp_path / "b/records"))
    with pytest.raises(UserError, match="must be a list of folders"):
        OtherData(labels="x").paths(None)


def test_results_on_other_data_are_named_by_folder_and_labels(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kradar").mkdir()
    monkeypatch.chdir(tmp_path / "kradar")
    assert OtherData(data=("..",)).name == tmp_path.name
    assert OtherData(data=(".",)).name == "kradar"
    assert OtherData(data=("/a/b", "/c"), labels="/x/v1.zip").name == "b_v1"
    assert OtherData(labels="/x/v1.zip").name == "v1"
    assert OtherData(label_version="v1.1").name == "other"
