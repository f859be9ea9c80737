"""`radejax evaluate`, `score` and `compare`: APs of a run, of files, and of several."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import click

from radejax.cli import entry
from radejax.cli.options import STEP, Command, echo_result, numbers, split_words
from radejax.core.errors import UserError

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _option(*names: str, **settings: Any) -> Decorator:
    return click.option(*names, default=None, **settings)


def _list(name: str, text: str) -> Decorator:
    """A list option: `--data A,B --data C` gives A, B and C."""
    return click.option(
        name, multiple=True, callback=split_words, metavar="A,B,...", help=text
    )


def _all(*decorators: Decorator) -> Decorator:
    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


_data = _all(
    _list("--data", "Roots of K-Radar; for a run, other ones than its own."),
    _option("--labels", help="Folder or zip of a label revision."),
    _option("--label-version", help="v1.0, v1.1, v2.0 or v2.1. Default: v2.1."),
    click.option(
        "--sequences",
        multiple=True,
        callback=numbers,
        metavar="1,58",
        help="Only frames of these sequences.",
    ),
    _list("--weather", "Only frames of these weathers, such as fog,rain."),
    click.option(
        "--split",
        default="test",
        show_default=True,
        help="train, test, all or a split file; for a run also validation.",
    ),
)
_settings = _all(
    _list("--classes", "Classes. Default: K-Radar's five, or the run's."),
    _list("--protocols", "In addition to all_point. Default: all, or the run's."),
    click.option(
        "--iou",
        "--iou-thresholds",
        "iou_thresholds",
        multiple=True,
        callback=split_words,
        metavar="A,B,...",
        help="IoU thresholds. Default: 0.3,0.5,0.7, or the run's.",
    ),
    _option(
        "--roi",
        help="narrow, wide, none or x0,x1,y0,y1,z0,z1. Default: narrow, or the run's.",
    ),
    _option(
        "--score-threshold",
        type=float,
        help="Score threshold of all protocols except all_point. Default: 0, or the "
        "run's.",
    ),
    _option(
        "--empty-frames",
        type=click.Choice(["protocol", "class", "frame", "none"]),
        help="Frames to ignore: without the class, without any object, or none. "
        "Default: as each protocol does.",
    ),
    _option(
        "--invalid-sizes",
        type=click.Choice(["error", "false_positive"]),
        help="Treatment of predicted sizes that are not positive. Default: error, or "
        "false_positive for a run.",
    ),
    _option(
        "--bootstrap",
        type=int,
        help="Resamples of sequences for 95 % intervals. Default: 200 (score), 2000 "
        "(compare), the run's (evaluate); 0: none.",
    ),
)
_of_files = _all(
    _option(
        "--ground-truth", help="Ground-truth file, or folder of a report or of a run."
    ),
    _option(
        "--frames",
        help="Frame table (JSON) for --ground-truth. Default: frames.json next to it.",
    ),
    click.option(
        "--z-offset", default=0.0, help="Meters to add to the z of predictions."
    ),
    click.option("--yaw-degrees", is_flag=True, help="Yaws are in degrees."),
)
_debug = click.option("--debug", is_flag=True, help="Show tracebacks of user errors.")
_name = _option("--name", help="Name of the run in tables.")
_OTHER_DATA = [
    "data",
    "labels",
    "label_version",
    "sequences",
    "weather",
    "records",
    "camera_calibration",
    "embeddings",
]


@click.command(cls=Command)
@click.argument("run", required=False)
@_option("--workdir", help="The same as RUN.")
@_option("--out", help="Folder of the report. Default: evaluation/ in the workdir.")
@_option(
    "--checkpoint",
    "--step",
    "checkpoint",
    type=STEP,
    help='Checkpoint step or "best". Default: latest.',
)
@_data
@_option("--records", help="Preprocessed frames of --data; made there if missing.")
@_option("--camera-calibration", help="Folder of camera calibrations of --data.")
@_option("--embeddings", help="Folder of `radejax embed` of the images of --data.")
@_option("--image-backbone", help="Weights of the image backbone, if they were moved.")
@_option(
    "--shuffle-images",
    type=int,
    metavar="SEED",
    help="Sanity check: pair every frame with another frame's image.",
)
@_settings
@_option("--min-score", type=float, help="Discard predictions below before storing.")
@_option("--batch-size", type=int, help="Frames per batch.")
@_option("--num-visualizations", type=int, help="Number of frames to draw.")
@_name
@_debug
def evaluate(run: str | None, workdir: str | None, as_json: bool, **flags: Any) -> None:
    """Evaluate a checkpoint of a run of `radejax train` on a split.

    Example: radejax evaluate runs/quickstart
    """
    from radejax.runs.evaluate import evaluate_run
    from radejax.runs.sources import Sources

    workdir = workdir or run
    if workdir is None:
        raise UserError("give the workdir of a run: radejax evaluate RUN")
    context = click.get_current_context()
    typed = click.core.ParameterSource.COMMANDLINE
    is_other = [context.get_parameter_source(name) is typed for name in _OTHER_DATA]
    if context.get_parameter_source("data") is typed and not flags["data"]:
        raise UserError("--data names no folder")
    other = {name: flags[name] for name in _OTHER_DATA}
    for name in ("sequences", "weather"):
        other[name] = other[name] or ()
    entry.set_up_jax()
    report = evaluate_run(
        workdir,
        step=flags["checkpoint"],
        split=flags["split"],
        out=flags["out"],
        image_backbone=flags["image_backbone"],
        shuffle_images=flags["shuffle_images"],
        other=Sources(**other) if any(is_other) else None,
        run=flags["name"],
        **_scoring(flags, "min_score", "batch_size", "num_visualizations"),
    )
    assert report is not None  # as this is the only process
    # The tables have been logged to standard error.
    text = f"Written to {report.files[0].parent}"
    echo_result(as_json, report.metrics, text)


@click.command(cls=Command)
@click.argument("predictions")
@_option("--out", help="Folder of the report. Default: next to the predictions.")
@_data
@_of_files
@_settings
@_name
@_debug
def score(predictions: str, as_json: bool, **flags: Any) -> None:
    """Evaluate predictions in files.

    PREDICTIONS is a .npz or .json file, a folder of `radejax detect`, or a folder of text
    files as K-Radar's tools write them. Ground truth: --data (K-Radar), --labels (a label
    revision without radar data), --ground-truth (a file), or the folder's own.

    Example: radejax score found.json --data /data/kradar --out results
    """
    from radejax.evaluation.report import evaluate_files

    path = pathlib.Path(predictions)
    out = flags["out"] or path.with_name(f"{path.stem}_evaluation")
    options = _options(flags, bootstrap=200)
    name = flags["name"] or path.stem
    report = evaluate_files(path, out, _source(flags), options, run=name)
    echo_result(as_json, report.metrics, f"{report.text}\nWritten to {out}")


@click.command(cls=Command)
@click.argument("runs", nargs=-1, required=True, metavar="A B [C ...]")
@_option("--out", help="Folder for comparison.txt and comparison.json.")
@_data
@_of_files
@_settings
@_debug
def compare(runs: tuple[str, ...], as_json: bool, **flags: Any) -> None:
    """Compare runs with the first of them.

    Each is the folder of a report, or predictions as `radejax score` takes them.

    Example: radejax compare runs/a/evaluation runs/b/evaluation
    """
    from radejax.evaluation.report import compare_files, plain

    options = _options(flags, bootstrap=2000)
    if options.bootstrap == 0:
        raise UserError("--bootstrap=0: a comparison needs 1 resample or more")
    text, rows = compare_files(
        runs, flags["out"], _source(flags), options, resamples=options.bootstrap
    )
    values = plain([dataclasses.asdict(row) for row in rows])
    echo_result(as_json, values, text.rstrip("\n"))


def _source(flags: dict[str, Any]) -> Any:
    from radejax.evaluation.files import Source

    same = ("data", "labels", "ground_truth", "frames", "weather", "yaw_degrees")
    return Source(
        label_version=flags["label_version"] or "v2.1",
        split=None if flags["split"] == "all" else flags["split"],
        sequences=flags["sequences"] or (),
        z_offset_m=flags["z_offset"],
        **{name: flags[name] for name in same},
    )


def _options(flags: dict[str, Any], bootstrap: int) -> Any:
    from radejax.evaluation.results import EvaluationOptions

    values = {"bootstrap": bootstrap, "label_version": flags["label_version"] or "v2.1"}
    return EvaluationOptions(**{**values, **_scoring(flags)})


def _scoring(flags: dict[str, Any], *others: str) -> dict[str, Any]:
    """The flags of `_settings` that were given, by the names of `EvaluationOptions`."""
    names = (
        *("classes", "protocols", "iou_thresholds", "roi", "score_threshold"),
        *("empty_frames", "invalid_sizes", "bootstrap", *others),
    )
    values = {name: flags[name] for name in names if flags[name] not in (None, ())}
    if "iou_thresholds" in values:
        values["iou_thresholds"] = _floats("iou", values["iou_thresholds"])
    if values.get("roi") == "none":
        values["roi"] = None
    elif "," in values.get("roi", ""):
        values["roi"] = _floats("roi", values["roi"].split(","))
    return values


def _floats(name: str, words: Sequence[str]) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except ValueError:
        raise UserError(f"--{name} must be numbers, got {','.join(words)}") from None
