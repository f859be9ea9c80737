"""What the camera adds, with a clean and with a covered lens.

    python train.py --config configs/quickstart_fusion.py
    python train.py --config configs/quickstart_fusion.py:radar
    python examples/fusion_by_lens.py runs/quickstart_fusion runs/quickstart_fusion-radar

Compares two runs on the same simulated test frames, by weather and by the state of the
lens, which the simulator knows: AP of both, their difference with an interval from
resampled sequences, and the camera's share in the fused map. Writes a table and a
picture into OUT. `--data ROOT` takes another simulated data set, on which both were
evaluated by `python evaluate.py --workdir RUN --data ROOT`, with the same `--split`.
"""

import collections
import pathlib

import click
import numpy as np
from tabulate import tabulate

from radejax.cli import entry
from radejax.core import files
from radejax.core.errors import UserError
from radejax.data.kradar.folders import SIMULATION_MARKER as MARKER
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files.load import Source, load
from radejax.evaluation.files.predictions import frame_keys
from radejax.evaluation.report import bootstrap
from radejax.evaluation.report.measure import repair_sizes
from radejax.inference.open import load as open_model
from radejax.runs.data import data_of_run
from radejax.runs.pictures import camera_share
from radejax.runs.sources import Sources
from radejax.simulation.camera.lens import cover_level
from radejax.visualize.camera_share import mean_share, write_camera_share

GROUPS = {
    "all": lambda weather, lens: True,
    "normal, overcast": lambda weather, lens: weather in ("normal", "overcast"),
    "other weather, lens clear": lambda weather, lens: (
        lens == "clear" and weather not in ("normal", "overcast")
    ),
    "lens partly covered": lambda weather, lens: lens == "partial",
    "lens heavily or fully covered": lambda weather, lens: lens in ("heavy", "full"),
}


def lens_of_frames(root, frames):
    """State of the lens in the rows of a frame table of a simulated data set."""
    marker = pathlib.Path(root) / MARKER
    if not marker.exists():
        raise UserError(f"{root} is no simulated data set: {MARKER} is missing")
    simulation = files.read_json(marker)["config"]
    if simulation["scenes"] != "procedural":
        raise UserError(f"{root}: the lens is known of procedural scenes only")
    is_drawn = simulation.get("camera_content", "scene") == "scene"
    if not simulation["cover_lens"] or not is_drawn:
        return np.full(len(frames["sequence"]), "clear")
    levels, counts = [], collections.Counter()  # frames count from 0 in a sequence
    for sequence, weather in zip(frames["sequence"], frames["weather"], strict=True):
        place = int(sequence), counts[sequence], str(weather)
        levels.append(cover_level(simulation["seed"], *place))
        counts[sequence] += 1
    return np.array(levels)


def evaluation_set(report, classes, roi, chosen):
    """Ground truth and predictions of a report on some of its frames."""
    truth, found, frames, _ = load(report, Source(), classes)
    found, _ = repair_sizes(found, "false_positive")
    ids = np.asarray(frames["frame"])[chosen]

    def cut(columns):
        is_in = np.isin(columns["frame"], ids)
        return {name: np.asarray(column)[is_in] for name, column in columns.items()}

    frames = {name: np.asarray(column)[chosen] for name, column in frames.items()}
    data = EvaluationSet(
        cut(truth), cut(found), classes=classes, frames=frames, roi=roi
    )
    return data, frames["sequence"]


def rows_of_group(name, reports, config, chosen, shares, resamples):
    """One row for Sedan, one for the mean of the classes that occur."""
    options = config.evaluation
    fusion, radar = (
        evaluation_set(report, tuple(config.classes), tuple(options.roi), chosen)
        for report in reports
    )
    found = bootstrap.compare(
        radar[0],
        fusion[0],
        radar[1],
        protocol_names=("exact",),
        spaces=("bev",),
        score_threshold=options.score_threshold,
        resamples=resamples,
    )
    return [
        {
            "condition": name,
            "frames": int(chosen.sum()),
            "class": row.cls,
            "radar": row.ap_a,
            "fusion": row.ap_b,
            "difference": row.difference,
            "low": row.low,
            "high": row.high,
            "camera share": shares.get(name),
        }
        for row in found
        if row.cls in ("Sedan", "mean")
    ]


@click.command()
@click.argument("fusion", type=click.Path(exists=True, path_type=pathlib.Path))
@click.argument("radar", type=click.Path(exists=True, path_type=pathlib.Path))
@click.option("--out", type=click.Path(path_type=pathlib.Path), help="Beside FUSION.")
@click.option(
    "--data", type=click.Path(exists=True), help="Another data set than the runs'."
)
@click.option("--split", default="test", show_default=True, help="Or all.")
@click.option("--resamples", default=1000, show_default=True)
def main(fusion, radar, out, data, split, resamples):
    """Compares FUSION with RADAR, two work folders evaluated on the same test split."""
    entry.set_up_jax()
    with entry.exit_codes():
        run = open_model(fusion)
        other = None if data is None else Sources(data=(data,))
        name = "" if other is None else f"_{other.name}"
        config, opened = data_of_run(run, fusion, other)
        out = out or fusion / f"by_lens{name}"
        reports = [folder / f"evaluation{name}" for folder in (fusion, radar)]
        dataset = opened.split(None if split == "all" else split)
        for report in reports:
            frames = load(report, Source(), tuple(config.classes))[2]
            if frame_keys(frames) != [frame.key for frame in dataset]:
                raise UserError(
                    f"{report} is of other frames than split {split} of "
                    f"{opened.paths.roots[0]}: evaluate both runs on it first"
                )
        lens = lens_of_frames(opened.paths.roots[0], frames)
        groups = {
            name: np.array(
                [
                    rule(w, level)
                    for w, level in zip(frames["weather"], lens, strict=True)
                ]
            )
            for name, rule in GROUPS.items()
        }
        level_of = {f.key: level for f, level in zip(dataset, lens, strict=True)}
        maps, counts = camera_share(
            run.model,
            run.variables,
            opened,
            list(dataset),
            group=lambda frame: next(
                name
                for name, rule in reversed(GROUPS.items())
                if rule(frame.weather, level_of[frame.key])
            ),
            max_frames=len(dataset),
        )
        out.mkdir(parents=True, exist_ok=True)
        ordered = {name: maps[name] for name in GROUPS if name in maps}
        write_camera_share(out, ordered, counts, run.grid)
        shares = {name: mean_share(share, run.grid) for name, share in ordered.items()}
        sequences = np.asarray(frames["sequence"])
        # Intervals come from resampled sequences: one alone has none.
        is_small = {
            name: len(set(sequences[chosen])) < 2 for name, chosen in groups.items()
        }
        for name in filter(is_small.get, groups):
            count = int(groups[name].sum())
            click.echo(f"left out: {name} ({count} frames, fewer than two sequences)")
        rows = [
            row
            for name, chosen in groups.items()
            if not is_small[name]
            for row in rows_of_group(name, reports, config, chosen, shares, resamples)
        ]
        files.write_json(out / "by_lens.json", rows)
        text = tabulate(rows, headers="keys", floatfmt=".2f")
        files.write_text(out / "by_lens.txt", text + "\n")
        click.echo(f"AP BEV, IoU 0.3, protocol exact\n\n{text}\n\nWritten to {out}")


if __name__ == "__main__":
    main()
