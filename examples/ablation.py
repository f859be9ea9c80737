"""Repeats the ablations of both papers on simulated data and checks their claims.

    python examples/ablation.py --table sigma --seeds 0,1,2
    python examples/ablation.py --table 3 --minutes 60
    python examples/ablation.py --table 4 --seeds 0,1,2

| table | compares |
|---|---|
| 3 | RADE-Net's Table III: attention, heads, neck, stem, decoder |
| 4 | DinoRADE's Table 4: radar, camera, elevation weights, backbone |
| sigma | widths of the Gaussians in the heatmap targets |
| quickstart | the quickstart's input scaling and longer training |
| camera | the quickstart with and without a camera |
| augmentation | a random gain in training and none |
| frames | samples of two consecutive frames and of one |
| releases | radar tensors and K-Radar's reduced releases, made from the same scenes |
| polar3d_camera | polar3d with and without a camera |

A variant is an ordinary run of a config, or the run of another variant evaluated with shuffled
images. Runs are trained on the scenes of their seed and evaluated on held-out scenes, which are
the same for all variants. The same command resumes after an interruption. `--table_only` writes
the tables of the finished runs. Several processes with the same command share the seeds; give
each its own core (`taskset -c 0 python ...`).

AP is BEV at IoU 0.3 with the protocol `all_point`, averaged over the seeds. The 95 % intervals are
those of `radejax compare`: from paired resamples of the held-out sequences and, with three seeds or
more, the variance between seeds. A claim is supported in simulation if the interval lies above 0
and the difference reaches the claimed one, and not reproduced in simulation if the interval ends
below that.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import os
import pathlib
import re
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import click
import fusion_by_lens
import numpy as np
import pretrain_backbone
from ablation_studies import CONFIGS, STUDIES, Cell, Study
from ablation_tables import tables

from radejax.cli import entry
from radejax.config import Config, load_config
from radejax.core import files
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.core.version import radejax_commit
from radejax.data.kradar.folders import read_split
from radejax.data.kradar.reduce import reduce_dataset
from radejax.data.kradar.write import write_splits
from radejax.evaluation.comparison import difference
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load
from radejax.evaluation.report import rendered
from radejax.evaluation.results import repair_sizes, resample, sequence_weights
from radejax.runs import experiment
from radejax.runs.evaluate import evaluate_run
from radejax.simulation.config import SimulationOptions
from radejax.simulation.dataset import simulate_dataset

HELD_OUT_SEED = 1_000_003
COMMON = {
    "simulation.output": "projection",
    "simulation.test_sequences": 2,  # models are compared on the held-out scenes instead
    "evaluation.num_visualizations": 0,
}
"""Config fields of every run, in addition to those of the seed and the variant."""


@dataclasses.dataclass(frozen=True)
class Work:
    """Runs and data of a study.

    Attributes:
        study: The study.
        out: Folder of all runs and data.
    """

    study: Study
    out: pathlib.Path

    def fields(self, cell: Cell, seed: int) -> dict[str, Any]:
        """Returns the config fields of a run by dotted name."""
        return {"seed": seed, "simulation.seed": seed, **COMMON, **cell.fields}

    def config(self, cell: Cell, seed: int) -> Config:
        """Returns the config of a run."""
        name, _, options = cell.config.partition(":")
        config = load_config(f"{CONFIGS / name}.py:{options}")
        return config.with_fields(self.fields(cell, seed))

    def run_folder(self, name: str, seed: int) -> pathlib.Path:
        """Returns the workdir of the run that a variant trains or evaluates."""
        cell = self.study.cells[name]
        kind = cell.config.partition(":")[0]
        folder = (cell.exchanges or name).replace(" ", "_")
        return self.out / "runs" / kind / folder / f"seed{seed}"

    def report(self, name: str, seed: int) -> pathlib.Path:
        """Returns the folder of the evaluation of a variant on the held-out scenes."""
        end = "_shuffled" if self.study.cells[name].exchanges else ""
        return self.run_folder(name, seed) / f"held{end}"

    def is_done(self, name: str, seed: int) -> bool:
        """Returns True if a variant is trained and evaluated, as `cell.json` is written last."""
        return (self.report(name, seed) / "cell.json").exists()

    def root(self, cell: Cell, seed: int | None) -> pathlib.Path:
        """Returns the folder of the training data of a seed, or of held-out scenes for None."""
        kind, name = cell.config.partition(":")[0], "held"
        if seed is not None:
            name = f"{self.simulation(cell, seed).train_sequences}-seed{seed}"
        count = self.study.frames_per_sequence
        end = f"-{count}_frames" if count > 1 else ""
        end += f"-{cell.release.replace(' ', '')}" if cell.release else ""
        return self.out / "data" / f"{kind}-{name}{end}"

    def simulation(self, cell: Cell, seed: int) -> SimulationOptions:
        """Returns the options of the training data of a seed."""
        options = self.config(cell, seed).simulation
        assert options is not None
        return options

    def data(self, cell: Cell, seed: int | None) -> str:
        """Simulates the data of `root` if they are missing and returns their folder."""
        simulation = self.simulation(cell, seed or 0)
        if seed is None:
            simulation = simulation.replace(
                seed=HELD_OUT_SEED,
                frames_per_sequence=self.study.frames_per_sequence,
                train_sequences=0,
                test_sequences=self.study.held_out,
                vru_density_scale=1.0,  # only training scenes are scaled
            )
        root = self.root(cell, seed)
        if cell.release is None:
            simulate_dataset(simulation, root)
        else:
            # The releases share the tensors.
            tensors = self.root(dataclasses.replace(cell, release="tensors"), seed)
            simulate_dataset(simulation, tensors)
            release, _, rate = cell.release.partition(" ")
            report = reduce_dataset([tensors], root, release, float(rate or 0.01))
            if report.skipped:
                raise UserError(report.to_text())
        if self.study.frames_per_sequence > 1:
            keep_last_frames(root)
        return str(root)

    @property
    def held_split(self) -> str:
        """Split of the held-out scenes with the frames to evaluate."""
        return "all" if self.study.frames_per_sequence == 1 else "test"

    def alone(self) -> contextlib.AbstractContextManager[None]:
        """Returns a lock to hold while data that all seeds share are made."""
        return files.lock(self.out / "shared.lock")

    def backbone(self, cell: Cell) -> pathlib.Path | None:
        """Returns the path of the frozen image backbone of a variant, or None."""
        _, *options = re.split("[:,]", cell.config)
        if "resnet50" in options:
            return self.out / "backbone_resnet50" / pretrain_backbone.RESNET_FILE
        return self.out / "backbone" if "pretrained" in options else None

    def image_backbone(self, cell: Cell) -> str | None:
        """Pretrains the image backbone of a variant if it is missing and returns its path."""
        if (path := self.backbone(cell)) is None:
            return None
        folder = path.parent if path.suffix else path
        with self.alone():
            if not (folder / pretrain_backbone.REPORT).exists():
                pretrain_backbone.pretrain(self.config(cell, 0), folder)
        return str(path)

    def command(self, name: str, seed: int) -> str:
        """Returns the shell command that repeats and evaluates a run with the data in `out`."""
        cell = self.study.cells[name]
        file, _, options = cell.config.partition(":")
        fields = self.fields(cell, seed).items()
        # Paths are relative, because the tables are committed to the repository.
        data, held = map(
            os.path.relpath, (self.root(cell, seed), self.root(cell, None))
        )
        parts = [
            f"python train.py --config configs/{file}.py{options and f':{options}'}"
        ]
        parts += [f"--config.{key}={value}" for key, value in fields]
        parts.append(f"--data {data} --workdir RUN")
        if backbone := self.backbone(cell):
            parts.append(f"--image-backbone {os.path.relpath(backbone)}")
        end = f"--split {self.held_split} --data {held}"
        parts.append(f"&& python evaluate.py --workdir RUN {end}")
        return " ".join([*parts, *["--shuffle-images 0"] * bool(cell.exchanges)])

    def make(self, name: str, seed: int) -> bool:
        """Trains and evaluates a variant; returns False if a signal stopped its run."""
        cell, folder = self.study.cells[name], self.run_folder(name, seed)
        started, backbone = time.perf_counter(), self.image_backbone(cell)
        trained = folder / "evaluation" / "metrics.json"
        if not trained.exists():
            data = {"roots": (self.data(cell, seed),), "image_backbone": backbone}
            experiment.run(self.config(cell, seed).replace(data=data), folder)
        if not trained.exists():
            return False
        with self.alone():  # the held-out scenes are simulated and preprocessed once
            evaluate_run(
                folder,
                split=self.held_split,
                out=self.report(name, seed),
                image_backbone=backbone,
                shuffle_images=0 if cell.exchanges else None,
                other={"roots": (self.data(cell, None),)},
                num_visualizations=0,
            )
        minutes = (time.perf_counter() - started) / 60
        content = {"minutes": minutes, "command": self.command(name, seed)}
        files.write_json(self.report(name, seed) / "cell.json", content)
        return True


def keep_last_frames(root: pathlib.Path) -> None:
    """Reduces the splits of a simulated dataset to the last frame of every sequence."""
    last = {}
    for path in sorted(root.glob("split/*.txt")):
        entries = dict(sorted(read_split(path)))
        last[path.stem] = sorted(entries.items())
    write_splits(root / "split", **last)


# Comparing ----------------------------------------------------------------------------


def conditions(work: Work, frames: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Returns boolean masks `[F]` of frames by condition; camera studies add weather and lens.

    Conditions with fewer than two sequences are omitted, as they cannot be resampled.
    """
    weather = np.asarray(frames["weather"])
    found = {"all": np.ones(len(weather), bool)}
    base = work.study.cells[work.study.base]
    if base.config.startswith("quickstart_fusion"):
        lens = fusion_by_lens.lens_of_frames(work.data(base, None), frames)
        found = fusion_by_lens.conditions(weather, lens)
    sequence = np.asarray(frames["sequence"])
    return {n: mask for n, mask in found.items() if len(set(sequence[mask])) > 1}


_SEQUENCES = "sequences "


def resampled(
    work: Work, name: str, seed: int, resamples: int
) -> dict[str, np.ndarray]:
    """Returns the APs `[1 + B, C + 1]` in percent of a run by condition.

    The first row is over all sequences, the others are over resamples. The last column is the mean
    over the classes. "sequences CONDITION" has the number of sequences of each condition. The
    result is cached in the folder of the evaluation.
    """
    path = work.report(name, seed) / f"aps_{resamples}.npz"
    if path.exists():
        with np.load(path) as stored:
            return dict(stored)
    config = work.config(work.study.cells[name], seed)
    classes, roi = config.classes, config.evaluation.roi
    truth, found, frames, _ = load(path.parent, Source(), classes)
    found, _ = repair_sizes(found, "false_positive")
    data = EvaluationSet(truth, found, classes=classes, frames=frames, roi=roi)
    sequence, result = np.asarray(frames["sequence"]), {}
    for condition, mask in conditions(work, frames).items():
        weights = sequence_weights(sequence[mask], resamples=resamples, seed=0)
        weights = np.concatenate([np.ones_like(weights[:1]), weights])
        cut = config.evaluation.score_threshold
        aps = resample(
            data.of_frames(mask), weights, "all_point", "bev", 0.3, score_threshold=cut
        )
        result[condition] = aps.astype(np.float32)
        result[f"{_SEQUENCES}{condition}"] = np.array(len(set(sequence[mask])))
    with files.atomic_write(path) as file:
        np.savez_compressed(file, **result)
    return result


def verdict(difference: float, low: float, high: float, least: float = 0.0) -> str:
    """Returns the verdict on the claim that a difference is positive and at least `least`."""
    if low > 0 and difference >= least:
        return "supported"
    return "not reproduced" if high < least or high < 0 else "inconclusive"


@dataclasses.dataclass
class Comparer:
    """Computes the differences of variants over the seeds for which both are finished."""

    work: Work
    seeds: tuple[int, ...]
    resamples: int

    def __post_init__(self) -> None:
        self.samples = functools.cache(
            lambda name, seed: resampled(self.work, name, seed, self.resamples)
        )

    def done(self, *names: str) -> list[int]:
        """Returns the seeds for which all of the named variants are finished."""
        return [s for s in self.seeds if all(self.work.is_done(n, s) for n in names)]

    def aps(self, name: str, seeds: list[int], condition: str) -> np.ndarray:
        """Returns the APs `[N, 1 + B, C + 1]` of `resampled` of all seeds."""
        return np.stack([self.samples(name, s)[condition] for s in seeds])

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yields the AP of each variant, condition and class, and its difference to the base."""
        base = self.work.study.base
        for name in self.work.study.cells:
            if not (seeds := self.done(name)):
                continue
            both = self.done(name, base)
            for condition in self.samples(name, seeds[0]):
                if condition.startswith(_SEQUENCES):
                    continue
                whole = self.aps(name, seeds, condition)[:, 0]
                for index, cls in enumerate((*CLASSES, "mean")):
                    row = {"cell": name, "seeds": seeds, "condition": condition}
                    row |= {"cls": cls, "ap": float(whole[:, index].mean())}
                    row["ap_by_seed"] = whole[:, index].tolist()
                    if both and name != base and not np.isnan(row["ap"]):
                        row |= self.gap(name, base, cls, condition)
                    yield row

    def gap(self, a: str, b: str, cls: str, condition: str = "all") -> dict[str, Any]:
        """Returns the difference a - b of a class and its interval; empty without common seed."""
        if not (seeds := self.done(a, b)):
            return {}
        index = (*CLASSES, "mean").index(cls)
        ap_a, ap_b = (self.aps(n, seeds, condition)[..., index] for n in (a, b))
        count = int(self.samples(a, seeds[0])[f"{_SEQUENCES}{condition}"])
        found = difference(ap_b, ap_a, True, count)
        return {"difference": found.difference, "low": found.low, "high": found.high}

    def claims(self) -> Iterator[dict[str, Any]]:
        """Yields the study's claims with difference, interval and verdict."""
        for claim in self.work.study.claims:
            found = self.gap(claim.a, claim.b, claim.cls)
            word = verdict(**found, least=claim.least) if found else "open"
            seeds = self.done(claim.a, claim.b)
            yield dataclasses.asdict(claim) | found | {"seeds": seeds, "verdict": word}


def write_tables(
    work: Work, table: str, seeds: tuple[int, ...], resamples: int
) -> None:
    """Writes `table_<name>.md`, `.tex` and `.json` for the finished variants; prints two tables."""
    comparer = Comparer(work, seeds, resamples)
    rows, claims = list(comparer.rows()), list(comparer.claims())
    made = tables(work.study, rows, claims)
    radar = work.simulation(work.study.cells[work.study.base], 0).radar.preset
    content = {"radar": radar, "code": radejax_commit()}
    content |= {"rows": rows, "claims": claims, "resamples": resamples}
    content["commands"] = {
        f"{name}, seed {seed}": work.command(name, seed)
        for name in work.study.cells
        for seed in comparer.done(name)
    }
    path = work.out / f"table_{table}"
    files.write_json(path.with_suffix(".json"), content)
    for suffix, style in ((".md", "markdown"), (".tex", "latex")):
        text = rendered(made, style, is_simulated=True)
        if style == "markdown":
            text = f"Radar `{radar}`, tables written by commit {content['code']}.\n\n{text}"
        files.write_text(path.with_suffix(suffix), text)
    click.echo(rendered([made[0], made[-1]], is_simulated=True))
    click.echo(f"written to {path}.md, .tex and .json")


def progress(work: Work, left: list[tuple[str, int]], num_all: int) -> str:
    """Returns a text with the number of finished runs, the estimated time left and the next run."""
    paths = work.out.glob("runs/*/*/seed*/held*/cell.json")
    minutes = [files.read_json(path)["minutes"] for path in paths]
    hours = len(left) * float(np.mean(minutes)) / 60 if minutes else None
    about = "" if hours is None else f", about {hours:.1f} hours"
    names = "; next: {}, seed {}".format(*left[0]) if left else ""
    return f"{num_all - len(left)} of {num_all} runs are done{about}{names}"


def chosen(study: Study, cells: str | None) -> list[str]:
    """Returns the names of the selected variants, or of all variants if `cells` is empty."""
    names = [name.strip() for name in cells.split(",")] if cells else [*study.cells]
    if unknown := [name for name in names if name not in study.cells]:
        raise UserError(
            f"--cells: unknown variant {unknown[0]!r}, expected some of {', '.join(study.cells)}"
        )
    return names


@click.command()
@click.option("--table", type=click.Choice(sorted(STUDIES)), required=True)
@click.option("--seeds", default="0,1,2", show_default=True, help="Seeds to train.")
@click.option("--cells", help="Variants to train, comma-separated. Default: all.")
@click.option("--out", default="runs/ablation", type=click.Path(path_type=pathlib.Path))
@click.option(
    "--minutes", type=click.FloatRange(0), help="Save and stop after this time."
)
@click.option("--resamples", default=1000, show_default=True, type=click.IntRange(1))
@click.option("--table_only", is_flag=True, help="Write the tables without training.")
def main(table, seeds, cells, out, minutes, resamples, table_only):
    """Train the missing runs of a table and write the table."""
    entry.set_up_jax()
    with entry.exit_codes():
        seeds = tuple(map(int, seeds.split(",")))
        work = Work(STUDIES[table], out.absolute())
        every = list(itertools.product(seeds, chosen(work.study, cells)))

        def left(*of: int) -> list[tuple[str, int]]:
            return [(n, s) for s, n in every if s in of and not work.is_done(n, s)]

        if minutes is not None:  # SIGTERM makes a training save a checkpoint and stop
            alarm = threading.Timer(
                60 * minutes, os.kill, (os.getpid(), signal.SIGTERM)
            )
            alarm.daemon = True
            alarm.start()

        def report() -> None:
            if len(left(*seeds)) < len(every):
                write_tables(work, table, seeds, resamples)
            click.echo(progress(work, left(*seeds), len(every)))

        report()
        for seed in () if table_only else seeds:
            with contextlib.ExitStack() as held:
                try:
                    held.enter_context(files.lock(out / f"seed{seed}.lock", "busy"))
                except UserError:
                    click.echo(f"seed {seed}: another process works on it")
                    continue
                while todo := left(seed):
                    if not work.make(*todo[0]):
                        return
                    report()


if __name__ == "__main__":
    main()
