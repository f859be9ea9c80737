"""`radejax evaluate`, `score` and `compare`: APs of a run, of files, and of several."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import click

from radejax.cli import entry
from radejax.cli.options import STEP, Command, echo_result, numbers, split_words
from radejax.core.errors import UserError


def _flag(name: str, text: str, **settings: Any) -> click.Option:
    return click.Option([f"--{name}"], help=text, **settings)


def _list(name: str, text: str, *others: str, **settings: Any) -> click.Option:
    """A list option: `--data A,B --data C` gives A, B and C."""
    settings = {"callback": split_words, "metavar": "A,B,...", **settings}
    return click.Option([f"--{name}", *others], help=text, multiple=True, **settings)


_DATA = (
    _list("data", "Roots of K-Radar; for a run, other ones than its own."),
    _flag("labels", "Folder or zip of a label revision."),
    _flag("label-version", "v1.0, v1.1, v2.0 or v2.1. Default: v2.1, or the run's."),
    _list("sequences", "Only frames of these.", callback=numbers, metavar="1,58"),
    _list("weather", "Only frames of these weathers, such as fog,rain."),
)
_DATA_OF_RUN = (
    _flag("records", "Preprocessed frames of --data; made there if missing."),
    _flag("camera-calibration", "Folder of camera calibrations of --data."),
    _flag("embeddings", "Folder of `radejax embed` of the images of --data."),
)
_RUN = (
    click.Argument(["run"], required=False),
    _flag("workdir", "The same as RUN."),
    click.Option(
        ["--checkpoint", "--step", "checkpoint"],
        type=STEP,
        help='Checkpoint step or "best". Default: latest.',
    ),
    _flag("image-backbone", "Weights of the image backbone, if they were moved."),
    _flag(
        "shuffle-images",
        "Seed. Sanity check: pair every frame with another frame's image.",
        type=int,
    ),
    _flag("min-score", "Discard predictions below before storing.", type=float),
    _flag("batch-size", "Frames per batch.", type=int),
    _flag("num-visualizations", "Number of frames to draw.", type=int),
)
_FILES = (
    _flag("ground-truth", "Ground-truth file, or folder of a report or of a run."),
    _flag("frames", "Frame table of --ground-truth. Default: frames.json next to it."),
    _flag("z-offset", "Meters to add to the z of predictions.", default=0.0),
    _flag("yaw-degrees", "Yaws of predictions are in degrees.", is_flag=True),
)
_COMMON = (
    _flag("out", "Output folder. Default: in the workdir or next to the predictions."),
    _flag("split", "train, test, all, a split file, or validation.", default="test"),
    _flag("name", "Name of the run in tables."),
    _flag("debug", "Show tracebacks of user errors.", is_flag=True),
)
_SETTINGS = (
    _list("classes", "Default: K-Radar's five, or the run's."),
    _list("protocols", "In addition to all_point. Default: all, or the run's."),
    _list(
        "iou",
        "IoU thresholds. Default: 0.3,0.5,0.7, or the run's.",
        "--iou-thresholds",
        "iou_thresholds",
    ),
    _flag(
        "roi", "narrow, wide, none or x0,x1,y0,y1,z0,z1. Default: narrow, or the run's."
    ),
    _flag(
        "score-threshold",
        "Score threshold of all protocols except all_point. Default: 0, or the run's.",
        type=float,
    ),
    _flag(
        "empty-frames",
        "Frames to ignore: without the class, without any object, none, or as each "
        "protocol does (default).",
        type=click.Choice(["protocol", "class", "frame", "none"]),
    ),
    _flag(
        "invalid-sizes",
        "Predicted sizes that are not positive. Default: error; false_positive for runs.",
        type=click.Choice(["error", "false_positive"]),
    ),
    _flag(
        "bootstrap",
        "Resamples of sequences for 95 % intervals; 0: none. Default: 200 (score), 2000 "
        "(compare), or the run's.",
        type=int,
    ),
)
_OTHER = [option.name for option in _DATA + _DATA_OF_RUN]


@click.command(cls=Command, params=[*_RUN, *_COMMON, *_DATA, *_DATA_OF_RUN, *_SETTINGS])
@click.pass_context
def evaluate(ctx: click.Context, *, as_json: bool, **flags: Any) -> None:
    """Evaluate a checkpoint of a run of `radejax train` on a split.

    Example: radejax evaluate runs/quickstart
    """
    from radejax.runs.evaluate import evaluate_run

    workdir = flags["run"] or flags["workdir"]
    if workdir is None:
        raise UserError("give the workdir of a run: radejax evaluate RUN")
    typed = click.core.ParameterSource.COMMANDLINE
    source = ctx.get_parameter_source
    if source("data") is typed and not flags["data"]:
        raise UserError("--data names no folder")
    other = {str(name): flags[str(name)] for name in _OTHER if flags[str(name)]}
    if "data" in other:
        other["roots"] = other.pop("data")
    entry.set_up_jax()
    report = evaluate_run(
        workdir,
        step=flags["checkpoint"],
        run=flags["name"],
        other=other or None,
        **{n: flags[n] for n in ("split", "out", "image_backbone", "shuffle_images")},
        **_scoring(flags, "min_score", "batch_size", "num_visualizations"),
    )
    assert report is not None  # as this is the only process
    # The tables have been logged to standard error.
    echo_result(as_json, report.metrics, f"Written to {report.folder}")


@click.command(
    cls=Command,
    params=[click.Argument(["predictions"]), *_COMMON, *_DATA, *_FILES, *_SETTINGS],
)
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
    options, name = _options(flags, bootstrap=200), flags["name"] or path.stem
    report = evaluate_files(path, out, _source(flags), options, run=name)
    echo_result(as_json, report.metrics, f"{report.text}\nWritten to {out}")


@click.command(
    cls=Command,
    params=[
        click.Argument(["runs"], nargs=-1, metavar="A B [C ...]"),
        *(*_COMMON, *_DATA, *_FILES, *_SETTINGS),
    ],
)
def compare(runs: tuple[str, ...], as_json: bool, **flags: Any) -> None:
    """Compare runs with the first of them.

    Each is the folder of a report, or predictions as `radejax score` takes them.

    Example: radejax compare runs/a/evaluation runs/b/evaluation
    """
    from radejax.evaluation.report import compare_files

    options = _options(flags, bootstrap=2000)
    text, rows = compare_files(runs, flags["out"], _source(flags), options)
    echo_result(as_json, rows, text.rstrip("\n"))


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
    """The settings that were given, by the names of `EvaluationOptions`."""
    names = [*(str(option.name) for option in _SETTINGS), *others]
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
