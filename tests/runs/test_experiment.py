"""Work folders, names and messages of whole runs."""

import collections
import json
import pathlib
from types import SimpleNamespace
from typing import Any

import pytest

from radejax.core.config import base_config, load_config
from radejax.core.errors import UserError
from radejax.data.kradar import dataset
from radejax.inference.saved import StartingWeights
from radejax.losses.detection import NmsAssignment
from radejax.runs import evaluate, experiment
from radejax.runs.experiment import claimed
from radejax.simulation.dataset import default_config, simulate_dataset
from radejax.training import distributed, loop
from radejax.training.checkpoints import Checkpoints

CONFIGS = pathlib.Path(__file__).resolve().parents[2] / "configs"


def test_a_work_folder_in_use_is_left_alone(tmp_path: pathlib.Path) -> None:
    folder, config = tmp_path / "run", base_config()
    config.train.batch_size = 8  # as many as the tests have devices
    config.data.roots = (str(tmp_path),)
    with (
        claimed(folder, config),
        pytest.raises(UserError, match="another training"),
    ):
        experiment.run(config, name="x", workdir=folder)
    assert sorted(path.name for path in folder.iterdir()) == ["config.json", "lock"]


def test_without_test_frames_a_run_trains_and_says_that_it_is_not_evaluated(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", logger="radejax")
    said_before = []

    def train(*args: Any, **__: Any) -> Any:
        said_before.append(caplog.text)
        return SimpleNamespace(step=1), True

    simulation = default_config()
    simulation.update(train_sequences=1, test_sequences=0, frames_per_sequence=2)
    simulation["output"] = "projection"
    root = simulate_dataset(simulation, tmp_path / "data", progress=False)
    config = base_config()
    config.model.update(doppler_bins=16, elevation_bins=9)
    config.train.batch_size = 2
    config.decode.update(score_threshold=0.25, nms_iou=0.4, threshold_inclusive=False)
    monkeypatch.setattr(loop, "train", train)
    mesh = distributed.make_mesh(1)
    monkeypatch.setattr(distributed, "make_mesh", lambda *_: mesh)
    config.data.roots = (str(root),)
    experiment.run(config, name="x", workdir=tmp_path / "run")
    assert f"no frames of the test split in {root}" in said_before[0]
    assert not (tmp_path / "run" / "evaluation").exists()
    assert "radejax detect" in caplog.text
    # What NMS chooses for the loss is what decoding finds.
    expected = NmsAssignment(
        score_threshold=0.25, nms_iou=0.4, threshold_inclusive=False, per_class=False
    )
    assert loop.loss_options(config)["nms"] == expected


def test_frames_and_frozen_weights_tell_whether_a_run_is_the_same() -> None:
    def stays(keys: list[str], frozen: str | None = None) -> dict:
        frames = [SimpleNamespace(key=key) for key in keys]
        weights = StartingWeights(frozen_sha256=frozen)
        return experiment._invariants(frames, weights)

    first = stays(["1/a", "1/b"])
    assert first == stays(["1/a", "1/b"])
    assert first["frames to train on"] == 2
    assert (
        first["sha256 of their keys"] != stays(["1/a", "1/c"])["sha256 of their keys"]
    )
    assert len(first) == 2  # nothing is frozen
    assert stays(["1/a"], "0" * 64) == stays(["1/a"], "0" * 64)
    assert stays(["1/a"], "0" * 64) != stays(["1/a"], "1" * 64)


def test_labels_are_read_once(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """And the sequences that are held out choose the best checkpoint."""
    parsed: collections.Counter = collections.Counter()
    parse = dataset.parse_label_file

    def count(*args: Any, where: str, **options: Any) -> Any:
        parsed[where] += 1
        return parse(*args, where=where, **options)

    monkeypatch.setattr(dataset, "parse_label_file", count)
    mesh = distributed.make_mesh(1)
    monkeypatch.setattr(distributed, "make_mesh", lambda *_: mesh)
    config = load_config(f"{CONFIGS / 'quickstart.py'}:short")
    config.simulation.update(
        train_sequences=3, frames_per_sequence=2, output="projection"
    )
    config.simulation.grid.update(
        num_doppler=4, num_range=24, num_elevation=3, num_azimuth=16
    )
    config.data.validation = (2,)
    config.model.update(doppler_bins=4, elevation_bins=3, cbam="off", widths=(8,))
    config.model.update(decoder_width=8, num_groups=4, neck="plain", heads="default")
    config.train.update(num_epochs=1, evaluate_every_epochs=1)
    config.evaluation.num_visualizations = 0
    evaluated = []
    make = evaluate.tables_from_frames
    monkeypatch.setattr(
        evaluate,
        "tables_from_frames",
        lambda f, split: evaluated.append([x.sequence for x in f]) or make(f, split),
    )
    with caplog.at_level("INFO", "radejax"):
        config.data.roots = (str(tmp_path / "data"),)
        folder = experiment.run(config, name="x", workdir=tmp_path / "run")
    assert evaluated == [[2, 2], [4, 4]]
    frames = json.loads((folder / "evaluation" / "frames.json").read_text())
    assert (frames["sequence"], frames["split"]) == ([4, 4], ["test", "test"])
    assert "Best checkpoint, chosen on the validation split: " in caplog.text
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        _, info, _ = checkpoints.restore_variables()
        assert info["same"]["frames to train on"] == 4
    assert len(parsed) == 8
    assert set(parsed.values()) == {1}


def test_a_batch_that_does_not_divide_is_told_before_anything_is_written(
    tmp_path: pathlib.Path,
) -> None:
    config = load_config(f"{CONFIGS / 'quickstart.py'}:short")
    config.train.batch_size = 3  # of eight devices
    config.data.roots = (str(tmp_path / "data"),)
    with pytest.raises(
        UserError,
        match=r"config\.train\.batch_size is 3, expected a multiple of 8 devices",
    ):
        experiment.run(config, name="x", workdir=tmp_path / "run")
    assert not list(tmp_path.iterdir())
