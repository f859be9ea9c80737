"""`radejax evaluate` and `evaluate.py`: scores of a run or of files, and comparisons."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import click

from radejax.cli import entry
from radejax.cli.options import STEP, Command, echo_result, numbers, split_words
from radejax.core.errors import UserError


def _flag(name: str, text: str, **settings: Any) -> click.Option:
    return click.Option([f"--{name}"], help=text, **settings)


def _list(name: str, text: str) -> click.Option:
    """Of `--data A,B --data C`: A, B and C."""
    return _flag(name, text, multiple=True, callback=split_words, metavar="A,B,...")


_COMMON = (
    click.Argument(["others"], nargs=-1, metavar="[B C ...]"),
    _flag("workdir", "Folder of a run of train.py."),
    _flag("predictions", "File or folder."),
    _flag("compare", "Runs: folders of reports, or predictions.", metavar="A"),
    _flag("out", "Folder of the report; beside the predictions or in the workdir."),
    _flag(
        "split",
        "train, test, all or a split file; of a run also validation.",
        default="test",
    ),
    _flag("debug", "Show tracebacks of user errors.", is_flag=True),
)
_DATA = (
    _list("data", "Roots of K-Radar; with --workdir other ones than the run's."),
    _flag("labels", "Folder or zip of a label revision."),
    _flag("label-version", "v1.0, v1.1, v2.0, v2.1 (default), or a run's own."),
    click.Option(
        ["--sequences"],
        multiple=True,
        callback=numbers,
        metavar="1,58",
        help="Only frames of these.",
    ),
    _list("weather", "Only frames of these: fog,rain."),
)
_DATA_OF_RUNS = (
    _flag("records", "For a run: projected frames; made beside the data if missing."),
    _flag("camera-calibration", "For a run: folder of them; the data's own if none."),
    _flag("embeddings", "For a run: folder of `radejax embed` of other images."),
)
_RUNS = (
    _flag("min-score", "Of a run: predictions are kept from here on.", type=float),
    _flag("batch-size", "Of a run: frames at once.", type=int),
    _flag("num-visualizations", "Of a run: frames drawn.", type=int),
    click.Option(
        ["--checkpoint", "--step", "checkpoint"],
        type=STEP,
        help="Of a run; the newest by default.",
    ),
    _flag(
        "image-backbone", "Of a run: its weights, where they are not found any more."
    ),
    _flag(
        "exchange-images",
        "A seed; every frame of a run sees the image of another, as a control.",
        type=int,
    ),
)
_FILES = (
    _flag("ground-truth", "File of ground truth, or the folder of a report or a run."),
    _flag("frames", "JSON of frame columns, for it; the one beside it."),
    _flag("z-offset", "Metres to add to the z of predictions.", default=0.0),
    _flag("yaw-degrees", "Yaws of predictions are degrees.", is_flag=True),
)
_SCORING = (
    _list("classes", "K-Radar's five, or the run's, by default."),
    _list("protocols", "Beside exact; all, or the run's, by default."),
    click.Option(
        ["--iou", "--iou-thresholds", "iou_thresholds"],
        multiple=True,
        callback=split_words,
        metavar="A,B,...",
        help="IoU thresholds; 0.3,0.5,0.7, or the run's, by default.",
    ),
    _flag(
        "roi", "narrow, wide, none or x0,x1,y0,y1,z0,z1; narrow, or the run's, if none."
    ),
    _flag("score-threshold", "Predictions need more; 0, or the run's.", type=float),
    _flag(
        "empty-frames",
        "Frames left out: without the class, without any object, none; each protocol's "
        "own by default.",
        type=click.Choice(["protocol", "class", "frame", "none"]),
    ),
    _flag(
        "bootstrap",
        "Resamples of sequences for intervals: 200 by default, 2000 in --compare, the "
        "run's; 0: none.",
        type=int,
    ),
    _flag("name", "Name of the run in tables."),
    _flag(
        "invalid-sizes",
        "Predicted sizes that are not positive: an error by default.",
        type=click.Choice(["error", "false_positive"]),
    ),
)
_OF_OTHER_DATA = {option.name for option in _DATA + _DATA_OF_RUNS}
_ALL = [*_COMMON, *_DATA, *_DATA_OF_RUNS, *_RUNS, *_FILES, *_SCORING]


@click.command(cls=Command, params=_ALL)
@click.pass_context
def evaluate(ctx: click.Context, *, as_json: bool, **flags: Any) -> None:
    """Score a run, or predictions made elsewhere, or compare two and more.

    Predictions: .npz, .json, .csv, or a folder of text files as K-Radar's tools write
    them. Ground truth: --data (K-Radar), --labels (a label revision alone),
    --ground-truth (a file), or what lies in the folder of predictions.

    Example: radejax evaluate --workdir runs/quickstart

    Example: radejax evaluate --predictions found.json --data /data/kradar --out results

    Example: radejax evaluate --compare results_a results_b
    """
    modes = ("workdir", "predictions", "compare")
    if sum(flags[mode] is not None for mode in modes) != 1:
        raise UserError("give one of --workdir, --predictions and --compare A B")
    if flags["others"] and flags["compare"] is None:
        entry.check_leftovers(flags["others"])
    is_run = flags["workdir"] is not None
    typed = click.core.ParameterSource.COMMANDLINE
    given = {name for name in flags if ctx.get_parameter_source(name) is typed}
    others = _FILES if is_run else _RUNS + _DATA_OF_RUNS
    if lost := [option.name for option in others if option.name in given]:
        names = ", --".join(lost).replace("_", "-")
        raise UserError(f"--{names}: only {'without' if is_run else 'with'} --workdir")
    values: dict[str, Any] | list[dict[str, Any]]
    if is_run:
        if "data" in given and not flags["data"]:
            raise UserError("--data names no folder")
        values, text = _evaluate_run(flags, has_other=bool(given & _OF_OTHER_DATA))
    elif flags["compare"] is not None:
        values, text = _compare(flags)
    else:
        values, text = _evaluate_files(flags)
    echo_result(as_json, values, text)


def _evaluate_run(flags: dict[str, Any], has_other: bool) -> tuple[dict[str, Any], str]:
    """Runs the detector of a run over a split; the config of the run has the options."""
    from radejax.runs.evaluate import evaluate_run
    from radejax.runs.sources import Sources

    entry.set_up_jax()
    other: dict[str, Any] = {
        name: flags[name] or () for name in ("sequences", "weather")
    }
    other |= {name: flags[name] for name in _OF_OTHER_DATA - other.keys()}
    report = evaluate_run(
        flags["workdir"],
        step=flags["checkpoint"],
        split=flags["split"],
        out=flags["out"],
        image_backbone=flags["image_backbone"],
        exchange_images=flags["exchange_images"],
        other=Sources(**other) if has_other else None,
        **_scoring(flags),
        **_given(flags, "min_score", "batch_size", "num_visualizations"),
    )
    assert report is not None  # as this is the only process
    # The table has been logged already, to standard error.
    return report.metrics, f"Written to {report.files[0].parent}"


def _evaluate_files(flags: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Evaluates predictions in files."""
    from radejax.evaluation.report.compare import evaluate_files

    path = pathlib.Path(flags["predictions"])
    out = flags["out"] or path.with_name(f"{path.stem}_evaluation")
    report = evaluate_files(path, out, _source(flags), _options(flags, path.stem))
    return report.metrics, f"{report.text}\nWritten to {out}"


def _compare(flags: dict[str, Any]) -> tuple[list[dict[str, Any]], str]:
    """Compares runs with the first of them."""
    from radejax.evaluation.report.compare import compare_files
    from radejax.evaluation.report.report import plain

    if flags["bootstrap"] == 0:
        raise UserError("--bootstrap=0: a comparison needs resamples")
    text, rows = compare_files(
        [flags["compare"], *flags["others"]],
        flags["out"],
        _source(flags),
        _options(flags, "comparison"),
        resamples=2000 if flags["bootstrap"] is None else flags["bootstrap"],
    )
    return plain([dataclasses.asdict(row) for row in rows]), text.rstrip("\n")


def _source(flags: dict[str, Any]) -> Any:
    from radejax.evaluation.report.compare import Source

    return Source(
        data=flags["data"],
        labels=flags["labels"],
        label_version=flags["label_version"] or "v2.1",
        split=None if flags["split"] == "all" else flags["split"],
        ground_truth=flags["ground_truth"],
        frames=flags["frames"],
        sequences=flags["sequences"] or (),
        weather=flags["weather"],
        z_offset_m=flags["z_offset"],
        yaw_degrees=flags["yaw_degrees"],
    )


def _options(flags: dict[str, Any], name: str) -> Any:
    from radejax.evaluation.report.measure import Options

    values: dict[str, Any] = {"run": name, "bootstrap": 200}
    values |= {"label_version": flags["label_version"] or "v2.1", **_scoring(flags)}
    if values.get("empty_frames") == "none":
        values["empty_frames"] = None
    return Options(**values)


def _scoring(flags: dict[str, Any]) -> dict[str, Any]:
    """What was said of the scores, by the names of `Options` and `config.evaluation`."""
    from radejax.evaluation.columns import roi_bounds

    values = _given(flags, *(option.name for option in _SCORING))
    if "name" in values:
        values["run"] = values.pop("name")
    if "iou_thresholds" in values:
        values["iou_thresholds"] = _floats("iou", values["iou_thresholds"])
    if (roi := values.get("roi")) is not None:
        if "," in roi:
            roi = _floats("roi", roi.split(","))
        values["roi"] = None if roi == "none" else roi_bounds(roi)
    return values


def _given(flags: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: flags[name] for name in names if flags[name] not in (None, ())}


def _floats(name: str, words: Sequence[str]) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except ValueError:
        raise UserError(f"--{name} must be numbers, got {','.join(words)}") from None
