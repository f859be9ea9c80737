"""`radejax export`: a model as a folder that works elsewhere."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry, options


@click.command(cls=options.Command)
@click.argument("source", type=options.EXISTING)
@click.option("--out", required=True, type=options.FOLDER, help="Folder to write.")
@click.option(
    "--format",
    "kind",
    type=click.Choice(["stablehlo", "onnx", "huggingface"]),
    default="stablehlo",
    show_default=True,
)
@click.option(
    "--platforms",
    default="cpu,cuda,tpu",
    show_default=True,
    help="Of the StableHLO program.",
)
@click.option(
    "--image-backbone",
    type=options.EXISTING,
    help="Weights of the image backbone, if SOURCE has none.",
)
@click.option(
    "--with-backbone",
    is_flag=True,
    help="Keep the weights of the image transformer. DINOv3's license restricts "
    "redistribution.",
)
@click.option(
    "--batch-size",
    type=options.COUNT,
    default=1,
    show_default=True,
    help="Batch size of the ONNX files.",
)
@click.option(
    "--half", is_flag=True, help="Store weights as float16 (huggingface only)."
)
def export(
    source: pathlib.Path,
    out: pathlib.Path,
    kind: str,
    platforms: str,
    image_backbone: pathlib.Path | None,
    with_backbone: bool,
    batch_size: int,
    half: bool,
    as_json: bool,
) -> None:
    """Write a model as a folder that works elsewhere.

    SOURCE is the workdir of a run, its checkpoints, one of them, an exported folder or an
    official .pth file. "stablehlo" runs with jax only, for any batch size; "onnx" is for
    ONNX Runtime and TensorRT, for one batch size; "huggingface" is weights, config and
    model card. Detector.from_checkpoint reads all of them.

    Example: radejax export runs/quickstart --out exported
    """
    from radejax.inference import export as exporting
    from radejax.inference.detector import Detector

    entry.set_up_jax()
    done = exporting.export(
        Detector.from_checkpoint(source, image_backbone=image_backbone),
        out,
        kind=kind,
        platforms=tuple(platforms.split(",")),
        with_backbone=with_backbone,
        batch_size=batch_size,
        half=half,
    )
    text = f"{done['bytes'] / 2**20:.1f} MiB written to {out}"
    if done["left_out"]:
        text += f", without {', '.join(done['left_out'])}"
    options.echo_result(as_json, done, text)
