"""`radejax`: the command line."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry, models
from radejax.cli.options import (
    COUNT,
    EXISTING,
    FILE,
    FOLDER,
    Group,
    echo_result,
    json_option,
)


@click.group(cls=Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show tracebacks of user errors.")
@click.version_option(package_name="radejax")
def main(debug: bool) -> None:
    """3D object detection in 4D radar tensors: data, detection, pictures.

    Training is `python train.py`.
    """
    del debug  # read by Group


for _command in models.COMMANDS:
    main.add_command(_command)


@main.command()
@click.option("--config", help="With a `simulation` section; small by default.")
@click.option("--out", required=True, type=FOLDER, help="Root of the new data set.")
@click.option("--seed", type=click.IntRange(0), help="Instead of the config's.")
@click.option("--scenes", help='"procedural", or a label folder or zip of K-Radar.')
@click.option("--sequences", help="Of the labels, such as 1,5,58; all by default.")
@click.option(
    "--frames", type=click.IntRange(0), help="A sequence; 0 for all of the labels."
)
@click.option("--full-size", is_flag=True, help="K-Radar's own grid and 2560 x 720.")
@click.option("--projections", is_flag=True, help="Write no tesseracts (260 MB each).")
@click.option(
    "--threads", type=COUNT, default=2, show_default=True, help="Frames at a time."
)
@json_option
def simulate(
    config: str | None,
    out: pathlib.Path,
    seed: int | None,
    scenes: str | None,
    sequences: str | None,
    frames: int | None,
    full_size: bool,
    projections: bool,
    threads: int,
    as_json: bool,
) -> None:
    """Simulate a data set in K-Radar's folders and file formats.

    Run again after an interruption, it goes on where it stopped. The same options give
    the same bytes, whatever the number of threads.

    Example: radejax simulate --scenes labels_v2_1.zip --sequences 5,11 --out data/sim
    """
    from radejax.core.config import load_config
    from radejax.core.errors import UserError
    from radejax.simulation.config import FULL_SIZE, default_config, plain
    from radejax.simulation.dataset import simulate_dataset

    entry.set_up_jax()
    simulation = default_config()
    if config is not None:
        section = load_config(config).get("simulation")
        if section is None:
            raise UserError(f"{config} has no `simulation` section")
        simulation = plain(section)
    given = {"seed": seed, "scenes": scenes, "frames_per_sequence": frames}
    simulation |= {name: value for name, value in given.items() if value is not None}
    if full_size:
        simulation |= FULL_SIZE
    if projections:
        simulation["output"] = "projection"
    if sequences is not None:
        try:
            simulation["sequences"] = [int(number) for number in sequences.split(",")]
        except ValueError:
            raise UserError(f"--sequences {sequences!r}, expected 1,5,58") from None
    simulate_dataset(simulation, out, num_threads=threads)
    echo_result(as_json, {"root": str(out)}, f"simulated data set in {out}")


@main.group()
def data() -> None:
    """Look at a copy of K-Radar."""


@data.command()
@click.argument("roots", nargs=-1, required=True, type=EXISTING)
@click.option("--labels", type=EXISTING, help="Folder or zip of a label revision.")
@click.option("--label-version", default="v2.1", show_default=True)
@click.option("--deep", is_flag=True, help="Read every tesseract whole.")
@json_option
def check(
    roots: tuple[pathlib.Path, ...],
    labels: pathlib.Path | None,
    label_version: str,
    deep: bool,
    as_json: bool,
) -> None:
    """Report what is there, what is missing and what is damaged.

    Exit code 1 if anything is missing or damaged.

    Example: radejax data check /disk1/kradar /disk2/kradar
    """
    from radejax.data.kradar.check import check_dataset

    report = check_dataset(
        roots, labels=labels, version=label_version, deep=deep, progress=not as_json
    )
    echo_result(as_json, report.to_dict(), report.to_text())
    if report.num_problems:
        raise SystemExit(entry.FAILED)


@main.command()
@click.argument("roots", nargs=-1, required=True, type=EXISTING)
@click.option("--out", required=True, type=FOLDER, help="Folder of the records.")
@click.option("--labels", type=EXISTING, help="Folder or zip of a label revision.")
@click.option("--label-version", default="v2.1", show_default=True)
@click.option(
    "--dtype", type=click.Choice(["float16", "uint8", "float32"]), default="float16"
)
@click.option("--workers", type=COUNT, help="Processes; one per core by default.")
@click.option(
    "--shard", default="0/1", show_default=True, help="Part i of n, i from 0."
)
@click.option(
    "--skip-bad", "--skip_bad", is_flag=True, help="Leave out what is corrupt."
)
@json_option
def project(
    roots: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    labels: pathlib.Path | None,
    label_version: str,
    dtype: str,
    workers: int | None,
    shard: str,
    skip_bad: bool,
    as_json: bool,
) -> None:
    """Project tesseracts to range-azimuth records; resumes where it stopped.

    Example: radejax project /disk1/kradar --out /fast/records --shard 3/16
    """
    from radejax.data.kradar import KRadar
    from radejax.data.records.job import parse_shard, project_dataset

    parse_shard(shard)  # before the labels are read
    frames = KRadar(roots, labels, version=label_version)
    click.echo(frames.summary().to_text(), err=True)
    summary = project_dataset(
        frames, out, dtype=dtype, num_workers=workers, shard=shard, skip_bad=skip_bad
    )
    echo_result(as_json, summary.to_dict(), summary.to_text())


@main.command()
@click.argument("name", metavar="FRAME")
@click.option("--data", "roots", multiple=True, required=True, type=EXISTING)
@click.option("--labels", type=EXISTING, help="Folder or zip of a label revision.")
@click.option("--label-version", default="v2.1", show_default=True)
@click.option("--out", type=FILE, default="overlay.png", show_default=True)
@click.option("--slices", is_flag=True, help="Range-azimuth, -Doppler, elevation.")
@click.option("--max-frames", type=COUNT, help="Of an animation; all by default.")
@json_option
def overlay(
    name: str,
    roots: tuple[pathlib.Path, ...],
    labels: pathlib.Path | None,
    label_version: str,
    out: pathlib.Path,
    slices: bool,
    max_frames: int | None,
    as_json: bool,
) -> None:
    """Draw one frame's labels on radar and camera: the first look at new data.

    FRAME is sequence/radar_lidar, or a sequence: its first frame, or all of them where
    --out ends in .gif or .mp4.

    Example: radejax overlay 1/00033_00001 --data ROOT
    """
    from radejax.cli.overlay import draw_overlay

    count = draw_overlay(
        name,
        roots,
        out,
        labels=labels,
        version=label_version,
        slices=slices,
        max_frames=max_frames,
    )
    echo_result(as_json, {"picture": str(out), "frames": count}, f"drew {out}")


@main.command()
@click.argument("roots", nargs=-1, required=True, type=EXISTING)
@click.option("--out", type=FILE, default="recording.rrd", show_default=True)
@click.option("--sequence", type=int, help="All by default.")
@click.option("--labels", type=EXISTING, help="Folder or zip of a label revision.")
@click.option("--label-version", default="v2.1", show_default=True)
@click.option("--workdir", type=EXISTING, help="Run whose detections are shown too.")
@click.option("--max-frames", type=COUNT, help="All by default.")
@click.option("--open", "open_it", is_flag=True, help="Open it in the viewer.")
@json_option
def view(
    roots: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    sequence: int | None,
    labels: pathlib.Path | None,
    label_version: str,
    workdir: pathlib.Path | None,
    max_frames: int | None,
    open_it: bool,
    as_json: bool,
) -> None:
    """Record a sequence for the rerun viewer (extra "viewer").

    Example: radejax view data/kradar --sequence 5 --out five.rrd --open
    """
    from radejax.cli.view import write_view
    from radejax.visualize.viewer import open_viewer

    count = write_view(
        roots,
        out,
        sequence=sequence,
        labels=labels,
        version=label_version,
        workdir=workdir,
        max_frames=max_frames,
    )
    if open_it:
        open_viewer(out)
    text = f"{count['frames']} frames written to {out}"
    if count["without_radar"]:
        text += f"; {count['without_radar']} without tesseract or projection left out"
    echo_result(as_json, {**count, "recording": str(out)}, text)
