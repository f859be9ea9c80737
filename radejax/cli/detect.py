"""Commands that run or export a trained model: `radejax detect` and `export`."""

from __future__ import annotations

import itertools
import pathlib
from typing import TYPE_CHECKING, Any

import click

from radejax.cli import entry
from radejax.core.errors import UserError

if TYPE_CHECKING:
    from radejax.inference.saved import Step

_MAX_LISTED = 20


@click.command(cls=entry.Command)
@entry.roots
@click.option(
    "--model",
    "--workdir",
    "source",
    required=True,
    type=entry.EXISTING,
    help="Run of train.py, or any other SOURCE of `radejax export`.",
)
@entry.out_folder("Folder of the boxes.")
@entry.step
@entry.part
@entry.camera_calibration
@entry.score_threshold("Score threshold, or some by class. Default: the config's.")
@click.option(
    "--nms-iou",
    type=entry.FRACTION,
    help="IoU threshold of NMS. Default: the config's.",
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["json", "kitti", "csv"]),
    default="json",
    help="json: one file per frame. kitti: preds/000000.txt as K-Radar's tools write them. "
    "csv: a single table.",
)
@entry.batch_size(8, "Frames per call of the detector.")
@entry.image_backbone
@entry.json_option
def detect(
    roots: tuple[str, ...],
    source: str,
    out: pathlib.Path,
    step: Step,
    image_backbone: str | None,
    batch_size: int,
    file_format: str,
    as_json: bool,
    **options: Any,
) -> None:
    """Find boxes in every frame below the folders.

    The model is a run, its checkpoints, one of them, an exported folder or an official
    .pth file. A folder is a K-Radar root, a folder with tesseract_*.mat or projection
    files, or such a file itself. No labels are needed; a radar-camera model finds a
    frame's image by its label file, and uses the radar only without. What is
    written is scored by `radejax score OUT --data ROOT`. Frames whose files cannot be
    read, or with a box that is not finite, are listed, with exit code 1. The same command
    continues an interrupted one.

    Example: radejax detect --workdir runs/quickstart --out boxes data/kradar/5
    """
    from radejax.inference.detect_files import detect_files, find_inputs
    from radejax.inference.detector import Detector

    entry.set_up_jax()
    thresholds = {n: options.pop(n) for n in ("score_threshold", "nms_iou")}
    detector = Detector.from_workdir(
        source, step, image_backbone=image_backbone, **thresholds
    )
    inputs = find_inputs(detector, roots, **options)
    count, failed = detect_files(
        detector, inputs, out, batch_size=batch_size, file_format=file_format
    )
    text = f"{count['boxes']} boxes in {count['frames']} frames written to {out}"
    if count["done"]:
        text += f"; {count['done']} frames were done before"
    if count["clipped"]:
        text += f"; {count['clipped']} with a size that was clipped to be positive"
    if count["truncated"]:
        text += f"; {count['truncated']} more dropped by config.decode.max_detections"
    if "repeated" in count:
        text += f"; {count['repeated']} without a preceding frame, which were repeated"
    if count.get("radar_only"):
        reason = "without a label file, image or calibration"
        text += f"; {count['radar_only']} {reason}, from the radar only"
    if failed:
        text += f"; {len(failed)} failed"
        for key, reason in itertools.islice(failed.items(), _MAX_LISTED):
            text += f"\nfailed {key}: {reason}"
    entry.echo_result(as_json, {**count, "failed": failed, "out": str(out)}, text)
    if failed:
        raise SystemExit(entry.FAILED)


@click.command(cls=entry.Command)
@click.argument("source", type=entry.EXISTING)
@entry.out_folder("Folder to write.")
@click.option(
    "--format",
    "kind",
    type=click.Choice(["stablehlo", "onnx", "huggingface"]),
    default="stablehlo",
    help="Format of the exported folder.",
)
@entry.several(
    "--platforms",
    default=("cpu,cuda,tpu",),
    help="Platforms of the StableHLO program.",
)
@entry.image_backbone
@click.option(
    "--with-backbone",
    is_flag=True,
    help="Keep the weights of the image transformer. DINOv3's license restricts "
    "redistribution.",
)
@click.option(
    "--batch-size",
    type=entry.COUNT,
    help="Fixed batch size of the program. Default: any (stablehlo), 1 (onnx).",
)
@click.option(
    "--input",
    "radar_input",
    type=click.Choice(["projection", "tensor"]),
    default="projection",
    help="Radar data with which the program begins.",
)
@click.option(
    "--dtype",
    type=click.Choice(["float32", "bfloat16"]),
    help="Dtype of the computation; bfloat16 is for accelerators (stablehlo only). "
    "Default: the config's.",
)
@click.option(
    "--int8",
    is_flag=True,
    help="Compute convolutions in int8 (onnx only). Frames of the validation split, or else "
    "of the train split, calibrate it, and those of the test split give the APs in the "
    "README of the folder.",
)
@entry.several("--data", "roots", help="Roots for --int8. Default: those of the run.")
@click.option(
    "--half", is_flag=True, help="Store weights as float16 (huggingface only)."
)
@click.option(
    "--thresholds",
    type=click.Choice(["best_f1", "wanted_precision"]),
    help="Write the score thresholds into the model that `radejax evaluate` chose. Default: "
    "the config's.",
)
def export(
    source: str,
    out: pathlib.Path,
    image_backbone: str | None,
    dtype: str | None,
    thresholds: str | None,
    int8: bool,
    roots: tuple[str, ...],
    **settings: Any,
) -> None:
    """Export a model as a folder for other programs.

    SOURCE is the workdir of a run, its checkpoints, one of them, an exported folder or an
    official .pth file. "stablehlo" runs with jax, flatbuffers and numpy; "onnx" is for ONNX
    Runtime; "huggingface" is weights, config and model card. Detector.from_workdir reads
    all of them.

    Example: radejax export runs/quickstart --out exported
    """
    from radejax.inference import export as exporting
    from radejax.inference.detector import Detector
    from radejax.inference.saved import load_model, with_chosen_thresholds

    entry.set_up_jax()
    if roots and not int8:
        raise UserError("--data is only used with --int8")
    saved = load_model(source, image_backbone=image_backbone)
    if thresholds:
        saved = with_chosen_thresholds(saved, source, thresholds)
    detector = Detector(saved, dtype=dtype)
    if int8:
        from radejax.runs.quantize import export_int8

        num_bytes, left_out = export_int8(detector, out, roots, **settings)
    else:
        num_bytes, left_out = exporting.export(detector, out, **settings)
    text = f"{num_bytes / 2**20:.1f} MiB written to {out}"
    if left_out:
        text += f", without {', '.join(left_out)}"
    click.echo(text)
