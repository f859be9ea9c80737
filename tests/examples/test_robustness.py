"""Radars that differ in one effect, and the table of what is lost with each."""

import pathlib
import types
from typing import Any

import pytest
import robustness
from click.testing import CliRunner

from radejax.config import load_config
from radejax.simulation.radar.tensor import DRAWN


def test_table_has_the_share_that_each_radar_loses(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated: list[Any] = []

    def evaluate(run: Any, *, other: Any, **_: Any) -> Any:
        is_loud = "noise_db" in other["roots"][0]
        values = {"cls": "mean", "space": "bev", "iou": 0.3, "condition": "all"}
        values |= {"protocol": "all_point", "ap": 30.0 if is_loud else 40.0}
        others = [values | {"iou": 0.5, "ap": 0.0}, values | {"cls": "Sedan"}]
        results = [types.SimpleNamespace(**v) for v in (*others, values)]
        return types.SimpleNamespace(results=results)

    config = load_config("quickstart")
    monkeypatch.setattr(
        robustness, "load_model", lambda run: types.SimpleNamespace(config=config)
    )
    monkeypatch.setattr(
        robustness, "simulate_dataset", lambda options, root: simulated.append(options)
    )
    monkeypatch.setattr(robustness, "evaluate_run", evaluate)
    run = tmp_path / "quickstart"
    run.mkdir()
    command = [str(run), "--out", str(tmp_path / "out"), "--scenes", "7"]
    done = CliRunner().invoke(robustness.main, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "| realistic | 40.0 (+0%) |" in " ".join(done.output.split())
    assert "| noise_db 108 | 30.0 (+25%) |" in " ".join(done.output.split())
    assert len(simulated) == 2 + 2 * len(DRAWN)
    for options in simulated:
        assert options.make_parameters().azimuth_elements == 40.0
        assert (options.train_sequences, options.test_sequences) == (0, 7)
        assert options.vru_density_scale == 1.0
