"""`radejax simulate`: a dataset in K-Radar's folders and file formats."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry, options
from radejax.core.errors import UserError


@click.command(cls=options.Command)
@click.option(
    "--config", help="Config with a `simulation` section. Default: a small dataset."
)
@click.option(
    "--out", required=True, type=options.FOLDER, help="Root of the new dataset."
)
@click.option("--seed", type=click.IntRange(0), help="Replaces the config's seed.")
@click.option("--scenes", help='"procedural", or a label folder or zip of K-Radar.')
@options.sequences
@click.option(
    "--frames",
    type=click.IntRange(0),
    help="Frames per sequence; 0 = all labelled frames.",
)
@click.option(
    "--full-size", is_flag=True, help="K-Radar's own grid and images of 2560 x 720."
)
@click.option(
    "--projections",
    is_flag=True,
    help="Write projections only, no radar tensors (260 MB each).",
)
@click.option(
    "--workers",
    "num_workers",
    type=options.COUNT,
    help="Number of processes. Default: one per core.",
)
def simulate(
    config: str | None,
    out: pathlib.Path,
    seed: int | None,
    scenes: str | None,
    sequence_numbers: tuple[int, ...] | None,
    frames: int | None,
    full_size: bool,
    projections: bool,
    num_workers: int | None,
    as_json: bool,
) -> None:
    """Simulate a dataset in K-Radar's folders and file formats.

    The same command resumes an interrupted simulation. The same options give the same
    bytes for any number of processes.

    Example: radejax simulate --scenes labels_v2_1.zip --sequences 5,11 --out data/sim
    """
    from radejax.core.config import load_config
    from radejax.simulation.config import FULL_SIZE, default_config
    from radejax.simulation.dataset import simulate_dataset

    entry.set_up_jax()
    simulation = default_config()
    if config is not None:
        section = load_config(config).get("simulation")
        if section is None:
            raise UserError(f"{config} has no `simulation` section")
        simulation = dict(section)
    given = {"seed": seed, "scenes": scenes, "frames_per_sequence": frames}
    simulation |= {name: value for name, value in given.items() if value is not None}
    if full_size:
        simulation |= FULL_SIZE
    if projections:
        simulation["output"] = "projection"
    if sequence_numbers is not None:
        simulation["sequences"] = sequence_numbers
    simulate_dataset(simulation, out, num_workers=num_workers)
    options.echo_result(as_json, {"root": str(out)}, f"simulated dataset in {out}")
