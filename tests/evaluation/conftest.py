"""Scenes, and reports and comparisons of them as files."""

import pathlib
import re

import numpy as np
import pytest

from radejax.core import files
from radejax.evaluation.boxes import frame_keys, read_boxes, write_boxes
from radejax.evaluation.files import Source
from radejax.evaluation.report import Origin, write_report
from radejax.evaluation.results import ReportOptions

from .scenes import random_scene

STORED = pathlib.Path(__file__).parent / "stored"
"""Texts that version 0.3 wrote for the scenes of these tests, with what was added since."""


@pytest.fixture(scope="session")
def assert_stored():
    """Function (path) that compares a text file with the stored one of the same name."""

    def compare(path, name=None):
        found = re.sub("(?m)^.*radejax .*, commit .*\n", "", path.read_text())
        assert found == (STORED / (name or path.name)).read_text()

    return compare


@pytest.fixture(scope="session")
def write_table():
    """Function (path, table, frames) that writes a table as .npz or .json records."""

    def write(path, table, frames):
        if path.suffix == ".npz":
            boxes = read_boxes(table, path.name, scored="score" in table)
            return write_boxes(path, boxes, frames)
        keys = frame_keys(frames) if "name" in frames else frames["frame"].tolist()
        columns = {name: np.asarray(column).tolist() for name, column in table.items()}
        columns["frame"] = [keys[i] for i in columns["frame"]]
        rows = zip(*columns.values(), strict=True)
        records = [dict(zip(columns, row, strict=True)) for row in rows]
        return files.write_json(path, records)

    return write


@pytest.fixture(scope="session")
def scene():
    """Ground truth, predictions and frames of `stored` and `two_runs`."""
    return random_scene(8, num_frames=30, num_objects=90)


@pytest.fixture
def stored(scene, write_table, tmp_path):
    """Folder with predictions, ground truth and frames as files, and their `Source`."""
    truth, found, frames = scene
    write_table(tmp_path / "found.json", found, frames)
    write_table(tmp_path / "truth.npz", truth, frames)
    columns = {name: column.tolist() for name, column in frames.items()}
    files.write_json(tmp_path / "frames.json", columns)
    return tmp_path, Source(ground_truth=str(tmp_path / "truth.npz"))


@pytest.fixture(scope="module")
def two_runs(scene, tmp_path_factory):
    """Folder with the runs `a` and `b`, which have reports of three seeds each."""
    folder = tmp_path_factory.mktemp("runs")
    truth, found, frames = scene
    options = {"roi": None, "plots": False, "protocols": ("all_point", "kradar_r40")}
    options |= {"score_threshold": 0.4, "min_score": 0.1, "classes": ("Sedan",)}
    options = ReportOptions(**options)
    for run, keep in (("a", 0.5), ("b", 0.9)):
        for seed in range(3):
            rows = np.random.default_rng(seed).random(len(found["score"])) < keep
            table = {k: v[rows] for k, v in found.items()}
            place = folder / run / f"seed{seed}" / "evaluation"
            write_report(truth, table, frames, place, options, Origin(run))
    return folder
