"""Figures of a run: which frames in which order, and what a sample looks like."""

import dataclasses
import functools
import json
from unittest import mock

import numpy as np
import pytest

from radejax.config import load_config
from radejax.core.structures import NARROW_ROI, Boxes
from radejax.data.kradar import KRadar
from radejax.evaluation.boxes import tables_from_frames
from radejax.evaluation.files import Source
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import figures
from radejax.runs.figures import draw_training_samples

from .. import small_models as small
from ..commands import run


def test_samples_are_drawn_with_their_augmentation(tmp_path, monkeypatch):
    draw = mock.Mock(wraps=figures.draw_samples)
    monkeypatch.setattr(figures, "draw_samples", draw)
    config = small.shrink_run(load_config("quickstart_fusion:short")).replace(
        simulation={"train_sequences": 1, "test_sequences": 0},
        data={"roots": (str(tmp_path / "data"),), "mirror_probability": 1.0},
        train={"batch_size": 3},
    )
    config = config.replace(simulation={"frames_per_sequence": 3})
    figure = draw_training_samples(config, count=2)
    rows, _ = draw.call_args.args
    assert len(rows) == 2
    titles = [ax.get_title() for ax in figure.axes]
    assert titles[:2] == [rows[0][0].title, "input of the network"]
    assert len(titles) == 8


def test_bins_out_of_view_and_frames_without_image_do_not_count():
    names = ("num_doppler", "num_range", "num_elevation", "num_azimuth")
    grid = RadarGrid.reduced(**dict.fromkeys(names, 2), max_range_m=20.0)
    first = np.array([[0.0, 0.2], [0.4, 0.0]])
    second = np.array([[0.0, 0.6], [0.0, 0.0]])
    nothing = np.zeros((2, 2))
    shares = [("fog", first), ("rain", second), ("fog", nothing), ("snow", nothing)]
    padded = [(name, np.pad(share, ((0, 0), (0, 3)))) for name, share in shares]
    assert figures.average_shares(padded, grid) == {
        "all": {"mean": pytest.approx(0.4), "frames": 2},
        "fog": {"mean": pytest.approx(0.3), "frames": 1},
        "rain": {"mean": pytest.approx(0.6), "frames": 1},
        "snow": {"mean": None, "frames": 0},
    }


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two simulated sequences of one frame."""
    sizes = {"train_sequences": 0, "test_sequences": 2, "frames_per_sequence": 1}
    return small.simulate(tmp_path_factory.mktemp("compared") / "data", **sizes)


def test_scenes_show_which_boxes_match(root):
    frames = KRadar([root])
    frame = frames[0]
    box = np.array([[10.0, 0, 0, 4, 2, 1.5, 0], [30, 0, 0, 4, 2, 1.5, 0]])
    far = [[50.0, 60.0, 0, 4, 2, 1.5, 0]]  # outside the region
    boxes, classes = np.concatenate([box, far]), np.array(["Sedan"] * 3)
    frame = dataclasses.replace(frame, boxes=boxes, classes=classes)
    found = Boxes.one_frame([far[0], box[1]], ["Sedan"] * 2, [0.9, 0.8])
    projection = frame.read_projection(frames.grid)
    draw = functools.partial(figures.frame_scene, frame, projection, frames.grid)
    scene = draw(predictions=found, roi=NARROW_ROI, iou=0.5)
    assert scene.matches is not None
    assert scene.matches.ground_truth.tolist() == [0, 1, -1]
    assert scene.matches.predictions.tolist() == [-1, 1]
    assert scene.matches.iou == 0.5
    scene = draw(predictions=Boxes.one_frame([], [], []))
    assert scene.matches is not None
    assert scene.matches.ground_truth.tolist() == [0, 0, 0]


def test_compared_runs_are_drawn_side_by_side(root, tmp_path, monkeypatch, caplog):
    frames = KRadar([root])
    rows = [
        {"frame": frame.key, "cls": str(cls), "box": box.tolist(), "score": 0.5}
        for frame in frames
        for cls, box in zip(frame.classes, frame.boxes, strict=True)
    ]
    paths = tmp_path / "all.json", tmp_path / "few.json"
    paths[0].write_text(json.dumps(rows))
    paths[1].write_text(json.dumps(rows[::2]))
    draw = mock.Mock(wraps=figures.draw_scenes)
    monkeypatch.setattr(figures, "draw_scenes", draw)
    words = ["compare", *paths, "--data", root, "--bootstrap", 5, "--figures", "pdf"]
    assert "--figures needs a folder" in run(*words, code=2).stderr
    run(*words, "--out", tmp_path / "out", "--roi", "wide")
    names = {path.name for path in (tmp_path / "out").glob("*.pdf")}
    curves = {"comparison_3d_iou30.pdf", "comparison_bev_iou30.pdf"}
    assert names == curves | {f"scenes_{frame.weather}.pdf" for frame in frames}
    for one, other in (call.args[0] for call in draw.call_args_list):
        assert one.title.startswith("all.json: ")
        assert other.title.startswith("few.json: ")
        assert one.matches is not None
        assert (one.matches.ground_truth != 0).all()  # all is found


def test_a_run_with_other_frame_ids_is_drawn_with_its_own(root, tmp_path, monkeypatch):
    frames = list(KRadar([root]))
    options = ReportOptions(roi=None, plots=False, protocols=("all_point",))
    paths = tmp_path / "all", tmp_path / "part"
    for path, chosen in zip(paths, (frames, frames[1:]), strict=True):
        truth, table = tables_from_frames(chosen)
        found = dataclasses.replace(truth, score=np.full(len(truth), 0.9))
        write_report(truth, found, table, path, options)
    drawn = []
    monkeypatch.setattr(figures, "draw_scenes", drawn.append)
    monkeypatch.setattr(figures, "save_figure", lambda *_: None)
    source = Source(data=(str(root),), sequences=(frames[1].sequence,))
    figures.draw_compared(paths, tmp_path, source, options, "png")
    assert len(drawn) == 1
    for scene in drawn[0]:
        assert scene.predictions is not None
        np.testing.assert_allclose(scene.predictions.box, frames[1].boxes)
