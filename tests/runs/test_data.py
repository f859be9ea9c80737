"""Data folders of a run: found, checked, projected once."""

import dataclasses
import pathlib
import shutil
from types import SimpleNamespace
from typing import Any

import pytest

from radejax import models
from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.data.kradar import KRadar
from radejax.data.records import preprocess
from radejax.runs.data import (
    Data,
    data_of_run,
    open_data,
)
from radejax.runs.sources import DataPaths, Sources
from radejax.simulation.dataset import default_config, simulate_dataset


def test_without_data_and_simulation_the_flag_is_named() -> None:
    with pytest.raises(UserError, match=r"give --data ROOT"):
        open_data(base_config(), None, Sources())


@pytest.mark.parametrize("missing", ["data", "camera_calibration"])
def test_a_missing_folder_is_named(missing: str, tmp_path: pathlib.Path) -> None:
    nowhere = str(tmp_path / "nowhere")
    given = {"data": (str(tmp_path),)} | {
        missing: (nowhere,) if missing == "data" else nowhere
    }
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*nowhere"):
        open_data(base_config(), None, Sources(**given))


@pytest.mark.parametrize("data", [[""], "/data/kradar"])
def test_no_list_of_folders_is_an_error(data: object) -> None:
    with pytest.raises(UserError, match="must be a list of folders"):
        open_data(base_config(), None, Sources(data=data))


def test_frames_are_projected_beside_their_data_once(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    simulation = default_config()
    simulation.update(train_sequences=1, test_sequences=1, frames_per_sequence=2)
    simulation["output"] = "projection"
    simulate_dataset(simulation, tmp_path / "sim", progress=False)
    monkeypatch.chdir(tmp_path)

    def prepare() -> Data:
        return open_data(config, models.build(config.model), Sources(data=("sim",)))

    config = base_config()
    with pytest.raises(
        UserError, match=r"64 Doppler.*doppler_bins=16 --config.model.elev"
    ):
        prepare()
    config.model.update(doppler_bins=16, elevation_bins=9)
    with pytest.raises(UserError, match="2 frames are fewer than one batch"):
        prepare()
    assert not (tmp_path / "sim" / "records").exists()
    config.train.batch_size = 2
    data = prepare()
    paths = data.paths
    assert paths.roots == (str(tmp_path / "sim"),)
    assert paths.records == str(tmp_path / "sim" / "records")
    assert len(data.records.keys()) == 4
    assert len(data.split("test")) == 2

    def written() -> dict[pathlib.Path, int]:
        files = (tmp_path / "sim" / "records").rglob("*.npy")
        return {path: path.stat().st_mtime_ns for path in files}

    before = written()
    assert "preprocess: 100%" in capsys.readouterr().err
    assert prepare().paths == paths
    assert "preprocess" not in capsys.readouterr().err
    assert written() == before


def test_other_data_keep_what_the_run_had_of_the_same_folders(
    tmp_path: pathlib.Path,
) -> None:
    own = DataPaths((str(tmp_path),), "l", "/fast/records", embeddings="/embeddings")
    for data in ((), (str(tmp_path),)):
        found = Sources(data=data, labels=str(tmp_path / "v2.zip")).paths(own)
        assert found.records == "/fast/records"
        assert found.embeddings == "/embeddings"
        assert found.labels == str(tmp_path / "v2.zip")
    (tmp_path / "b").mkdir()
    other = Sources(data=(str(tmp_path / "b"),)).paths(own)
    assert other == DataPaths((str(tmp_path / "b"),), None, str(tmp_path / "b/records"))
    with pytest.raises(UserError, match="must be a list of folders"):
        Sources(labels="x").paths(None)


def test_results_on_other_data_are_named_by_folder_and_labels(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kradar").mkdir()
    monkeypatch.chdir(tmp_path / "kradar")
    assert Sources(data=("..",)).name == tmp_path.name
    assert Sources(data=(".",)).name == "kradar"
    assert Sources(data=("/a/b", "/c"), labels="/x/v1.zip").name == "b_v1"
    assert Sources(labels="/x/v1.zip").name == "v1"
    assert Sources(label_version="v1.1").name == "other"
    part = {"sequences": (1, 58), "weather": ("fog",)}
    assert Sources(data=("/a/b",), **part).name == "b_1-58_fog"


def test_a_run_leaves_out_what_has_no_record_and_takes_a_part(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    simulation = default_config()
    simulation.update(train_sequences=2, test_sequences=1, frames_per_sequence=2)
    simulation["output"] = "projection"
    root = tmp_path / "sim"
    simulate_dataset(simulation, root, progress=False)
    config = base_config()
    frames = KRadar(root)
    damaged = next(frame for frame in frames if frame.sequence == 1)
    damaged.projection_path.write_bytes(b"half")
    preprocess(frames, root / "records", progress=False)
    config.train.batch_size = 1
    config.model.update(doppler_bins=16, elevation_bins=9)
    model, sources = models.build(config.model), Sources(data=(str(root),))
    with caplog.at_level("WARNING", "radejax"):
        data = open_data(config, model, sources)
    assert "6 frames: 5 were done, 0 preprocessed, 1 skipped" in caplog.text
    assert damaged.key not in [frame.key for frame in data.split("train")]
    assert len(data.split(None)) == len(data.records.keys()) == 5
    config.data.sequences = (1, 3)
    part = open_data(config, model, sources)  # the same records
    assert {frame.sequence for frame in part.frames} == {1, 3}
    assert len(part.split(None)) == 3

    # Of a run: its own part, another one, and all of other folders.
    shutil.copytree(root, tmp_path / "copy")
    run = {"data": dataclasses.asdict(data.paths)}
    loaded = SimpleNamespace(config=config, run=run, model=model, grid=frames.grid)
    loaded.variables = {"params": {}}
    for other, expected in (
        (None, {1, 3}),
        (Sources(label_version="v2.1"), {1, 3}),
        (Sources(sequences=(2,)), {2}),
        (Sources(weather=tuple({frame.weather for frame in frames})), {1, 3}),
        (Sources(data=(str(tmp_path / "copy"),)), {1, 2, 3}),
        (Sources(data=(str(tmp_path / "copy"),), sequences=(3,)), {3}),
    ):
        _, chosen = data_of_run(loaded, tmp_path, other)
        assert {frame.sequence for frame in chosen.frames} == expected
    assert tuple(config.data.sequences) == (1, 3)
    del config.data["sequences"], config.data["weather"]  # as runs of before
    assert len(open_data(config, model, sources).frames) == 6
    _check_validation(config, model, sources, caplog)


def _check_validation(
    config: Any, model: Any, sources: Sources, caplog: pytest.LogCaptureFixture
) -> None:
    """Sequence 1 with its damaged frame, and 2, are of the train split; 3 of the test."""

    def sequences(data: Data) -> dict[str, list[int]]:
        names = ("train", "validation", "test")
        return {name: [f.sequence for f in data.split(name)] for name in names}

    config.data.validation = (1,)
    config.classes = ("Sedan", "Motorcycle")
    with caplog.at_level("INFO", "radejax"):
        data = open_data(config, model, sources)
    assert sequences(data) == {"train": [2, 2], "validation": [1], "test": [3, 3]}
    assert data.choosing_split == "validation"
    assert "frames left out: held out for validation" in data.split("train").counts
    held = data.split("validation").class_counts()
    told = ", ".join(f"{cls} {number}" for cls, number in held.items())
    expected = f"sequences 1 of the train split are held out, 1 frames beside 2 to train on; {told}"
    assert expected in caplog.text
    assert "evaluate_every_epochs is 0: nothing is chosen by them" in caplog.text
    lacking = [cls for cls, number in held.items() if not number]
    assert ("in the validation split" in caplog.text) == bool(lacking)
    config.data.validation = (0.5,)
    drawn = sequences(open_data(config, model, sources))
    assert sorted({*drawn["train"], *drawn["validation"]}) == [1, 2]
    assert not {*drawn["train"]} & {*drawn["validation"]}
    config.data.validation = (3,)
    with pytest.raises(
        UserError, match=r"sequences \[3\], which have no frames in the"
    ):
        open_data(config, model, sources)
    del config.data["validation"], config.data["validation_seed"]  # as runs of before
    data = open_data(config, model, sources)
    assert len(data.split("train")) == 3
    assert data.choosing_split == "test"
    with pytest.raises(UserError, match="there is no validation split"):
        data.split("validation")
