"""The benchmark measures the stages of a detector's call."""

import pathlib
from typing import Any

import pytest

from radejax.config import load_config

from . import small_models as small

pytestmark = pytest.mark.slow  # compiles each stage on its own


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(pathlib.Path(__file__).parents[1] / "benchmarks")
    import stages

    return stages


@pytest.mark.parametrize("kind", ["radar", "camera"])
def test_stages_add_up_and_are_shown(kind: str, stages: Any) -> None:
    detector = small.detector(kind)
    (row,) = stages.measure(detector, (2,), repeats=1)
    camera = (
        {"image_backbone", "image_neck", "image_fusion"} if kind == "camera" else ()
    )
    assert set(row["parts"]) == {"backbone", "neck", "heads", *camera}
    assert all(seconds > 0 for seconds in row["parts"].values())
    assert list(row["stages"]) == list(stages.STAGES)
    assert row["sum_s"] == pytest.approx(sum(row["stages"].values()))
    assert all(seconds > 0 for seconds in row["stages"].values())
    assert row["frames_per_s"] == pytest.approx(2 / row["whole_s"])
    text = stages.as_table([row])
    assert "batch 2" in text
    lines = [line for line in text.splitlines() if " %" in line]
    shares = {
        line.split("  ")[0]: float(line.split("(")[1].split(" %")[0]) for line in lines
    }
    assert "- image neck" in shares or kind == "radar"
    stages = [share for name, share in shares.items() if not name.startswith("- ")]
    assert sum(stages) == pytest.approx(100, abs=0.3)
    assert detector.replace(batch_sizes=(2,))._run is detector._run


def test_untrained_models_are_those_of_their_configs(stages: Any) -> None:
    detector = stages.untrained(load_config("quickstart"))
    options = detector.model.options
    channels = options.doppler_bins + options.elevation_bins
    assert detector.grid.projection_shape[-1] == channels
