"""Commands that prepare datasets: from `simulate` and `data check` to `embed`."""

from __future__ import annotations

import pathlib
import time
from typing import TYPE_CHECKING, Any

import click

import radejax
from radejax.cli import entry
from radejax.core.errors import DataError, UserError
from radejax.core.files import read_object

if TYPE_CHECKING:
    from radejax.data.dataset import LabeledFrame
    from radejax.data.records import PreprocessReport

_rate = click.option(
    "--rate",
    type=entry.FRACTION,
    default=0.01,
    help="Fraction of the cells that become points.",
)


def _echo_report(report: PreprocessReport) -> None:
    """Prints a report; the exit code is 1 if frames were skipped."""
    click.echo(report.to_text())
    if report.skipped:
        raise SystemExit(entry.FAILED)


@click.command(cls=entry.Command)
@click.option(
    "--config", help="Config with a `simulation` section. Default: a small dataset."
)
@entry.out_folder("Root of the new dataset.")
@click.option("--seed", type=click.IntRange(0), help="Replaces the config's seed.")
@click.option(
    "--scenes", help='"procedural", a CSV file, or a label folder or zip of K-Radar.'
)
@entry.sequences
@click.option(
    "--frames",
    "frames_per_sequence",
    type=click.IntRange(0),
    help="Frames per sequence, of both splits with --scenes; 0 = all labeled frames.",
)
@click.option(
    "--full-size", is_flag=True, help="K-Radar's own grid and images of 2560 x 720."
)
@click.option(
    "--projections",
    "output",
    flag_value="projection",
    help="Write projections only, no radar tensors (260 MB each at full size).",
)
@click.option(
    "--radar", type=entry.EXISTING, help="radar.json of --fit: the radar to simulate."
)
@click.option(
    "--fit",
    "recordings",
    multiple=True,
    type=entry.EXISTING,
    metavar="RECORDING",
    help="Simulate nothing, but estimate the radar from radar tensors: tesseract_*.mat, or "
    "a folder of them. Can be repeated. Writes radar.json and fit.png into --out.",
)
@entry.workers
def simulate(
    config: str | None,
    out: pathlib.Path,
    radar: str | None,
    recordings: tuple[str, ...],
    full_size: bool,
    num_workers: int | None,
    **fields: object,
) -> None:
    """Simulate a dataset in K-Radar's folders and file formats.

    The same command resumes an interrupted simulation. The same options give the same
    bytes for any number of processes.

    Example: radejax simulate --scenes labels_v2_1.zip --sequences 5,11 --out data/sim
    """
    from radejax.simulation.config import FULL_SIZE, SimulationOptions
    from radejax.simulation.fitting import FITTED, fit_files

    entry.set_up_jax()
    if recordings:
        for name, value in fit_files(recordings, out).items():
            if name != "profile_db":
                click.echo(f"{name}: {value}")
        click.echo(f"wrote {out / FITTED} and {out / 'fit.png'}")
        return
    usual = radejax.load_config(config).simulation if config else SimulationOptions()
    if usual is None:
        raise UserError(f"{config} has no `simulation` section")
    values = dict(usual)
    if full_size:
        sizes = {"azimuth_elements", "elevation_elements"}  # of the coarse radar
        effects = {name: x for name, x in usual.radar if name not in sizes}
        values |= FULL_SIZE | {"radar": effects}
    if radar is not None:
        values |= read_object(radar, "grid", "radar")
    values |= {name: value for name, value in fields.items() if value is not None}
    simulation = SimulationOptions(**values)  # `replace` would merge both grids
    radejax.simulate(simulation, out, num_workers=num_workers)
    click.echo(f"simulated dataset in {out}")


@click.group()
def data() -> None:
    """Inspect a dataset."""


@data.command(cls=entry.Command)
@entry.roots
@entry.labeled_frames
@entry.camera_calibration
@click.option(
    "--deep", is_flag=True, help="Read every radar tensor and image completely."
)
@entry.json_option
def check(
    roots: tuple[str, ...],
    config: str | None,
    deep: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Report what is there, and what is missing, corrupted or implausible.

    Exit code 1 if anything is missing, corrupted or implausible.

    Example: radejax data check /disk1/kradar /disk2/kradar
    """
    from radejax.data.check import check_frames
    from radejax.data.kradar import check as kradar_check
    from radejax.data.options import DataOptions

    how = {"deep": deep, "progress": not as_json}
    if config is None:
        version = options.pop("label_version") or DataOptions().label_version
        report = kradar_check.check_dataset(roots, version=version, **how, **options)
    else:
        frames = entry.read_frames(roots, config, **options)
        classes = radejax.load_config(config).classes
        report = check_frames(frames, classes, roots, **how)
    entry.echo_result(as_json, report.to_dict(), report.to_text())
    if report.num_problems:
        raise SystemExit(entry.FAILED)


def _shard(text: str) -> tuple[int, int]:
    """Parses "i/n" as the shard (i, n), with i counted from 0."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise click.BadParameter(f"{text!r}, expected i/n with i from 0 to n - 1")
    return int(index), int(count)


@click.command(cls=entry.Command)
@entry.roots
@entry.out_folder("Folder of the records.")
@entry.labeled_frames
@click.option(
    "--dtype",
    type=click.Choice(["float16", "uint8", "float32"]),
    help="Type of the records. Default: that of existing ones, otherwise float16.",
)
@entry.workers
@click.option(
    "--shard",
    type=_shard,
    metavar="I/N",
    default="0/1",
    help="Every N-th frame from the I-th on, for several machines.",
)
def preprocess(
    roots: tuple[str, ...],
    out: pathlib.Path,
    config: str | None,
    dtype: str | None,
    num_workers: int | None,
    shard: tuple[int, int],
    **part: Any,
) -> None:
    """Project radar tensors to records of range-azimuth maps.

    Run again, it preprocesses only frames without a record. Frames whose radar tensor is
    missing or corrupted are skipped and listed, with exit code 1.

    Example: radejax preprocess /disk1/kradar --out /fast/records --shard 3/16
    """
    from radejax.data import records

    frames = entry.read_frames(roots, config, **part)
    click.echo(frames.summary().to_text(), err=True)
    report = records.preprocess(
        frames, out, dtype=dtype, shard=shard, num_workers=num_workers
    )
    _echo_report(report)


@click.command(cls=entry.Command)
@entry.roots
@entry.out_folder("Root of the new dataset.")
@click.option(
    "--to",
    "release",
    required=True,
    type=click.Choice(["polar3d", "rpc"]),
    help="polar3d: mean power and Doppler of every cell. rpc: the strongest cells.",
)
@_rate
def reduce(roots: tuple[str, ...], out: pathlib.Path, **options: Any) -> None:
    """Write the files of K-Radar's reduced releases from radar tensors.

    The other files of ROOTS become symbolic links. Run again, it writes only missing files.
    Tensors that are corrupted are skipped and listed, with exit code 1.

    Example: radejax reduce /disk1/kradar --to rpc --rate 0.01 --out /fast/points
    """
    from radejax.data.kradar.reduce import reduce_dataset

    _echo_report(reduce_dataset(roots, out, **options))


@click.command(cls=entry.Command)
@click.argument("paths", nargs=-1, required=True, type=entry.EXISTING)
@entry.out_folder("Folder of the points.")
@click.option(
    "--to",
    "suffix",
    type=click.Choice(["npy", "pcd", "bin"]),
    default="npy",
    help="Format: .npy as K-Radar's rpc files, .pcd of PCL, or float32 without a header.",
)
@click.option(
    "--method",
    type=click.Choice(["percentile", "cfar"]),
    default="percentile",
    help="percentile: the strongest cells; with --config, those of the range-azimuth map. "
    "cfar: bins that exceed their neighborhood.",
)
@entry.own_reader
@_rate
@click.option(
    "--threshold-db",
    type=entry.DECIBELS,
    default=9.0,
    help="Decibels above the mean of the neighborhood (cfar only).",
)
@entry.sequences
@entry.weather
def points(
    paths: tuple[str, ...],
    out: pathlib.Path,
    suffix: str,
    config: str | None,
    sequences: tuple[int, ...] | None,
    weather: tuple[str, ...] | None,
    **options: Any,
) -> None:
    """Write radar points of radar tensors, projections, polar3d or rpc files.

    PATHS are files and folders, or roots that the reader of --config reads.
    OUT/SEQUENCE/rpc_FRAME has the columns of K-Radar's rpc files. Existing files are
    replaced; points of other options are an error. Files that are corrupted are skipped
    and listed, with exit code 1.

    Example: radejax points /disk1/kradar --to pcd --method cfar --out clouds
    """
    import tqdm

    from radejax.core.manifest import Manifest
    from radejax.data.kradar.folders import is_elevation_axis_up, read_grid
    from radejax.data.kradar.points import read_points, write_points
    from radejax.data.kradar.radar_files import find_frames, sequence_folder
    from radejax.data.records import PreprocessReport

    sources: dict[pathlib.Path, pathlib.Path | LabeledFrame] = {}
    if config is not None:
        frames = entry.read_frames(paths, config, sequences=sequences, weather=weather)
        names = (f"{frame.sequence}/rpc_{frame.name}.{suffix}" for frame in frames)
        sources |= zip(map(out.joinpath, names), frames, strict=True)
        grid = frames.grid
        is_up = True
    else:
        files = find_frames(paths, sequences, weather)
        for path in files:
            name = f"rpc_{path.stem.rpartition('_')[2]}.{suffix}"
            target = out.absolute() / sequence_folder(path).name / name
            if target == path.absolute() or target in sources:
                raise UserError(
                    f"{sources.get(target, path)} and {path} would both be {target}; name "
                    "another --out, or roots of one form of radar data"
                )
            sources[target] = path
        folders = {sequence_folder(path).parent for path in files}
        roots = sorted({*map(pathlib.Path, paths), *folders})
        is_up = is_elevation_axis_up(roots)
        grid = read_grid(roots)
    skipped = dict[str, str]()
    Manifest.claim(out, "points", options, patterns=["rpc_*"])
    began = time.perf_counter()
    for target, source in tqdm.tqdm(sources.items(), "points", unit="frame"):
        try:
            cloud = read_points(source, grid, is_axis_up=is_up, **options)
        except (DataError, OSError) as error:
            skipped[getattr(source, "key", str(source))] = str(error)
            continue
        write_points(target, cloud)
    seconds = time.perf_counter() - began
    _echo_report(PreprocessReport(len(sources), 0, skipped, seconds))


@click.command(cls=entry.Command)
@click.argument("roots", nargs=-1, type=entry.EXISTING)
@click.option(
    "--config",
    required=True,
    help="Config as of `radejax train`, such as dinorade:official.",
)
@click.option(
    "--image-backbone",
    required=True,
    type=entry.EXISTING,
    help="DINOv3 (folder or file), DINOv2 folder, or torchvision's ResNet-50 file.",
)
@entry.out_folder("Folder of the embeddings.")
@entry.part
@entry.camera_calibration
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16"]),
    help="Type of the embeddings. Default: that of existing ones, otherwise float32.",
)
@entry.batch_size(8, "Images per call of the backbone.")
def embed(
    roots: tuple[str, ...],
    config: str,
    image_backbone: str,
    out: pathlib.Path,
    dtype: str | None,
    batch_size: int,
    **part: Any,
) -> None:
    """Precompute frozen-backbone features of the front camera images.

    Run again, it embeds only images without an embedding, such as those of another disk.
    Corrupted images are skipped and listed, with exit code 1.
    `radejax train --embeddings OUT` then needs no images.
    Without ROOTS, the dataset that the config simulates is used, and made if missing.

    Example: radejax embed /disk1/kradar --config dinorade
    --image-backbone dinov3-vits16 --out /fast/embeddings
    """
    from radejax import models
    from radejax.inference.embed import embed_dataset
    from radejax.models.dinorade import DinoRade
    from radejax.runs.data import located, simulate_missing
    from radejax.weights.image_backbone import load_image_backbone

    entry.set_up_jax()
    settings = radejax.load_config(config)
    model = models.build(settings.model)
    variables = load_image_backbone(image_backbone, model)
    assert variables is not None  # because a path is given
    assert isinstance(model, DinoRade)  # others have no image backbone to load
    if not roots:
        settings = located(settings)
        simulate_missing(settings)
        roots = settings.data.roots
    report = embed_dataset(
        model,
        variables,
        entry.read_frames(roots, settings, **part),
        out,
        dtype=dtype,
        resize=settings.data.used_camera.resize,
        batch_size=batch_size,
    )
    _echo_report(report)
