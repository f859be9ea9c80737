"""Stages of the benchmark are those of a detector's call."""

import pytest

from radejax.core.config import load_config
from radejax.inference import benchmark

from .. import small_models as small

pytestmark = pytest.mark.slow  # compiles each stage on its own


def test_stages_add_up_and_are_shown() -> None:
    detector = small.detector()
    (row,) = benchmark.measure(detector, (2,), repeats=1)
    assert list(row["stages"]) == list(benchmark.STAGES)
    assert row["sum_s"] == pytest.approx(sum(row["stages"].values()))
    assert all(seconds > 0 for seconds in row["stages"].values())
    assert row["frames_per_s"] == pytest.approx(2 / row["whole_s"])
    text = benchmark.as_table([row])
    assert "batch 2" in text
    shares = [float(part.split(" %")[0]) for part in text.split("(")[1:]]
    assert sum(shares) == pytest.approx(100, abs=0.3)
    assert detector.with_batch_sizes((2,))._run is detector._run


def test_untrained_models_are_those_of_their_configs() -> None:
    detector = benchmark.untrained(load_config(str(small.CONFIGS / "quickstart.py")))
    assert detector.grid.projection_shape[-1] == (
        detector.model.doppler_bins + detector.model.elevation_bins
    )
