"""`radejax detect`: boxes of every frame below some folders."""

from __future__ import annotations

import pathlib
from typing import Any

import click

from radejax.cli import entry, options


@click.command(cls=options.Command)
@options.roots
@click.option(
    "--model",
    "--workdir",
    "source",
    required=True,
    type=options.EXISTING,
    help="Run of train.py, or what `radejax export` takes.",
)
@click.option("--out", required=True, type=options.FOLDER, help="Folder of the boxes.")
@click.option(
    "--step", type=options.STEP, help='Checkpoint step or "best". Default: latest.'
)
@options.sequences
@options.weather
@click.option("--score-threshold", type=float, help="Default: that of the config.")
@click.option("--nms-iou", type=float, help="Default: that of the config.")
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["json", "kitti"]),
    default="json",
    show_default=True,
    help="kitti: preds/000000.txt as K-Radar's tools write them.",
)
@click.option("--batch-size", type=options.COUNT, default=8, show_default=True)
@click.option(
    "--labels",
    type=options.EXISTING,
    help="Label revision used to find each frame's camera image.",
)
@click.option(
    "--image-backbone", type=options.EXISTING, help="Weights of the image backbone."
)
def detect(
    roots: tuple[pathlib.Path, ...],
    source: pathlib.Path,
    out: pathlib.Path,
    as_json: bool,
    **settings: Any,
) -> None:
    """Find boxes in every frame below the folders; one file per frame.

    The model is a run, its checkpoints, one of them, an exported folder or an official
    .pth file. A folder is a K-Radar root, a folder with tesseract_*.mat or projection
    files, or such a file itself. No labels are needed; a radar-camera model finds a
    frame's image by its label file, and uses the radar only without. What is
    written is scored by `radejax score OUT --data ROOT`.

    Example: radejax detect --workdir runs/quickstart --out boxes data/kradar/5
    """
    from radejax.inference.detect_files import detect_files

    entry.set_up_jax()
    count = detect_files(source, roots, out, **settings)
    text = f"{count['boxes']} boxes in {count['frames']} frames written to {out}"
    if count["clipped"]:
        text += f"; {count['clipped']} with a size that was clipped to be positive"
    if "radar_only" in count:
        text += f"; {count['radar_only']} without an image, from the radar only"
    options.echo_result(as_json, {**count, "out": str(out)}, text)
