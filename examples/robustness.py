"""Evaluates runs on simulated radars that differ from that of their training in one effect.

    python examples/robustness.py runs/quickstart --out runs/robustness

The held-out scenes are the same for all radars: the presets "ideal" and "realistic", and the latter
with one field at the lowest or highest value of its range, or outside of it. Prints the mean over
the classes of the all-point AP (BEV, IoU 0.3) and the share that is lost compared with "realistic".
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

import click

from radejax.cli import entry
from radejax.core.errors import UserError
from radejax.evaluation.comparison import short_names
from radejax.evaluation.report import Table, rendered
from radejax.inference.saved import load_model
from radejax.runs.evaluate import evaluate_run
from radejax.simulation.config import PRESETS, RadarOptions
from radejax.simulation.dataset import simulate_dataset
from radejax.simulation.radar.tensor import DRAWN

HELD_OUT_SEED = 1_000_003  # that of `ablation.py`
OUTSIDE = {"gain_db": (202.0, 214.0), "leakage": (0.1,)}
"""Values outside of the ranges of "realistic"."""


def radars() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields name and fields of `simulation.radar` of every radar."""
    yield "ideal", {"preset": "ideal"}
    yield "realistic", {"preset": "realistic"}
    for name in sorted(DRAWN):
        low, high = PRESETS["realistic"][name]
        for value in (low, high, *OUTSIDE.get(name, ())):
            yield f"{name} {value:g}", {"preset": "realistic", name: value}


def mean_ap(
    run: pathlib.Path, name: str, radar: dict[str, Any], root: pathlib.Path, scenes: int
) -> float:
    """Returns the mean AP of a named run on scenes of a radar, simulated if missing."""
    simulation = load_model(run).config.simulation
    if simulation is None:
        raise UserError(f"{run} was not trained on simulated data")
    own = {k: v for k, v in simulation.radar if k.endswith("_elements")}
    options = simulation.replace(
        radar=RadarOptions(**own | radar),
        seed=HELD_OUT_SEED,
        output="projection",
        scenes="procedural",
        sequences=None,
        frame_stride=1,
        frames_per_sequence=simulation.frames_per_sequence or 1,
        train_sequences=0,
        test_sequences=scenes,
        vru_density_scale=1.0,
    )
    simulate_dataset(options, root)
    report = evaluate_run(
        run,
        split="all",
        out=root / "evaluation" / name.replace("/", "-"),
        other={"roots": (str(root),)},
        num_visualizations=0,
        bootstrap=0,
    )
    assert report is not None
    (found,) = (
        result.ap
        for result in report.results
        if (result.cls, result.space, result.iou) == ("mean", "bev", 0.3)
        and (result.protocol, result.condition) == ("all_point", "all")
    )
    return float(found)


@click.command()
@click.argument(
    "runs",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, path_type=pathlib.Path),
)
@click.option(
    "--out", default="runs/robustness", type=click.Path(path_type=pathlib.Path)
)
@click.option("--scenes", default=224, show_default=True, type=click.IntRange(1))
def main(runs, out, scenes):
    """Evaluate RUNS on every radar and write the table."""
    entry.set_up_jax()
    with entry.exit_codes():
        rows, whole = [], {}
        names = short_names(runs)
        for radar, fields in radars():
            root = out / f"data-{scenes}" / radar.replace(" ", "_")
            row = [radar]
            for run, name in zip(runs, names, strict=True):
                ap = mean_ap(run, name, fields, root.absolute(), scenes)
                whole[run] = ap if radar == "realistic" else whole.get(run)
                lost = f" ({1 - ap / whole[run]:+.0%})" if whole[run] else ""
                row.append(f"{ap:.1f}{lost}")
            rows.append(row)
            click.echo(" ".join(row))
        table = Table("mean AP by radar", ["radar", *names], rows)
        click.echo(rendered([table], "markdown", is_simulated=True))


if __name__ == "__main__":
    main()
