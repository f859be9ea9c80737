"""Predictions and scores of a dataset: the same on one device and on eight."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from radejax import models
from radejax.core import devices
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.records import preprocess
from radejax.inference.detector import Detector
from radejax.inference.predict import predict_dataset
from radejax.inference.saved import SavedModel
from radejax.losses.detection import detection_loss
from radejax.runs.data import Data
from radejax.runs.evaluate import Evaluation

from .. import small_models as small


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    """Five simulated frames, and a detector that was never trained."""
    folder = tmp_path_factory.mktemp("predict")
    grid = {"num_doppler": 2, "num_range": 32, "num_elevation": 3, "num_azimuth": 28}
    counts = {"train_sequences": 0, "test_sequences": 1, "frames_per_sequence": 5}
    root = small.simulate(folder / "data", **counts, grid=grid, output="tesseract")
    config = small.radar_config().replace(
        data={"roots": (str(root),), "records": str(folder / "records")},
        evaluation={"score_threshold": 0.45, "batch_size": 3},
        logging={"num_visualizations": 1},
    )
    model = models.build(config.model)
    data = Data(config)
    preprocess(data.frames, folder / "records", num_workers=0, progress=False)
    records = data.records
    variables = small.drawn(model, np.zeros((1, *records.grid.projection_shape)))
    made = SimpleNamespace(config=config, model=model, variables=variables)
    made.data, made.records, made.frames = data, records, data.split("test")
    return made


def _predict(setup, num_devices):
    mesh = devices.make_mesh(num_devices)
    evaluation = Evaluation(setup.config, setup.data, mesh=mesh)
    return evaluation.predict(setup.variables, progress=False)


def _assert_same(actual, expected):
    np.testing.assert_array_equal(actual.frame, expected.frame)
    np.testing.assert_array_equal(actual.cls, expected.cls)
    np.testing.assert_allclose(actual.score, expected.score, rtol=1e-5)
    np.testing.assert_allclose(actual.box, expected.box, rtol=1e-4, atol=1e-4)


def test_eight_devices_and_a_detector_predict_the_same_as_one(setup):
    expected = _predict(setup, 1)
    assert set(expected.frame) == set(range(5))
    assert len(expected) > 50
    _assert_same(_predict(setup, 8), expected)
    saved = SavedModel(setup.config, setup.records.grid, setup.variables)
    detector = Detector(saved, score_threshold=0.45)
    alone = predict_dataset(detector, setup.records, setup.frames, 3, progress=False)
    _assert_same(alone, expected)


def test_scores_during_training_name_their_protocol(setup):
    scores = Evaluation(setup.config, setup.data).validate(setup.variables)
    name = "test/map_3d_iou30/coco101/score>0.45"
    assert any(key.startswith(name) for key in scores.values)
    aps = {key: x for key, x in scores.values.items() if "/m" in key or "/ap" in key}
    assert all("/simulated" in key for key in aps)
    assert any(key.endswith("/Sedan") for key in scores.values)
    means = [v for k, v in scores.values.items() if k.startswith(name)]
    assert means == [scores.best]
    assert list(scores.figures) == [f"test/01_{setup.frames[0].name}"]
    # The loss of eight devices is the mean of the losses of single frames.
    table = make_table(setup.records, setup.frames, max_objects=30)
    one_by_one = LoaderOptions(1, shuffle=False, num_epochs=1, num_threads=0)
    grid = models.map_grid(setup.records.grid, setup.model, "true")
    names = ("focal", "gwd", "weighted_sum")

    @jax.jit
    def terms_of(variables, batch):
        maps = setup.model.apply(variables, *batch.model_inputs(), train=False)
        terms = detection_loss(maps, batch, grid, setup.config.loss)[1]
        return jnp.stack([terms[name] for name in names])

    batches = make_loader(table, one_by_one)
    expected = [terms_of(setup.variables, batch) for batch in batches]
    found = [scores.values[f"test/{name}"] for name in names]
    np.testing.assert_allclose(found, np.mean(expected, 0), rtol=1e-4)
    assert scores.values["test/loss"] == pytest.approx(4.0)
