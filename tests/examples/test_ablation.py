"""Tests of the ablations: runs, resuming, differences and verdicts."""

import json
import pathlib

import ablation
import numpy as np
import pytest
from click.testing import CliRunner

from radejax.config import load_config, with_texts
from radejax.core.structures import CLASSES
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions

SKILL = {"sigma 3": 0.4, "model": 0.7, "sigma 0.75": 0.9, "shuffled labels": 0.1}
"""Fraction of the objects that a cell detects; 0.5 by default."""


class _Runs:
    """Replaces training and evaluation: a fraction of the objects is detected."""

    def __init__(self, patch):
        self.trained = []
        self.simulated = set()
        self.stops_at = None
        patch.setattr(ablation.experiment, "run", self.run)
        patch.setattr(ablation, "evaluate_run", self.evaluate)
        patch.setattr(ablation, "simulate_dataset", self.simulate)

    def simulate(self, simulation, root):
        self.simulated.add((root.name, simulation.to_json()))
        return root

    def run(self, config, workdir):
        name = workdir.parent.name.replace("_", " ")
        self.trained.append((name, config))
        if name != self.stops_at:
            (workdir / "evaluation").mkdir(parents=True)
            (workdir / "evaluation" / "metrics.json").write_text("{}")

    def evaluate(self, folder, *, out, **options):
        assert options["split"] == "all"
        frame, name = np.arange(60), folder.parent.name.replace("_", " ")
        box = np.tile([20.0, 0, 0, 4, 2, 1.5, 0], (60, 1))
        truth = {"frame": frame, "box": box, "cls": np.full(60, "Sedan")}
        rng = np.random.default_rng(int(folder.name[4:]))
        is_found = rng.random(60) < SKILL.get(name, 0.5)
        found = {key: column[is_found] for key, column in truth.items()}
        found["score"] = np.full(is_found.sum(), 0.9)
        frames = {"frame": frame, "sequence": frame, "weather": np.full(60, "fog")}
        write_report(
            truth, found, frames, out,
            ReportOptions(iou_thresholds=(0.3,), protocols=("all_point",), plots=False),
        )  # fmt: skip


def _call(out, *more):
    command = ["--table", "sigma", "--resamples", "40", "--out", str(out), *more]
    result = CliRunner().invoke(ablation.main, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_what_is_missing_is_run_and_judged(tmp_path, monkeypatch):
    runs = _Runs(monkeypatch)
    runs.stops_at = "adaptive"  # as a signal does
    text = _call(tmp_path, "--seeds", "0")
    assert "3 of 6 runs are done" in text
    assert "next: adaptive, seed 0" in text
    runs.stops_at = None
    text = _call(tmp_path, "--seeds", "0,4")
    assert "12 of 12 runs are done" in text
    names = [(name, config.seed) for name, config in runs.trained]
    cells = list(ablation.STUDIES["sigma"].cells)
    assert names == [(n, 0) for n in [*cells[:4], *cells[3:]]] + [(n, 4) for n in cells]
    content = json.loads((tmp_path / "table_sigma.json").read_text())
    by = {(r["cell"], r["cls"]): r for r in content["rows"] if r["condition"] == "all"}
    row = by["sigma 0.75", "Sedan"]
    assert row["seeds"] == [0, 4]


@pytest.mark.parametrize("table", sorted(ablation.STUDIES))
def test_every_cell_is_a_config_and_its_command_makes_it(table):
    study = ablation.STUDIES[table]
    work = ablation.Work(study, pathlib.Path("/none"))
    seen = []
    for name, cell in study.cells.items():
        config = work.config(cell, 2)
        words = work.command(name, 2).split()
        file = ablation.CONFIGS.parent / words[words.index("--config") + 1]
        again = load_config(str(file))
        given = [word for word in words if "--config." in word]
        texts = dict(word.removeprefix("--config.").split("=") for word in given)
        assert with_texts(again, texts) == config
        if not cell.exchanges:
            seen.append((config.model_dump_json(), cell.release))
        assert work.run_folder(name, 2).name == "seed2"
    assert len(set(seen)) == len(seen)  # cells differ
    for claim in study.claims:
        assert {claim.a, claim.b} <= set(study.cells)
        assert claim.cls in (*CLASSES, "mean")
