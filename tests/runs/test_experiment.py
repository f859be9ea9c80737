"""Work folders, names and messages of whole runs."""

import hashlib
import json
from types import SimpleNamespace

import numpy as np
import pytest

from radejax.config import Config, load_config
from radejax.core import devices
from radejax.core.errors import UserError
from radejax.core.version import radejax_commit
from radejax.inference.detect_files import detect_files, find_inputs
from radejax.inference.detector import Detector
from radejax.runs import evaluate, experiment
from radejax.runs.experiment import claimed
from radejax.training.checkpoints import Checkpoints

from .. import small_models as small


def test_without_test_frames_a_run_trains_and_says_that_it_is_not_evaluated(
    tmp_path, monkeypatch, caplog, one_device
):
    caplog.set_level("INFO", logger="radejax")
    said_before = []

    def fit(*args, **__):
        said_before.append(caplog.text)
        return SimpleNamespace(step=1), True

    sizes = {"train_sequences": 1, "test_sequences": 0, "frames_per_sequence": 2}
    root = small.simulate(tmp_path / "data", **sizes)
    bins = {"doppler_bins": 16, "elevation_bins": 9}
    config = Config().replace(model=bins, train={"batch_size": 2})
    config = config.replace(data={"roots": (str(root),)})
    monkeypatch.setattr(experiment, "fit", fit)
    experiment.run(config, tmp_path / "run", mesh=one_device)
    assert f"no frames of the test split in {root}" in said_before[0]
    assert not (tmp_path / "run" / "evaluation").exists()
    assert "radejax detect" in caplog.text


def test_frames_labels_and_frozen_weights_tell_whether_a_run_is_the_same():
    def stays(keys):
        box, classes = np.array([[1, 2, 3, 4, 2, 1.5, 0]]), np.array(["Sedan"])
        frames = [SimpleNamespace(key=key, boxes=box, classes=classes) for key in keys]
        return experiment._invariants(frames, None)

    first, other = stays(["1/a", "1/b"]), stays(["1/a", "1/c"])
    assert first == stays(["1/a", "1/b"])
    assert first["frames to train on"] == other["frames to train on"] == 2
    assert first["sha256 of their keys"] != other["sha256 of their keys"]


@pytest.mark.slow
def test_a_run_of_two_frames(tmp_path, monkeypatch, caplog, one_device):
    """Training, choice of a checkpoint on a held-out sequence, evaluation and detection.

    Labels are read once, and weights fit models of two frames only.
    """

    evaluated = []
    make = evaluate.tables_from_frames

    def tables(frames, *args):
        evaluated.append([frame.sequence for frame in frames])
        return make(frames, *args)

    monkeypatch.setattr(evaluate, "tables_from_frames", tables)
    config = small.shrink_run(load_config("quickstart:short")).replace(
        simulation={"output": "projection", "train_sequences": 3},
        data={"roots": (str(tmp_path / "data"),), "validation": (2,), "num_frames": 2},
        model={"cbam": "off", "widths": (8,), "input_stem": True},
        train={"num_epochs": 1, "evaluate_every_epochs": 1},
        evaluation={"num_visualizations": 0},
    )
    config = config.replace(simulation={"frames_per_sequence": 2})
    with caplog.at_level("INFO", "radejax"):
        folder = experiment.run(config, tmp_path / "run", mesh=one_device)
    assert evaluated == [[2, 2], [4, 4]]
    for text in (
        "2 of 4 samples of 2 frames repeat one",
        "1 of 2 samples of 2 frames repeat one",
        "Best checkpoint, chosen on the validation split: ",
    ):
        assert text in caplog.text
    last = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
    assert {f"validation/{name}" for name in config.loss.weights} <= set(last)
    (events,) = (folder / "tensorboard").glob("*.test")
    assert b"test/map_3d_iou30/coco101/" in events.read_bytes()
    frames = json.loads((folder / "evaluation" / "frames.json").read_text())
    assert (frames["sequence"], frames["split"]) == ([4, 4], ["test", "test"])
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        variables, info, _ = checkpoints.restore_variables()
    assert info["same"]["frames to train on"] == 4
    kernel = variables["params"]["backbone"]["stem"]["doppler"]["conv"]["kernel"]
    assert kernel.shape[-2] == 2 * 4
    root, out = tmp_path / "data", tmp_path / "boxes"
    assert len(list((root / "records").glob("*/*.npy"))) == 8
    detector = Detector.from_workdir(folder, score_threshold=0.0, batch_sizes=(8,))
    count, _ = detect_files(detector, find_inputs(detector, [root]), out)
    assert (count["frames"], count["repeated"]) == (8, 4)
    info = json.loads((folder / "run.json").read_text())
    assert detector.saved.usual_input == info["input"]
    assert "in the training: detections" not in caplog.text
    origin = detector.saved.identity
    assert origin["run"] == "run"
    assert origin["radejax_commit"] == radejax_commit()
    assert origin["data"]["license"] == "Apache-2.0, that of radejax"
    assert origin["metrics"]["split"] == "test"
    assert all("/all/" in name for name in origin["metrics"]["ap"])
    protocols = {name.split("/")[3] for name in origin["metrics"]["ap"]}
    assert protocols == {config.evaluation.protocols[0], "all_point"}
    metrics = json.loads((folder / "evaluation" / "metrics.json").read_text())
    assert metrics["thresholds"]["chosen_on"] == "the validation split"
    one = config.replace(data={"num_frames": 1})
    with pytest.raises(UserError, match=r"run do not fit config.model .*stem/doppler"):
        experiment.run(one, tmp_path / "one", init_from=folder, mesh=one_device)


def test_a_batch_that_does_not_divide_is_rejected_first(tmp_path):
    config = load_config("quickstart").replace(train={"batch_size": 2})
    with pytest.raises(UserError, match=r"batch_size is 2, expected a multiple of 4"):
        experiment.run(config, tmp_path / "run", mesh=devices.make_mesh(4))
    assert not list(tmp_path.iterdir())


# Work folders ------------------------------------------------------------------------


def test_a_work_folder_keeps_its_config_and_rejects_another(tmp_path, caplog):
    config = Config()
    # As long as nothing is trained, the folder takes another config.
    for kept in (config, config, config.replace(train={"num_epochs": 7})):
        with claimed(tmp_path, kept):
            assert Config(**json.loads((tmp_path / "config.json").read_text())) == kept
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    text = r"config\.seed is 0 there and 5 here; "
    text += r"config\.train\.batch_size is 10 there and 3 here.*--workdir"
    with (
        pytest.raises(UserError, match=text),
        claimed(tmp_path, kept.replace(seed=5, train={"batch_size": 3})),
    ):
        pass
    longer = kept.replace(train={"num_epochs": 9}, logging={"num_visualizations": 1})
    with claimed(tmp_path, longer):
        pass
    assert Config(**json.loads((tmp_path / "config.json").read_text())) == longer
    lines = "\n".join(caplog.messages)
    assert "another config: config.train.num_epochs is 7 there and 9 here" in lines
    assert "config.logging.num_visualizations is 4 there and 1 here" in lines


def test_a_second_training_in_a_work_folder_is_rejected(tmp_path):
    folder = tmp_path / "run"
    with (
        claimed(folder, Config()),
        pytest.raises(UserError, match=r"another training is at work in .*run: wait"),
        claimed(folder, Config()),
    ):
        pass
    with claimed(folder, Config()):  # let go, though the file is there
        pass


def test_what_a_run_started_from_is_kept(tmp_path):
    info = experiment.run_info(tmp_path, str(tmp_path / "model.pth"))
    assert info["init_from"] == str(tmp_path / "model.pth")
    (tmp_path / "run.json").write_text(json.dumps(info))
    again = experiment.run_info(tmp_path)
    assert again["init_from"] == info["init_from"]


def test_a_run_with_checkpoints_takes_no_other_weights(tmp_path):
    first = tmp_path / "a.pth"
    info = experiment.run_info(tmp_path, first)
    (tmp_path / "run.json").write_text(json.dumps(info))
    # As long as nothing is trained, the folder takes other weights.
    experiment.run_info(tmp_path, tmp_path / "b.pth")
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    assert experiment.run_info(tmp_path, first)["init_from"] == str(first)
    assert experiment.run_info(tmp_path)["init_from"] == str(first)
    with pytest.raises(UserError, match=r"--init-from is .*b\.pth, expected .*a\.pth"):
        experiment.run_info(tmp_path, tmp_path / "b.pth")
    with pytest.raises(UserError, match=r"--init-partial is .*, expected none as"):
        experiment.run_info(tmp_path, first, first)


def test_commit_and_own_parts_of_a_run_are_stored(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own_terms.py"
    own.write_text("def size(pairs, options):\n    return 0.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    weights = {"own_terms": ("own_terms:size",), "weights.size": 1.0}
    config = Config().replace(loss=weights)
    config.check_imports()
    digest = hashlib.sha256(own.read_bytes()).hexdigest()
    parts = config.own_parts()
    assert parts == {"own_terms:size": digest}
    assert Config().own_parts() == {}
    config.check_parts(parts, tmp_path)
    assert not caplog.text
    own.write_text("def size(pairs, options):\n    return 2.0\n")
    config.check_parts(parts, tmp_path)
    assert f"{tmp_path}: the file of own_terms:size has changed since" in caplog.text


# Several seeds -----------------------------------------------------------------------


def test_every_seed_runs_in_its_folder_and_the_spread_is_reported(
    tmp_path, monkeypatch
):
    aps = {0: 50.0, 1: 53.0, 2: 59.0}
    seen = []

    def run(config, workdir, *, init_from):
        seen.append((config.seed, workdir.name, init_from))
        (workdir / "evaluation").mkdir(parents=True)
        (workdir / "evaluation" / "metrics.csv").write_text(
            "name,protocol,score_threshold,condition,cls,space,iou,ap,num_gt\n"
            + f"a/simulated,all_point,0.05,all,Sedan,3d,0.3,{aps[config.seed]},10\n"
            + "b/simulated,all_point,0.05,all,Bicycle,3d,0.3,,0\n"
            + f"c/simulated,all_point,0.05,rain,Sedan,3d,0.3,{config.seed},3\n"
        )
        return True, object()

    monkeypatch.setattr(experiment, "_run", run)
    experiment.run_seeds(Config(), tmp_path / "runs", range(3), init_from="w")
    assert seen == [(i, f"seed{i}", "w") for i in range(3)]
    rows = json.loads((tmp_path / "runs" / "seeds.json").read_text())
    assert [row["cls"] for row in rows] == ["Sedan", "Sedan"]
    assert rows[0]["mean"] == pytest.approx(54.0)
    assert rows[0]["std"] == pytest.approx(21**0.5)  # (16 + 1 + 25) / 2
    assert rows[0]["values"] == {"0": 50.0, "1": 53.0, "2": 59.0}
    message = r"--seeds is \(1, 2, 1\), expected different seeds"
    with pytest.raises(UserError, match=message):
        experiment.run_seeds(Config(), tmp_path, (1, 2, 1))


@pytest.mark.parametrize(
    ("is_finished", "is_evaluated", "expected"),
    [
        (False, False, [0]),  # by a signal
        (True, False, [0, 1, 2]),  # without a test split
        (True, True, [0, 1, 2]),
    ],
)
def test_only_an_unfinished_seed_ends_the_seeds_and_old_reports_do_not_count(
    tmp_path, monkeypatch, caplog, is_finished, is_evaluated, expected
):
    started = []

    def run(config, workdir):
        started.append(config.seed)
        (workdir / "evaluation").mkdir(parents=True)
        num_gt = 0 if is_evaluated else 10
        (workdir / "evaluation" / "metrics.csv").write_text(
            "name,protocol,score_threshold,condition,cls,space,iou,ap,num_gt\n"
            f"a,all_point,0.05,all,Sedan,3d,0.3,50,{num_gt}\n"
        )
        return is_finished, object() if is_evaluated else None

    monkeypatch.setattr(experiment, "_run", run)
    experiment.run_seeds(Config(), tmp_path, range(3))
    assert started == expected
    assert not (tmp_path / "seeds.json").exists()
    assert ("no class has objects in every seed" in caplog.text) == is_evaluated
