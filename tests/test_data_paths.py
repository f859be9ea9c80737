"""Data folders of a run: found, checked, projected once."""

import pathlib

import pytest

from radejax.config import base_config
from radejax.data.records import RecordSource
from radejax.data_paths import prepare_data, project_data
from radejax.errors import UserError
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


def test_frames_are_projected_beside_their_data_once(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = default_config()
    simulation.update(train_sequences=1, test_sequences=1, frames_per_sequence=2)
    simulation["output"] = "projection"
    simulate_dataset(simulation, tmp_path / "sim", progress=False)
    monkeypatch.chdir(tmp_path)
    paths = project_data(base_config(), ["sim"])
    assert paths.roots == (str(tmp_path / "sim"),)
    assert paths.records == str(tmp_path / "sim" / "records")
    assert len(RecordSource(paths.records)) == 4
    assert len(paths.open(base_config(), "test")) == 2
    written = {p: p.stat().st_mtime_ns for p in (tmp_path / "sim/records").iterdir()}
    assert project_data(base_config(), ["sim"]) == paths
    found = {p: p.stat().st_mtime_ns for p in (tmp_path / "sim/records").iterdir()}
    assert {p: found[p] for p in written if p.suffix != ".json"} == {
        p: t for p, t in written.items() if p.suffix != ".json"
    }
