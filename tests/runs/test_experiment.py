"""Work folders, names and messages of whole runs."""

import json
import pathlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from radejax.core.config import base_config
from radejax.core.errors import UserError
from radejax.inference.embed import weights_sha256
from radejax.runs import experiment
from radejax.runs.data import DataPaths
from radejax.runs.workdir import lock_workdir


def test_names_of_runs() -> None:
    assert experiment.config_name("configs/quickstart.py") == "quickstart"
    assert experiment.config_name("a/b/radenet.py:stem,sedan") == "radenet-stem-sedan"


def test_a_work_folder_in_use_is_left_alone(tmp_path: pathlib.Path) -> None:
    with lock_workdir(tmp_path), pytest.raises(UserError, match="another training"):
        experiment.run(base_config(), name="x", workdir=tmp_path, data=[str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_without_test_frames_a_run_trains_and_says_that_it_is_not_evaluated(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    said_before = []

    def train(*_: Any, **__: Any) -> SimpleNamespace:
        said_before.append(caplog.text)
        return SimpleNamespace(finished=True, step=1)

    monkeypatch.setattr(experiment, "prepare_data", lambda *_, **__: paths)
    monkeypatch.setattr(DataPaths, "open", lambda *_, **__: [])
    monkeypatch.setattr(experiment, "train", train)
    paths = DataPaths(("/data",), None, "/records")
    experiment.run(base_config(), name="x", workdir=tmp_path / "run")
    assert "no frames of the test split in /data" in said_before[0]
    assert not (tmp_path / "run" / "evaluation").exists()


def test_frames_and_frozen_weights_tell_whether_a_run_is_the_same(
    tmp_path: pathlib.Path,
) -> None:
    def stays(keys: list[str], embeddings: str | None = None, **model: Any) -> dict:
        frames = [SimpleNamespace(key=key) for key in keys]
        variables = {"params": {"image_backbone": weights, "neck": np.ones(2)}}
        return experiment._what_stays(
            frames, variables, None, embeddings, SimpleNamespace(**model)
        )

    weights = {"w": np.arange(3.0, dtype=np.float32)}
    first = stays(["1/a", "1/b"])
    assert first == stays(["1/a", "1/b"])
    assert first["frames to train on"] == 2
    assert (
        first["sha256 of their keys"] != stays(["1/a", "1/c"])["sha256 of their keys"]
    )
    assert len(first) == 2  # nothing is frozen
    frozen = stays(["1/a"], freeze=True)
    assert frozen != stays(["1/a"], freeze=False)
    # Embeddings of the same backbone stand for it.
    manifest = {"weights_sha256": weights_sha256(weights)}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    assert stays(["1/a"], str(tmp_path), freeze=True) == frozen
    weights["w"] = weights["w"] + 1
    assert stays(["1/a"], freeze=True) != frozen
