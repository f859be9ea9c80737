"""Loads the slow reference and makes random scenes."""

import pathlib

import numpy as np
import pytest

from radejax.config import load_module
from radejax.core import files
from radejax.evaluation.boxes import frame_keys, read_boxes, write_boxes
from radejax.evaluation.files import Source

HERE = pathlib.Path(__file__).parent


def _load(name):
    return load_module(HERE / f"{name}.py")


@pytest.fixture(scope="session")
def reference():
    """The second, slow implementation."""
    return _load("reference")


@pytest.fixture(scope="session")
def random_scene():
    """Function (seed, ...) -> ground truth, predictions, frames."""
    return _load("scenes").random_scene


@pytest.fixture(scope="session")
def kradar_fixture(shared):
    """Columns of the shared K-Radar evaluation set, and the frame weathers."""
    folder = shared / "fixtures" / "kradar_eval"
    truth, found = (
        np.load(folder / f"{name}.npz") for name in ("ground_truth", "predictions")
    )
    names = truth["class_names"]
    frames = {
        "frame": np.arange(truth["frame_name"].size),
        "name": truth["frame_name"],
        "sequence": truth["frame_seq"],
        "weather": truth["frame_weather"],
    }
    ground_truth = {k: truth[k] for k in ("frame", "box")}
    predictions = {k: found[k] for k in ("frame", "box", "score", "score_unique")}
    ground_truth["cls"], predictions["cls"] = names[truth["cls"]], names[found["cls"]]
    return ground_truth, predictions, frames


@pytest.fixture(scope="session")
def write_table():
    """Function (path, table, frames) that writes a table as .npz or .json records."""

    def write(path, table, frames):
        if path.suffix == ".npz":
            boxes = read_boxes(table, path.name, scored="score" in table)
            return write_boxes(path, boxes, frames)
        keys = frame_keys(frames) if "name" in frames else frames["frame"].tolist()
        frame = [keys[i] for i in table["frame"]]
        columns = {name: column.tolist() for name, column in table.items()}
        columns["frame"] = frame
        rows = zip(*columns.values(), strict=True)
        return files.write_json(
            path, [dict(zip(columns, r, strict=True)) for r in rows]
        )

    return write


@pytest.fixture(scope="session")
def stored_scene(random_scene):
    """Ground truth, predictions, frames of `stored`."""
    return random_scene(8, num_frames=30, num_objects=90)


@pytest.fixture
def stored(stored_scene, write_table, tmp_path):
    """Folder with predictions, ground truth and frames as files, and their `Source`."""
    truth, found, frames = stored_scene
    write_table(tmp_path / "found.json", found, frames)
    write_table(tmp_path / "truth.npz", truth, frames)
    files.write_json(
        tmp_path / "frames.json", {k: v.tolist() for k, v in frames.items()}
    )
    return tmp_path, Source(ground_truth=str(tmp_path / "truth.npz"))
