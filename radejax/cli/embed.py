"""`radejax embed`: the frozen image backbone's embeddings of a data set."""

from __future__ import annotations

import pathlib
from typing import Any

import click

from radejax.cli import entry, options


@click.command(cls=options.Command)
@options.roots_or_none
@click.option("--config", required=True, help="As of `radejax train`, :options too.")
@click.option(
    "--image-backbone",
    required=True,
    type=options.EXISTING,
    help="DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.",
)
@click.option(
    "--out", required=True, type=options.FOLDER, help="Folder of the embeddings."
)
@options.labels
@options.sequences
@options.weather
@click.option("--dtype", type=click.Choice(["float32", "float16"]), default="float32")
@click.option("--batch-size", type=options.COUNT, default=8)
def embed(
    roots: tuple[pathlib.Path, ...],
    config: str,
    image_backbone: pathlib.Path,
    out: pathlib.Path,
    labels: pathlib.Path | None,
    dtype: str,
    batch_size: int,
    as_json: bool,
    **part: Any,
) -> None:
    """Run the front images through the frozen backbone once, to train from.

    Resumes where it stopped. Training then takes --embeddings OUT in place of images.
    Without ROOTS: of the data set that the config simulates, made if it is not there.

    Example: radejax embed /disk1/kradar --config dinorade
    --image-backbone dinov3-vits16 --out /fast/embeddings
    """
    from radejax import models
    from radejax.core.config import load_config
    from radejax.data.kradar import KRadar
    from radejax.inference.embed import embed_dataset
    from radejax.runs.data import located, simulate_missing
    from radejax.weights.image_backbone import load_image_backbone

    entry.set_up_jax()
    settings = load_config(config)
    model = models.build(settings.model)
    variables = load_image_backbone(image_backbone, model)
    assert variables is not None  # as there is a path
    if not roots:
        settings = located(settings)
        simulate_missing(settings)
    frames = KRadar(
        roots or settings.data.roots,
        labels,
        version=settings.data.label_version,
        **part,
    )
    counts = embed_dataset(
        model,
        variables,
        settings.model.image,
        frames,
        out,
        dtype=dtype,
        resize=settings.data.camera.resize,
        batch_size=batch_size,
    )
    text = ", ".join(f"{number:,} {name}" for name, number in counts.items())
    options.echo_result(as_json, counts, text)
