"""Measures what the camera adds with a clean and with a covered lens.

    python train.py --config configs/quickstart_fusion.py
    python train.py --config configs/quickstart_fusion.py:radar
    python examples/fusion_by_lens.py runs/quickstart_fusion runs/quickstart_fusion-radar

Two runs are compared on the same simulated test frames by weather and by the state of the lens,
which follows from the simulation's seed. The tables in OUT list the AP of both, their difference
with an interval from resampled sequences, and the weight of the camera in the fused map.
`--data ROOT` selects another simulated dataset on which both runs were evaluated with
`python evaluate.py --workdir RUN --data ROOT` and the same `--split`.
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
from radejax.evaluation.boxes import frame_keys
from radejax.evaluation.comparison import compare
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.files import Source, load
from radejax.evaluation.results import interval, repair_sizes, sequence_weights
from radejax.inference.saved import load_model as open_model
from radejax.runs.data import data_name, data_of_run
from radejax.runs.evaluate import report_options
from radejax.runs.figures import average_shares, frame_shares, mean_share
from radejax.simulation.camera.lens import cover_level

GROUPS = {
    "normal, overcast": lambda weather, lens: weather in ("normal", "overcast"),
    "other weather, lens clear": lambda weather, lens: (
        lens == "clear" and weather not in ("normal", "overcast")
    ),
    "lens partly covered": lambda weather, lens: lens == "partial",
    "lens heavily or fully covered": lambda weather, lens: lens in ("heavy", "full"),
}


def conditions(weather, lens):
    """Returns masks of frames by condition: all frames, each kind of weather, and `GROUPS`."""
    found = {"all": np.ones(len(weather), bool)}
    found |= {str(name): np.asarray(weather) == name for name in np.unique(weather)}
    for name, rule in GROUPS.items():
        found[name] = np.array([rule(*row) for row in zip(weather, lens, strict=True)])
    return found


def lens_of_frames(root, frames):
    """Returns the lens cover of each frame in the frame table of a procedural dataset."""
    marker = pathlib.Path(root) / MARKER
    if not marker.exists():
        raise UserError(f"{root} is not a simulated dataset: {MARKER} is missing")
    simulation = files.read_json(marker)["config"]
    if simulation["scenes"] != "procedural":
        raise UserError(f"{root}: the lens is known of procedural scenes only")
    is_drawn = simulation.get("camera_mode", "scene") == "scene"
    if not simulation["cover_lens"] or not is_drawn:
        return np.full(len(frames["sequence"]), "clear")
    levels, counts = [], collections.Counter()  # frames count from 0 in a sequence
    for sequence, weather in zip(frames["sequence"], frames["weather"], strict=True):
        place = int(sequence), counts[sequence], str(weather)
        levels.append(cover_level(simulation["seed"], *place))
        counts[sequence] += 1
    return np.array(levels)


def evaluation_set(report, classes, roi, chosen):
    """Returns the evaluation set of a report for some of its frames, and their sequences."""
    truth, found, frames, _ = load(report, Source(), classes)
    found, _ = repair_sizes(found, "false_positive")
    ids = np.asarray(frames["frame"])[chosen]
    truth, found = (boxes.take(np.isin(boxes.frame, ids)) for boxes in (truth, found))
    frames = {name: np.asarray(column)[chosen] for name, column in frames.items()}
    data = EvaluationSet(truth, found, classes=classes, frames=frames, roi=roi)
    return data, frames["sequence"]


def share_rows(share, sequence, groups, resamples):
    """Yields the mean weight of the camera by condition, and its difference to that of all frames.

    Args:
        share: `[F]` mean weight over the bins in view of each frame; NaN without an image.
        sequence: `[F]` sequence numbers.
        groups: `[F]` masks by condition.
        resamples: Number of resamples of sequences for 95 % intervals.
    """
    counts = sequence_weights(sequence, resamples=resamples, seed=0)
    counts = np.concatenate([np.ones((1, len(share))), counts])
    counts[:, np.isnan(share)] = 0.0
    share = np.nan_to_num(share)
    with np.errstate(invalid="ignore"):  # a resample may lack a condition
        means = {
            name: counts[:, chosen] @ share[chosen] / counts[:, chosen].sum(-1)
            for name, chosen in groups.items()
        }
    for name, values in means.items():
        row = {"condition": name, "frames": int(counts[0, groups[name]].sum())}
        for what, sample in (("share", values), ("difference", values - means["all"])):
            low, high = interval(sample[1:])
            row |= {what: float(sample[0]), f"{what} low": low, f"{what} high": high}
        yield row


def rows_of_group(name, reports, config, chosen, resamples):
    """Returns the APs of both runs in a condition for Sedan and the mean over classes."""
    options = report_options(
        config,
        protocols=("all_point",),
        min_score=config.evaluation.score_threshold,
        bootstrap=resamples,
    )
    fusion, radar = (
        evaluation_set(report, options.classes, options.roi, chosen)
        for report in reports
    )
    runs = {"": radar[0]}, {"": fusion[0]}
    found = compare(*runs, {"sequence": radar[1]}, options, spaces=("bev",))
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
        }
        for row in found
        if row.kind == "all" and row.cls in ("Sedan", "mean")
    ]


@click.command()
@click.argument("fusion", type=click.Path(exists=True, path_type=pathlib.Path))
@click.argument("radar", type=click.Path(exists=True, path_type=pathlib.Path))
@click.option(
    "--out",
    type=click.Path(path_type=pathlib.Path),
    help="Folder to write. Default: a folder in FUSION.",
)
@click.option(
    "--data", type=click.Path(exists=True), help="Another dataset than the runs'."
)
@click.option(
    "--split", default="test", show_default=True, help="Split to evaluate: test or all."
)
@click.option("--resamples", default=1000, show_default=True)
def main(fusion, radar, out, data, split, resamples):
    """Compare the workdirs FUSION and RADAR, which were evaluated on the same split."""
    entry.set_up_jax()
    with entry.exit_codes():
        run = open_model(fusion)
        other = None if data is None else {"roots": (data,)}
        name = "" if other is None else f"_{data_name(other)}"
        name += "" if split == "test" else f"_{split}"
        config, opened = data_of_run(run, other)
        out = out or fusion / f"by_lens{name}"
        reports = [folder / f"evaluation{name}" for folder in (fusion, radar)]
        dataset = opened.split(split)
        for report in reports:
            frames = load(report, Source(), config.classes)[2]
            if frame_keys(frames) != [frame.key for frame in dataset]:
                raise UserError(
                    f"{report} is of other frames than split {split} of "
                    f"{opened.options.roots[0]}: evaluate both runs on it first"
                )
        lens = lens_of_frames(opened.options.roots[0], frames)
        groups = conditions(frames["weather"], lens)
        level_of = {f.key: level for f, level in zip(dataset, lens, strict=True)}
        means = []

        def by_lens():
            found = frame_shares(run.model, run.variables, opened, list(dataset))
            for frame, share in found:
                means.append(mean_share(share, run.grid))
                place = frame.weather, level_of[frame.key]
                yield next(n for n, rule in GROUPS.items() if rule(*place)), share

        files.write_json(out / "camera_share.json", average_shares(by_lens(), run.grid))
        sequences = np.asarray(frames["sequence"])
        # Intervals come from resampled sequences, of which at least two are needed.
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
            for row in rows_of_group(name, reports, config, chosen, resamples)
        ]
        kept = {name: chosen for name, chosen in groups.items() if not is_small[name]}
        shares = [*share_rows(np.array(means), sequences, kept, resamples)]
        files.write_json(out / "by_lens.json", {"ap": rows, "share": shares})
        text = "\n\n".join(
            [
                "AP BEV, IoU 0.3, protocol all_point",
                tabulate(rows, headers="keys", floatfmt=".2f"),
                "Share of the camera in the fused map, and that less its share in all",
                tabulate(shares, headers="keys", floatfmt=".4f"),
            ]
        )
        files.write_text(out / "by_lens.txt", text + "\n")
        click.echo(f"{text}\n\nWritten to {out}")


if __name__ == "__main__":
    main()
