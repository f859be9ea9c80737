"""Data folders of a run: found, checked, projected once."""

import pathlib
import shutil
from types import SimpleNamespace
from typing import Any

import pytest
from ml_collections import ConfigDict

from radejax import models
from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.data.kradar import KRadar
from radejax.data.records import preprocess
from radejax.runs.data import Data, data_name, data_of_run, located, open_data
from radejax.simulation.dataset import default_config, simulate_dataset


def _located(model: Any = None, **paths: Any) -> Any:
    config = base_config()
    config.data.update(paths)
    return located(config)


def test_without_data_and_simulation_the_flag_is_named() -> None:
    with pytest.raises(UserError, match=r"give --data ROOT"):
        _located()


@pytest.mark.parametrize("missing", ["roots", "camera_calibration"])
def test_a_missing_folder_is_named(missing: str, tmp_path: pathlib.Path) -> None:
    nowhere: Any = str(tmp_path / "nowhere")
    given = {"roots": (str(tmp_path),)}
    given[missing] = (nowhere,) if missing == "roots" else nowhere
    with pytest.raises(
        FileNotFoundError, match=r"no such folder.*nowhere|nowhere: no "
    ):
        open_data(config := _located(**given), models.build(config.model))


def test_paths_are_absolute_and_simulations_named_by_their_config(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = base_config()
    config.simulation = ConfigDict(default_config())
    config.data.labels = "v2.zip"
    here = located(config).data
    (root,) = here.roots
    assert root.startswith(str(tmp_path / "data" / "simulated-"))
    assert here.records == f"{root}/records"
    assert here.labels == str(tmp_path / "v2.zip")
    config.simulation.seed += 1
    assert located(config).data.roots != here.roots
    config.data.roots = ("a", "b")
    with pytest.raises(UserError, match="expected one folder, as the config simulates"):
        located(config)


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
        return open_data(located(config), models.build(config.model))

    config = base_config()
    config.data.roots = ("sim",)
    with pytest.raises(
        UserError, match="doppler_bins is 64, expected 16, as the radar of"
    ):
        prepare()
    config.model.update(doppler_bins=16, elevation_bins=9)
    with pytest.raises(UserError, match="2 frames are fewer than one batch"):
        prepare()
    assert not (tmp_path / "sim" / "records").exists()
    config.train.batch_size = 2
    data = prepare()
    assert data.options.roots == (str(tmp_path / "sim"),)
    assert data.options.records == str(tmp_path / "sim" / "records")
    assert len(data.records.keys()) == 4
    assert len(data.split("test")) == 2

    def written() -> dict[pathlib.Path, int]:
        files = (tmp_path / "sim" / "records").rglob("*.npy")
        return {path: path.stat().st_mtime_ns for path in files}

    before = written()
    assert "preprocess: 100%" in capsys.readouterr().err
    prepare()
    assert "preprocess" not in capsys.readouterr().err
    assert written() == before


def test_results_on_other_data_are_named_by_folder_and_labels(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kradar").mkdir()
    monkeypatch.chdir(tmp_path / "kradar")
    assert data_name({"roots": ("..",)}) == tmp_path.name
    assert data_name({"roots": (".",)}) == "kradar"
    assert data_name({"roots": ("/a/b", "/c"), "labels": "/x/v1.zip"}) == "b_v1"
    assert data_name({"labels": "/x/v1.zip"}) == "v1"
    assert data_name({"label_version": "v1.1"}) == "other"
    part = {"sequences": (1, 58), "weather": ("fog",)}
    assert data_name({"roots": ("/a/b",), **part}) == "b_1-58_fog"


def test_a_run_leaves_out_what_has_no_record_and_takes_a_part(
    tmp_path: pathlib.Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
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
    config.data.roots = (str(root),)
    model = models.build(config.model)
    with caplog.at_level("WARNING", "radejax"):
        data = open_data(located(config), model)
    assert "6 frames: 5 were done, 0 preprocessed, 1 skipped" in caplog.text
    assert damaged.key not in [frame.key for frame in data.split("train")]
    assert len(data.split("all")) == len(data.records.keys()) == 5
    config.data.sequences = (1, 3)
    part = open_data(located(config), model)  # the same records
    assert {frame.sequence for frame in part.frames} == {1, 3}
    assert len(part.split("all")) == 3

    # Of a run: its own part, another one, and all of other folders.
    copy = str(shutil.copytree(root, tmp_path / "copy"))
    own = located(config)
    own.data.update(labels=str(tmp_path / "l"), embeddings="/embeddings")
    saved = SimpleNamespace(config=own, model=model, grid=frames.grid)
    saved.variables = {"params": {}}
    monkeypatch.setattr(Data, "open", lambda *_: SimpleNamespace(frames=frames))
    chosen, _ = data_of_run(saved, {"roots": (str(root),), "label_version": "v2.0"})
    assert (chosen.data.embeddings, chosen.data.sequences) == ("/embeddings", (1, 3))
    assert (chosen.data.label_version, own.data.label_version) == ("v2.0", "v2.1")
    chosen, _ = data_of_run(saved, {"roots": (copy,)})
    assert (chosen.data.embeddings, chosen.data.labels) == (None, None)
    assert chosen.data.records == f"{copy}/records"
    monkeypatch.undo()
    own.data.update(labels=None, embeddings=None)
    for other, expected in (
        (None, {1, 3}),
        ({"label_version": "v2.1"}, {1, 3}),
        ({"sequences": (2,)}, {2}),
        ({"weather": tuple({frame.weather for frame in frames})}, {1, 3}),
        ({"roots": (copy,)}, {1, 2, 3}),
        ({"roots": (copy,), "sequences": (3,)}, {3}),
    ):
        _, found = data_of_run(saved, other)
        assert {frame.sequence for frame in found.frames} == expected
    assert tuple(own.data.sequences) == (1, 3)
    config.data.sequences = ()
    _check_validation(config, model, caplog)


def _check_validation(
    config: Any, model: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Sequence 1 with its damaged frame, and 2, are of the train split; 3 of the test."""

    def sequences(data: Data) -> dict[str, list[int]]:
        names = ("train", "validation", "test")
        return {name: [f.sequence for f in data.split(name)] for name in names}

    config.data.validation = (1,)
    config.classes = ("Sedan", "Motorcycle")
    with caplog.at_level("INFO", "radejax"):
        data = open_data(located(config), model)
    assert sequences(data) == {"train": [2, 2], "validation": [1], "test": [3, 3]}
    assert data.choosing_split == "validation"
    assert "frames left out: held out for validation" in data.split("train").counts
    held = data.split("validation").class_counts()
    told = ", ".join(f"{cls} {number}" for cls, number in held.items())
    expected = f"sequences 1 of the train split are held out, 1 frames beside 2 to train on; {told}"
    assert expected in caplog.text
    config.data.validation = (0.5,)
    drawn = sequences(open_data(located(config), model))
    assert sorted({*drawn["train"], *drawn["validation"]}) == [1, 2]
    assert not {*drawn["train"]} & {*drawn["validation"]}
    config.data.validation = (3,)
    with pytest.raises(
        UserError, match=r"sequences \[3\], which have no frames in the"
    ):
        open_data(located(config), model)
    config.data.validation = ()
    data = open_data(located(config), model)
    assert len(data.split("train")) == 3
    assert data.choosing_split == "test"
    with pytest.raises(UserError, match="there is no validation split"):
        data.split("validation")
