"""Tests of the ablations: runs, resuming, differences and verdicts."""

import dataclasses
import json
import pathlib
from typing import Any

import ablation
import numpy as np
import pytest
from click.testing import CliRunner

from radejax.config import load_config, with_texts
from radejax.core import files
from radejax.core.structures import CLASSES
from radejax.data.kradar import KRadar
from radejax.evaluation.report import write_report
from radejax.evaluation.results import ReportOptions
from radejax.simulation.dataset import simulate_dataset

SKILL = {"sigma 3": 0.4, "model": 0.7, "sigma 0.75": 0.9, "shuffled labels": 0.1}
"""Fraction of the objects that a cell detects; 0.5 by default."""

GRID = {"doppler": 4, "range": 32, "elevation": 5, "azimuth": 28}


class _Runs:
    """Replaces training and evaluation: a fraction of the objects is detected."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.trained: list[tuple[str, Any, Any]] = []
        self.simulated: set[tuple[str, str]] = set()
        self.stops_at: str | None = None
        patch.setattr(ablation.experiment, "run", self.run)
        patch.setattr(ablation, "evaluate_run", self.evaluate)
        patch.setattr(ablation, "simulate_dataset", self.simulate)

    def simulate(self, simulation: Any, root: pathlib.Path) -> pathlib.Path:
        self.simulated.add((root.name, simulation.to_json()))
        return root

    def run(self, config: Any, workdir: Any) -> None:
        name = workdir.parent.name.replace("_", " ")
        self.trained.append((name, config))
        if name != self.stops_at:
            (workdir / "evaluation").mkdir(parents=True)
            (workdir / "evaluation" / "metrics.json").write_text("{}")

    def evaluate(self, folder: pathlib.Path, *, out: Any, **options: Any) -> None:
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


def _call(out: pathlib.Path, *more: str) -> str:
    command = ["--table", "sigma", "--resamples", "40", "--out", str(out), *more]
    result = CliRunner().invoke(ablation.main, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_what_is_missing_is_run_and_judged(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    # Scenes are those of the seed, the same for all cells; no cell is trained on those
    # that it is evaluated on.
    assert sorted({name for name, _ in runs.simulated}) == [
        "quickstart-640-seed0",
        "quickstart-640-seed4",
        "quickstart-held",
    ]
    assert len(runs.simulated) == 3
    seeds = {n: json.loads(text)["seed"] for n, text in runs.simulated}
    assert len(set(seeds.values())) == 3
    for _, config in runs.trained:
        assert config.data.roots[0].endswith(f"quickstart-640-seed{config.seed}")
        assert config.simulation.seed == config.seed

    content = json.loads((tmp_path / "table_sigma.json").read_text())
    by = {(r["cell"], r["cls"]): r for r in content["rows"] if r["condition"] == "all"}
    row = by["sigma 0.75", "Sedan"]
    assert row["seeds"] == [0, 4]
    assert row["ap"] > 75 > 60 > by["sigma 3", "Sedan"]["ap"]
    base = by["sigma 3", "Sedan"]["ap"]
    assert row["difference"] == pytest.approx(row["ap"] - base)
    assert row["low"] < row["difference"] < row["high"]
    verdicts = {claim["text"]: claim["verdict"] for claim in content["claims"]}
    assert verdicts["0.75 is best for all classes"] == "supported"
    assert verdicts["sanity check: labels matter"] == "supported"
    assert "supported" in (tmp_path / "table_sigma.md").read_text()
    assert r"\begin{tabular}" in (tmp_path / "table_sigma.tex").read_text()
    # Tables share cells: nothing is run again.
    before = len(runs.trained)
    command = ["--table", "3", "--seeds", "0", "--resamples", "40"]
    CliRunner().invoke(ablation.main, [*command, "--out", str(tmp_path)])
    assert len(runs.trained) == before + 6  # not model, not the exchanged labels


def test_each_of_several_processes_has_seeds_of_its_own(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = _Runs(monkeypatch)
    with files.lock(tmp_path / "seed0.lock", "of another"):
        text = _call(tmp_path, "--seeds", "0,4")
    assert "seed 0: another process works on it" in text
    assert {config.seed for _, config in runs.trained} == {4}
    assert "12 of 12 runs are done" in _call(tmp_path, "--seeds", "0,4")


def test_splits_of_the_last_frames(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A study of several frames a sequence; others leave the splits as they are."""
    frames = [(number, f"{i + 7:05d}_{i:05d}") for number in (1, 2) for i in (1, 2, 3)]

    def simulate(simulation: Any, root: pathlib.Path) -> pathlib.Path:
        assert simulation.frames_per_sequence == 2
        if not root.exists():
            ablation.write_splits(root / "split", train=frames, test=frames[:2])
        return root

    monkeypatch.setattr(ablation, "simulate_dataset", simulate)
    work = ablation.Work(ablation.STUDIES["frames"], tmp_path)
    for seed in (0, 0, None):  # the same again: a command that is resumed
        root = pathlib.Path(work.data(work.study.cells["two frames"], seed))
        read = {p.stem: ablation.read_split(p) for p in root.glob("split/*.txt")}
        assert read == {"train": [frames[2], frames[5]], "test": [frames[1]]}
    assert work.held_split == "test"
    assert ablation.Work(ablation.STUDIES["3"], tmp_path).held_split == "all"


@pytest.mark.parametrize(
    ("numbers", "word"),
    [
        ((5.0, 1.0, 9.0, 0.0), "supported"),
        ((5.0, -1.0, 9.0, 0.0), "inconclusive"),
        ((-5.0, -9.0, -1.0, 0.0), "not reproduced"),
        ((3.0, 1.0, 5.0, 4.0), "inconclusive"),
        ((5.0, 1.0, 9.0, 4.0), "supported"),
        ((2.0, 1.0, 3.0, 4.0), "not reproduced"),
    ],
)
def test_verdicts(numbers: tuple[float, ...], word: str) -> None:
    assert ablation.verdict(*numbers) == word


def test_intervals_are_paired(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal runs have no difference, even with few scenes."""
    runs = _Runs(monkeypatch)
    monkeypatch.setitem(SKILL, "sigma 3", 0.5)
    _call(tmp_path, "--seeds", "1")
    assert len(runs.trained) == 6
    rows = json.loads((tmp_path / "table_sigma.json").read_text())["rows"]
    (row,) = (r for r in rows if (r["cell"], r["cls"]) == ("adaptive", "Sedan"))
    assert (row["difference"], row["low"], row["high"]) == (0, 0, 0)


@pytest.mark.parametrize("table", sorted(ablation.STUDIES))
def test_every_cell_is_a_config_and_its_command_makes_it(table: str) -> None:
    study = ablation.STUDIES[table]
    work = ablation.Work(study, pathlib.Path("/none"))
    seen = []
    for name, cell in study.cells.items():
        config = work.config(cell, 2)
        words = work.command(name, 2).split()
        file = ablation.CONFIGS.parent / words[words.index("--config") + 1]
        again = load_config(str(file))
        given = (
            word.removeprefix("--config.") for word in words if "--config." in word
        )
        texts = dict(text.split("=") for text in given)
        assert with_texts(again, texts) == config
        if not cell.exchanges:
            seen.append((config.model_dump_json(), cell.release))
        assert work.run_folder(name, 2).name == "seed2"
    assert len(set(seen)) == len(seen)  # cells differ
    for claim in study.claims:
        assert {claim.a, claim.b} <= set(study.cells)
        assert claim.cls in (*CLASSES, "mean")


def test_releases_are_made_of_the_tensors_of_the_same_scenes(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With real data: simulated tensors, the frames of the releases, their projections."""
    study = ablation.STUDIES["releases"]
    grid = {f"simulation.grid.num_{k}": n for k, n in GRID.items()}
    bins = {f"model.{k}_bins": GRID[k] for k in ("doppler", "elevation")}
    size = {"simulation.train_sequences": 2, "simulation.image_width": 32}
    cells = {
        name: dataclasses.replace(cell, fields={**bins, **cell.fields, **size, **grid})
        for name, cell in study.cells.items()
        if cell.config == study.cells[study.base].config
    }
    study = dataclasses.replace(study, cells=cells, held_out=3)
    work = ablation.Work(study, tmp_path)
    found = {}
    for seed, count in ((1, 4), (None, 3)):
        for name, cell in cells.items():
            root = work.data(cell, seed)
            frames = KRadar(root)
            assert len(frames) == count
            assert frames.release == (cell.release and cell.release.split()[0])
            found[name] = frames[0].read_projection(frames.grid)
            experiment_config = work.config(cell, seed or 0)
            if seed is not None:  # the run finds the data complete
                simulate_dataset(experiment_config.simulation, root)
    base, polar = found["input centered"], found["polar3d"]
    assert (base.max(-1) > polar.max(-1)).mean() > 0.95
    num_cells = [(found[f"{rate} % points"] > 0.5).sum() for rate in (10, 1, 0.1)]
    assert num_cells[0] > num_cells[1] > num_cells[2] > 0
    tensors = sorted(path.name for path in (tmp_path / "data").iterdir())
    assert tensors == [
        f"quickstart-{part}{end}"
        for part in ("2-seed1", "held")
        for end in ("", "-polar3d", "-rpc0.001", "-rpc0.01", "-rpc0.1", "-tensors")
    ]


@pytest.mark.parametrize("table", sorted(ablation.STUDIES))
def test_documented_numbers_are_those_of_the_table_beside(table: str) -> None:
    docs = ablation.CONFIGS.parent / "docs"
    stored = docs / "reports" / "ablations" / f"table_{table}"
    content = json.loads(stored.with_suffix(".json").read_text())
    page = (docs / "results.md").read_text()
    markdown = stored.with_suffix(".md").read_text()
    lines = (line.strip("|").split("|") for line in markdown.splitlines())
    claims = [[cell.strip() for cell in line] for line in lines]
    study = ablation.STUDIES[table]
    whole = [row for row in content["rows"] if row["condition"] == "all"]
    rows = {(row["cell"], row["cls"]): row for row in whole}
    for cell in study.cells:
        assert rows[cell, "mean"]["seeds"] == [0, 1, 2]
        aps = [f"{rows[cell, cls]['ap']:.1f}" for cls in (*CLASSES, "mean")]
        assert f"| {' | '.join([cell, '0, 1, 2', *aps])} |" in page
    for claim in content["claims"]:
        gap = "{difference:+.1f} ({low:.1f} to {high:.1f})".format(**claim)
        cells = claim["text"], claim["a"], claim["b"], claim["cls"], gap, "0, 1, 2"
        assert [*cells, claim["verdict"]] in claims
    assert [c["text"] for c in content["claims"]] == [c.text for c in study.claims]
    assert len(content["commands"]) == 3 * len(study.cells)
    assert not any(" /" in command for command in content["commands"].values())
