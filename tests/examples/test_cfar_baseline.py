"""The CFAR baseline from a dataset to its report."""

import json

import cfar_baseline as module
import pytest

from radejax.data.kradar import KRadar
from radejax.data.records import preprocess

from .. import small_models as small


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A small dataset without images, with records."""
    root = tmp_path_factory.mktemp("data")
    size = {"train_sequences": 2, "test_sequences": 1, "frames_per_sequence": 4}
    small.simulate(root, **size, image_width=0)
    preprocess(KRadar(root), root / "records", num_workers=0, progress=False)
    return root


def test_cfar_baseline_fits_detects_and_reports(data, tmp_path, capsys):
    report = module.run_baseline(data, tmp_path, protocols=("all_point",))
    assert "Sedan from" in capsys.readouterr().out
    assert (tmp_path / "report.txt").read_text() == report.text
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    of_sedans = (row for row in metrics["ap"] if row["cls"] == "Sedan")
    sedan = next(row for row in of_sedans if row["condition"] == "all")
    assert sedan["num_det"] > 0
    assert 0.0 < sedan["ap"] < 95.0
