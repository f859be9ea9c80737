"""Commands of `radejax` that run a model: detect, evaluate, embed, export, benchmark."""

from __future__ import annotations

import pathlib

import click

from radejax.cli import entry
from radejax.cli.options import COUNT, EXISTING, FOLDER, STEP, echo_result, json_option


@click.command()
@click.argument("roots", nargs=-1, required=True, type=EXISTING)
@click.option(
    "--model",
    "--workdir",
    "source",
    required=True,
    type=EXISTING,
    help="Run of train.py, or what `radejax export` takes.",
)
@click.option("--out", required=True, type=FOLDER, help="Folder of the boxes.")
@click.option("--step", type=STEP, help="Of a run; the newest by default.")
@click.option("--score-threshold", type=float, help="Instead of the config's.")
@click.option("--nms-iou", type=float, help="Instead of the config's.")
@click.option("--batch-size", type=COUNT, default=8, show_default=True)
@click.option("--labels", type=EXISTING, help="Revision that names frames' images.")
@click.option("--image-backbone", "--image_backbone", type=EXISTING)
@json_option
def detect(
    roots: tuple[pathlib.Path, ...],
    source: pathlib.Path,
    out: pathlib.Path,
    step: int | str | None,
    score_threshold: float | None,
    nms_iou: float | None,
    batch_size: int,
    labels: pathlib.Path | None,
    image_backbone: pathlib.Path | None,
    as_json: bool,
) -> None:
    """Find boxes in every frame below the folders; one JSON file a frame.

    The model is a run, its checkpoints, one of them, an exported folder or an official
    .pth file. A folder is a K-Radar root, a folder with tesseract_*.mat or projection
    files, or such a file itself. No labels are needed; a radar-camera model finds a
    frame's image by its label file, and goes by the radar alone without.

    Example: radejax detect --workdir runs/quickstart --out boxes data/kradar/5
    """
    from radejax.inference.detect_files import detect_files

    entry.set_up_jax()
    count = detect_files(
        source,
        roots,
        out,
        step=step,
        batch_size=batch_size,
        labels=labels,
        image_backbone=image_backbone,
        score_threshold=score_threshold,
        nms_iou=nms_iou,
    )
    text = f"{count['boxes']} boxes in {count['frames']} frames written to {out}"
    if "radar_alone" in count:
        text += f"; {count['radar_alone']} without an image, from the radar alone"
    echo_result(as_json, {**count, "out": str(out)}, text)


@click.command()
@click.argument("roots", nargs=-1, required=True, type=EXISTING)
@click.option("--config", required=True, type=str, help="As of train.py, :words too.")
@click.option(
    "--image-backbone",
    "--image_backbone",
    required=True,
    type=EXISTING,
    help="DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.",
)
@click.option("--out", required=True, type=FOLDER, help="Folder of the embeddings.")
@click.option("--labels", type=EXISTING, help="Folder or zip of a label revision.")
@click.option("--dtype", type=click.Choice(["float32", "float16"]), default="float32")
@click.option("--batch-size", "--batch_size", type=COUNT, default=8)
@json_option
def embed(
    roots: tuple[pathlib.Path, ...],
    config: str,
    image_backbone: pathlib.Path,
    out: pathlib.Path,
    labels: pathlib.Path | None,
    dtype: str,
    batch_size: int,
    as_json: bool,
) -> None:
    """Run the front images through the frozen backbone once, to train from.

    Resumes where it stopped. Training then takes --embeddings OUT in place of images.

    Example: radejax embed /disk1/kradar --config configs/dinorade.py
    --image-backbone dinov3-vits16 --out /fast/embeddings
    """
    entry.set_up_jax()
    from radejax.core.config import load_config
    from radejax.data.kradar import KRadar
    from radejax.inference.embed import embed_dataset
    from radejax.interop import image_backbone as camera_inputs
    from radejax.models import build

    settings = load_config(config)
    camera_inputs.require_camera(settings)
    model = build(settings.model)
    variables = camera_inputs.load_image_backbone(image_backbone, settings)
    frames = KRadar(roots, labels, version=settings.data.label_version)
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
    echo_result(as_json, counts, text)


@click.command()
@click.option("--workdir", type=EXISTING, help="Run of train.py.")
@click.option("--predictions", type=EXISTING, help="File or folder, made elsewhere.")
@click.option("--data", multiple=True, type=EXISTING, help="K-Radar, for predictions.")
@click.option("--labels", type=EXISTING, help="Label revision, for predictions.")
@click.option("--step", type=STEP, help="Of the checkpoint; the newest by default.")
@click.option("--split", default="test", show_default=True)
@click.option("--image-backbone", "--image_backbone", type=EXISTING)
@click.option("--out", type=FOLDER, help="Folder of the report.")
@json_option
def evaluate(
    workdir: pathlib.Path | None,
    predictions: pathlib.Path | None,
    data: tuple[pathlib.Path, ...],
    labels: pathlib.Path | None,
    step: int | str | None,
    split: str,
    image_backbone: pathlib.Path | None,
    out: pathlib.Path | None,
    as_json: bool,
) -> None:
    """Score a run, or predictions in files, and write tables, curves and pictures.

    `python evaluate.py` has more options, among them the comparison of runs.

    Example: radejax evaluate --workdir runs/quickstart --split test
    """
    from radejax.core.errors import UserError

    if (workdir is None) == (predictions is None):
        raise UserError("give one of --workdir and --predictions")
    entry.set_up_jax()
    if workdir is not None:
        from radejax.runs.evaluate import evaluate_run

        found = evaluate_run(
            workdir, step=step, split=split, out=out, image_backbone=image_backbone
        )
    else:
        from radejax.evaluation.files.load import Source
        from radejax.evaluation.report.compare import evaluate_files
        from radejax.evaluation.report.measure import Options

        out = out or predictions.with_name(f"{predictions.stem}_evaluation")
        source = Source(
            data=tuple(map(str, data)),
            labels=None if labels is None else str(labels),
            split=None if split == "all" else split,
        )
        found = evaluate_files(predictions, out, source, Options(run=predictions.stem))
    # A run's table has been logged already, to standard error.
    text = "" if workdir is not None else found.text + "\n"
    echo_result(as_json, found.metrics, f"{text}written to {found.files[0].parent}")


@click.command()
@click.argument("source", type=EXISTING)
@click.option("--out", required=True, type=FOLDER, help="Folder to write.")
@click.option(
    "--format",
    "kind",
    type=click.Choice(["stablehlo", "huggingface"]),
    default="stablehlo",
    show_default=True,
)
@click.option(
    "--platforms", default="cpu,cuda,tpu", show_default=True, help="Of the program."
)
@click.option(
    "--image-backbone",
    "--image_backbone",
    type=EXISTING,
    help="Weights of the image backbone, where SOURCE is without.",
)
@click.option(
    "--with-backbone",
    "--with_backbone",
    is_flag=True,
    help="Keep the image transformer's weights. DINOv3's may not be passed on.",
)
@json_option
def export(
    source: pathlib.Path,
    out: pathlib.Path,
    kind: str,
    platforms: str,
    image_backbone: pathlib.Path | None,
    with_backbone: bool,
    as_json: bool,
) -> None:
    """Write a model as a folder that works elsewhere.

    SOURCE is the work folder of a run, its checkpoints, one of them, an exported folder
    or an official .pth file. "stablehlo" needs jax alone to run, for any batch size;
    "huggingface" is weights, config and model card. Detector.from_checkpoint reads both.

    Example: radejax export runs/quickstart --out exported
    """
    from radejax.inference import export as exporting
    from radejax.inference.open import open_detector

    entry.set_up_jax()
    detector, loaded = open_detector(source, image_backbone)
    done = exporting.export(
        detector,
        out,
        kind=kind,
        platforms=tuple(platforms.split(",")),
        training_config=loaded and loaded.config,
        with_backbone=with_backbone,
    )
    text = f"{done['bytes'] / 2**20:.1f} MiB written to {out}"
    if done["left_out"]:
        text += f", without {', '.join(done['left_out'])}"
    echo_result(as_json, done, text)


@click.command()
@click.argument("source", type=EXISTING, required=False)
@click.option("--config", help="Untrained model of a config instead of SOURCE.")
@click.option("--batch-size", "--batch_size", "batches", multiple=True, type=COUNT)
@click.option(
    "--input",
    "kind",
    type=click.Choice(["tesseract", "projection"]),
    default="tesseract",
    show_default=True,
)
@click.option("--repeats", type=COUNT, default=5, show_default=True)
@click.option("--dtype", type=click.Choice(["float32", "bfloat16"]))
@json_option
def benchmark(
    source: pathlib.Path | None,
    config: str | None,
    batches: tuple[int, ...],
    kind: str,
    repeats: int,
    dtype: str | None,
    as_json: bool,
) -> None:
    """Time from radar to boxes on this machine, and each stage's share.

    SOURCE as for `radejax export`. Batch sizes 1 and 10 unless given.

    Example: radejax benchmark runs/quickstart --batch-size 1
    """
    from radejax.core.errors import UserError
    from radejax.inference import benchmark as timing
    from radejax.inference.open import open_detector

    if (source is None) == (config is None):
        raise UserError("give one of SOURCE and --config")
    entry.set_up_jax()
    detector = (
        timing.untrained(config, dtype=dtype)
        if config is not None
        else open_detector(source, dtype=dtype)[0]
    )
    rows = timing.measure(
        detector, batches or (1, 10), repeats=repeats, tesseract=kind == "tesseract"
    )
    echo_result(as_json, rows, timing.as_table(rows))


COMMANDS = (detect, evaluate, embed, export, benchmark)
