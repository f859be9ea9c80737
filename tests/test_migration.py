"""Files that 0.1 wrote are read as before; `golden/v0_1_make.py` made them."""

import json
import pathlib
import shutil

import jax
import numpy as np
import pytest

from radejax import Detector
from radejax.core.errors import DataError
from radejax.core.structures import MIN_SIZE_M
from radejax.data.records.embeddings import open_embeddings
from radejax.data.records.projections import RecordSource, read_manifest
from radejax.inference.open import load

from . import small_models as small


@pytest.fixture
def old(golden: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
    shutil.unpack_archive(golden / "v0.1.zip", tmp_path)
    return tmp_path


def test_a_run_and_its_checkpoint(old: pathlib.Path) -> None:
    of_run, of_checkpoints = load(old / "run"), load(old / "run" / "checkpoints")
    assert of_run.grid.shape_drea == (2, 16, 3, 12)
    assert of_run.model == of_checkpoints.model
    assert of_run.settings == of_checkpoints.settings
    shapes = jax.eval_shape(
        of_run.model.init,
        jax.random.key(0),
        np.zeros((1, *of_run.grid.projection_shape), np.float32),
    )
    same = jax.tree.map(lambda x, y: x.shape == y.shape, of_run.variables, dict(shapes))
    assert all(jax.tree.leaves(same))


def test_records(old: pathlib.Path) -> None:
    manifest = read_manifest(old / "records")
    source = RecordSource(old / "records")
    assert manifest.grid == source.grid == load(old / "run").grid
    assert len(source) == len(manifest.frames) == 4
    values = np.stack([source.read(i) for i in range(4)])
    assert values.shape == (4, *manifest.grid.projection_shape)
    assert np.isfinite(values).all()
    assert values.std() > 0


def test_a_packed_model(old: pathlib.Path) -> None:
    detector = Detector.from_checkpoint(old / "packed", batch_sizes=(1,))
    found = detector(small.projections(1))
    with np.load(old / "packed_found.npz") as expected:
        assert expected["is_valid"].any()
        for name in ("is_valid", "classes"):
            np.testing.assert_array_equal(getattr(found, name), expected[name])
        boxes = expected["boxes"].copy()
        boxes[..., 3:6] = boxes[..., 3:6].clip(MIN_SIZE_M)  # as of 0.3
        np.testing.assert_allclose(found.boxes, boxes, atol=1e-5)
        np.testing.assert_allclose(found.scores, expected["scores"], atol=1e-5)


def test_embeddings(old: pathlib.Path) -> None:
    records = open_embeddings(old / "embeddings", small.camera_config().model.image)
    assert len(records) == 4
    assert np.isfinite(records.read(0)).all()
    assert set(records.index_of()) == set(read_manifest(old / "records").frames)


@pytest.mark.parametrize("name", ["records", "embeddings"])
def test_a_later_version_is_refused(old: pathlib.Path, name: str) -> None:
    path = old / name / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"version": 99}))
    read = read_manifest if name == "records" else open_embeddings
    with pytest.raises(DataError, match="99"):
        read(old / name)
