"""Commands on K-Radar's reduced releases, with two disks and a zip file of labels."""

import json
import types
import zipfile
from unittest import mock

import click.testing
import numpy as np
import pytest

from radejax import Detector, KRadar, frame_scene, models
from radejax.core.errors import DataError, UserError
from radejax.data.kradar.tesseract import read_tesseract
from radejax.data.records import Records
from radejax.inference.export import export
from radejax.inference.saved import SavedModel, save_model
from radejax.simulation.config import SimulationOptions

from .. import small_models as small
from ..commands import run

RELEASES = ("polar3d", "rpc")


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    """A simulated root with radar tensors."""
    grid = {"num_doppler": 4, "num_range": 24, "num_elevation": 3, "num_azimuth": 16}
    sizes = {"train_sequences": 2, "test_sequences": 1, "frames_per_sequence": 4}
    root = tmp_path_factory.mktemp("simulated") / "root"
    return small.simulate(root, **sizes, grid=grid, output="tesseract")


@pytest.fixture(scope="module", params=RELEASES)
def disks(request, tensors, tmp_path_factory):
    """Two disks, one with radar frames only, and a zip file of the labels."""
    folder = tmp_path_factory.mktemp(request.param)
    others, radar = folder / "others", folder / "radar"
    options = ("--to", request.param, "--rate", 0.1, "--out", others)
    assert "12 preprocessed" in run("reduce", tensors, *options).output
    for path in others.glob(f"*/{request.param}_*.npy"):
        target = radar / path.parent.name / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        path.rename(target)
    labels = folder / "labels.zip"
    with zipfile.ZipFile(labels, "w") as archive:
        for path in others.glob("*/info_label_v2_1/*.txt"):
            archive.write(path, f"{path.parts[-3]}/{path.name}")
            path.unlink()
    return request.param, (radar, others), labels


def _model(doppler_bins, root, release):
    """An untrained radar-only model for the simulated radar."""
    config = small.radar_config().replace(
        data={"release": release}, model={"doppler_bins": doppler_bins}
    )
    grid = KRadar(root).grid
    grid = grid if doppler_bins else grid.without_doppler()
    model = models.build(config.model)
    inputs = np.zeros((1, *grid.projection_shape), np.float32)
    return SavedModel(config, grid, small.drawn(model, inputs))


def test_frames_are_checked_preprocessed_and_drawn(disks, tmp_path):
    release, roots, labels = disks
    words = (*roots, "--labels", labels)
    report = json.loads(run("data", "check", *words, "--deep", "--json").output)
    assert report["summary"]["num_problems"] == 0
    assert [row["projections"] for row in report["sequences"]] == [4, 4, 4]
    records = tmp_path / "records"
    for shard, count in (("0/2", 6), ("0/1", 6)):
        text = run("preprocess", *words, "--out", records, "--shard", shard).output
        assert f"{count} preprocessed, 0 skipped" in text
    opened = Records.open(records)
    assert (len(opened.keys()), opened.source["release"]) == (12, release)
    assert opened.shape == (24, 16, 4 + 3)
    data = ("--data", ",".join(map(str, roots)), "--labels", labels)
    out = tmp_path / "a.png"
    run("overlay", min(opened.keys()), *data, "--slices", "--out", out)
    assert out.stat().st_size > 10_000
    frames = KRadar(roots, labels, visibility=None)
    projection = frames[0].read_projection(frames.grid)
    scene = frame_scene(frames[0], projection, frames.grid)
    assert scene.image is not None


def test_the_full_size_keeps_the_radar_of_the_config(tmp_path, monkeypatch):
    simulate = mock.Mock()
    monkeypatch.setattr("radejax.simulate", simulate)
    radar = {"preset": "ideal", "noise_db": 100.0, "azimuth_elements": 5.0}
    config = types.SimpleNamespace(simulation=SimulationOptions(radar=radar))
    monkeypatch.setattr("radejax.load_config", lambda _: config)
    run("simulate", "--config", "own", "--full-size", "--out", tmp_path / "out")
    options = simulate.call_args.args[0]
    assert dict(options.radar) == {"preset": "ideal", "noise_db": 100.0}


def test_boxes_are_found_in_files_and_arrays(disks, tensors, tmp_path):
    release, roots, _ = disks
    saved = _model({"polar3d": 4, "rpc": 0}[release], tensors, release)
    save_model(saved, tmp_path / "model")
    words = ("--workdir", tmp_path / "model", "--out", tmp_path / "boxes")
    text = run("detect", roots[0], *words, "--batch-size", 4).output
    assert "in 12 frames" in text
    paths = sorted(roots[0].glob(f"1/{release}_*.npy"))
    names = {f"1_{path.stem.partition('_')[2]}.json" for path in paths}
    assert names < {path.name for path in (tmp_path / "boxes").iterdir()}

    detector = Detector(saved, batch_sizes=(4,))
    arrays = [np.load(path) for path in paths]
    expected = np.asarray(detector(paths).boxes)
    assert detector.num_invalid_frames == 0
    for frames in (arrays, [arrays[0], *paths[1:]]):
        np.testing.assert_array_equal(np.asarray(detector(frames).boxes), expected)
    np.testing.assert_array_equal(detector(arrays[0]).boxes, expected[:1])
    detector(np.full(saved.grid.projection_shape, 0.5, np.float32))
    with pytest.raises(DataError, match=r"^frame: "):
        detector([arrays[0] * 1e13])
    with pytest.raises(UserError, match="input is 'tensor', expected projection, as"):
        export(detector, tmp_path / "program", radar_input="tensor")


@pytest.mark.parametrize("release", [None, "polar3d", "rpc"])
def test_a_detector_takes_the_form_that_it_was_trained_on(disks, tensors, release):
    found, roots, _ = disks
    detector = Detector(_model(4, tensors, release), batch_sizes=(1,))
    path = next(roots[0].glob(f"1/{found}_*.npy"))
    tensor = next(tensors.glob("1/radar_tesseract/*.mat"))
    frames = {found: (path, np.load(path), [np.load(path)])}
    frames[None] = tensor, read_tesseract(tensor)
    for form in frames.keys() - {release}:
        for frame in frames[form]:
            with pytest.raises(UserError, match="but the model is for"):
                detector(frame)


def test_points_of_two_disks(disks, tensors, tmp_path):
    release, (radar, others), _ = disks
    (radar / "9").mkdir(exist_ok=True)
    (radar / "9" / f"{release}_00001.npy").write_bytes(b"no array")
    words = ("--rate", 0.1, "--out", tmp_path / "found")
    text = run("points", radar, others, *words, code=1).output
    (radar / "9" / f"{release}_00001.npy").unlink()
    (radar / "9").rmdir()
    assert "12 preprocessed, 1 skipped" in text
    assert f"skipped {radar / '9' / release}_00001.npy: " in text
    expected = tmp_path / "expected"
    run("points", tensors, "--rate", 0.1, "--out", expected)
    paths = sorted(expected.glob("*/rpc_*.npy"))
    assert len(paths) == 12
    grid = KRadar(tensors).grid
    for path in paths:
        found = np.load(tmp_path / "found" / path.relative_to(expected))
        np.testing.assert_array_equal(found, np.load(path))
        assert found.shape[1] == 11
        # The elevation axis of simulated tensors points up.
        elevation_rad = grid.elevation_rad[found[:, 10].astype(int)]
        np.testing.assert_allclose(found[:, 2], found[:, 5] * np.sin(elevation_rad))
    words = ("--to", "pcd", "--method", "cfar", "--threshold-db", 3)
    run("points", radar, others, *words, "--sequences", 1, "--out", tmp_path / "c")
    assert len(list((tmp_path / "c").glob("1/rpc_*.pcd"))) == 4


@pytest.mark.slow
@pytest.mark.usefixtures("commands_on_one_device")
@pytest.mark.parametrize("doppler_bins", [4, 0])
def test_a_run_is_trained_evaluated_and_detects(disks, tmp_path, doppler_bins):
    from radejax.cli.train import train

    release, roots, labels = disks
    config = small.radar_config().replace(
        model={"doppler_bins": doppler_bins},
        data={"release": release},
        train={"batch_size": 4, "num_epochs": 1, "checkpoint_every_steps": 1},
        evaluation={"num_visualizations": 1},
    )
    path = small.write_config(tmp_path / "config.py", config)
    data = ["--data", ",".join(map(str, roots)), "--labels", str(labels)]
    words = [f"--config={path}", *data, f"--workdir={tmp_path / 'run'}"]
    words.append(f"--records={tmp_path / 'records'}")
    result = click.testing.CliRunner().invoke(train, words)
    assert result.exit_code == 0, result.output
    assert Records.open(tmp_path / "records").shape == (24, 16, doppler_bins + 3)
    assert (tmp_path / "run/evaluation/metrics.json").is_file()
    run("evaluate", tmp_path / "run", "--split", "train")
    words = ["--workdir", str(tmp_path / "run"), "--out", str(tmp_path / "boxes")]
    assert "in 12 frames" in run("detect", roots[0], *words).output
