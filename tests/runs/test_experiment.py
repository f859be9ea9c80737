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
from radejax.detection.decode import DecodeOptions
from radejax.inference.detect_files import detect_files
from radejax.inference.saved import load_model
from radejax.runs import evaluate, experiment
from radejax.runs.experiment import claimed
from radejax.simulation.dataset import default_config, simulate_dataset
from radejax.training import loop
from radejax.training.checkpoints import Checkpoints

from .. import small_models as small

CONFIGS = pathlib.Path(__file__).resolve().parents[2] / "configs"


@pytest.mark.usefixtures("one_device")
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
    config.data.roots = (str(root),)
    experiment.run(config, tmp_path / "run")
    assert f"no frames of the test split in {root}" in said_before[0]
    assert not (tmp_path / "run" / "evaluation").exists()
    assert "radejax detect" in caplog.text
    # What NMS chooses for the loss is what decoding finds.
    assert loop.loss_options(config)["decoding"] == DecodeOptions(**config.decode)


def test_frames_and_frozen_weights_tell_whether_a_run_is_the_same() -> None:
    def stays(keys: list[str], frozen: str | None = None) -> dict:
        frames = [SimpleNamespace(key=key) for key in keys]
        return experiment._invariants(frames, frozen)

    first = stays(["1/a", "1/b"])
    assert first == stays(["1/a", "1/b"])
    assert first["frames to train on"] == 2
    assert (
        first["sha256 of their keys"] != stays(["1/a", "1/c"])["sha256 of their keys"]
    )
    assert len(first) == 2  # nothing is frozen
    assert stays(["1/a"], "0" * 64) == stays(["1/a"], "0" * 64)
    assert stays(["1/a"], "0" * 64) != stays(["1/a"], "1" * 64)


@pytest.mark.usefixtures("one_device")
def test_labels_are_read_once(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """And the sequences that are held out choose the best checkpoint."""
    parsed: collections.Counter = collections.Counter()
    read = dataset.read_label_file

    def count(path: pathlib.Path, version: str, **options: Any) -> Any:
        parsed[path] += 1
        return read(path, version, **options)

    monkeypatch.setattr(dataset, "read_label_file", count)
    config = load_config(f"{CONFIGS / 'quickstart.py'}:short")
    config.simulation.update(
        train_sequences=3, frames_per_sequence=2, output="projection"
    )
    config = small.shrink_run(config)
    config.data.validation = (2,)
    config.model.update(cbam="off", widths=(8,))
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
        folder = experiment.run(config, tmp_path / "run")
    assert evaluated == [[2, 2], [4, 4]]
    (events,) = (folder / "tensorboard").glob("*.test")
    assert b"test/map_3d_iou30/coco101/" in events.read_bytes()
    frames = json.loads((folder / "evaluation" / "frames.json").read_text())
    assert (frames["sequence"], frames["split"]) == ([4, 4], ["test", "test"])
    assert "Best checkpoint, chosen on the validation split: " in caplog.text
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        _, info, _ = checkpoints.restore_variables()
        assert info["same"]["frames to train on"] == 4
    assert len(parsed) == 8
    assert set(parsed.values()) == {1}


@pytest.mark.usefixtures("one_device")
def test_a_run_of_two_frames(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Training, evaluation and detection; weights fit models of two frames only."""
    config = load_config(f"{CONFIGS / 'quickstart.py'}:short")
    config.simulation.update(
        train_sequences=2, frames_per_sequence=3, output="projection"
    )
    config = small.shrink_run(config)
    config.data.update(num_frames=2, roots=(str(tmp_path / "data"),))
    config.model.update(cbam="off", widths=(8,), input_stem=True)
    config.train.num_epochs = 1
    config.evaluation.num_visualizations = 0
    with caplog.at_level("INFO", "radejax"):
        folder = experiment.run(config, tmp_path / "run")
    assert "2 of 6 samples of 2 frames repeat one" in caplog.text
    assert "1 of 3 samples of 2 frames repeat one" in caplog.text
    saved = load_model(folder)
    kernel = saved.variables["params"]["backbone"]["stem"]["doppler"]["conv"]["kernel"]
    assert kernel.shape[-2] == 2 * 4
    assert len(list((tmp_path / "data" / "records").glob("*/*.npy"))) == 9
    root, out = tmp_path / "data", tmp_path / "boxes"
    count = detect_files(folder, [root], out, score_threshold=0.0)
    assert (count["frames"], count["repeated"]) == (9, 3)
    config.data.num_frames = 1
    with pytest.raises(UserError, match=r"run do not fit config.model .*stem/doppler"):
        experiment.run(config, tmp_path / "one", init_from=folder)
    config.data.update(num_frames=2, roots=(str(tmp_path / "single"),))
    config.simulation.update(train_sequences=4, frames_per_sequence=1)
    with pytest.raises(UserError, match=r"num_frames is 2, expected 1, as no frame to"):
        experiment.run(config, tmp_path / "single_run")


# Work folders ------------------------------------------------------------------------


def test_a_work_folder_keeps_its_config_and_rejects_another(
    tmp_path: pathlib.Path,
) -> None:
    config = base_config()
    for _ in range(2):
        with claimed(tmp_path, config):
            kept = json.loads((tmp_path / "config.json").read_text())
            assert kept == json.loads(config.to_json())
    config.train.num_epochs = 7  # nothing is trained: the folder takes it
    with claimed(tmp_path, config):
        kept = json.loads((tmp_path / "config.json").read_text())
        assert kept["train"]["num_epochs"] == 7
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    config.train.batch_size = 3
    config.seed = 5
    with (
        pytest.raises(
            UserError,
            match=r"config\.seed is 0 there and 5 here; "
            r"config\.train\.batch_size is 10 there and 3 here.*--workdir",
        ),
        claimed(tmp_path, config),
    ):
        pass


def test_a_second_training_in_a_work_folder_is_rejected(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "run"
    with (
        claimed(folder, base_config()),
        pytest.raises(UserError, match=r"another training is at work in .*run: wait"),
        claimed(folder, base_config()),
    ):
        pass
    with claimed(folder, base_config()):  # let go, though the file is there
        pass


def test_what_a_run_started_from_is_kept(tmp_path: pathlib.Path) -> None:
    info = experiment.run_info(tmp_path, str(tmp_path / "model.pth"))
    assert info["init_from"] == str(tmp_path / "model.pth")
    (tmp_path / "run.json").write_text(json.dumps(info))
    again = experiment.run_info(tmp_path)
    assert again["init_from"] == info["init_from"]


# Several seeds -----------------------------------------------------------------------


def test_every_seed_runs_in_its_folder_and_the_spread_is_reported(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aps = {0: 50.0, 1: 53.0, 2: 59.0}
    seen = []

    def run(config: Any, workdir: pathlib.Path, *, init_from: str) -> pathlib.Path:
        seen.append((config.seed, workdir.name, init_from))
        (workdir / "evaluation").mkdir(parents=True)
        (workdir / "evaluation" / "metrics.csv").write_text(
            "name,protocol,score_threshold,condition,cls,space,iou,ap,num_gt\n"
            + f"a/simulated,all_point,0.05,all,Sedan,3d,0.3,{aps[config.seed]},10\n"
            + "b/simulated,all_point,0.05,all,Bicycle,3d,0.3,,0\n"
            + f"c/simulated,all_point,0.05,rain,Sedan,3d,0.3,{config.seed},3\n"
        )
        return workdir

    monkeypatch.setattr(experiment, "run", run)
    config = base_config()
    experiment.run_seeds(config, tmp_path / "runs", range(3), init_from="w")
    assert seen == [(i, f"seed{i}", "w") for i in range(3)]
    rows = json.loads((tmp_path / "runs" / "seeds.json").read_text())
    assert [row["cls"] for row in rows] == ["Sedan", "Sedan"]
    assert rows[0]["mean"] == pytest.approx(54.0)
    assert rows[0]["std"] == pytest.approx(21**0.5)  # (16 + 1 + 25) / 2
    assert rows[0]["values"] == {"0": 50.0, "1": 53.0, "2": 59.0}
    text = (tmp_path / "runs" / "seeds.txt").read_text()
    assert text.startswith("Simulated data: AP, mean ± standard deviation over 3 seeds")
    for ending in ("txt", "md", "tex"):
        table = (tmp_path / "runs" / f"seeds.{ending}").read_text()
        assert "54.00 ± 4.58" in table
    assert "all_point, score>0.05" in text
    assert "rain" not in text


def test_seeds_are_different(tmp_path: pathlib.Path) -> None:
    message = r"--seeds is \(1, 2, 1\), expected different seeds"
    with pytest.raises(UserError, match=message):
        experiment.run_seeds(base_config(), tmp_path, (1, 2, 1))
