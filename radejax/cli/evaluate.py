"""`radejax evaluate` and `evaluate.py`: scores of a run or of files, and comparisons."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import click

from radejax.cli import entry
from radejax.cli.options import STEP, Command, echo_result, split_words
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
)
_DATA_OF_RUNS = (
    _flag("records", "For a run: projected frames; made beside the data if missing."),
    _flag("camera-calibration", "For a run: folder of them; the data's own if none."),
    _flag("embeddings", "For a run: folder of `radejax embed` of other images."),
)
_RUNS = (
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
    _flag("ground-truth", "File of ground truth."),
    _flag("frames", "JSON of frame columns, for it."),
    _list("classes", "K-Radar's five by default."),
    _list("protocols", "All by default."),
    _list("iou", "IoU thresholds; 0.3,0.5,0.7 by default."),
    _flag("roi", "narrow, wide or none.", default="narrow"),
    _flag("score-threshold", "Predictions need more than this.", default=0.0),
    _flag(
        "bootstrap",
        "Resamples of sequences for intervals: 200 by default, 2000 in --compare; "
        "0: none.",
        type=int,
    ),
    _flag("name", "Name of the run in tables."),
    _flag(
        "invalid-sizes",
        "Predicted sizes that are not positive.",
        type=click.Choice(["error", "false_positive"]),
        default="error",
    ),
)
_OF_OTHER_DATA = {option.name for option in _DATA + _DATA_OF_RUNS}
_BY_CONFIG = (
    "config.evaluation of the run says that; its predictions can be scored again by "
    "--predictions WORKDIR/evaluation"
)


@click.command(cls=Command, params=[*_COMMON, *_DATA, *_DATA_OF_RUNS, *_RUNS, *_FILES])
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
        reason = _BY_CONFIG if is_run else "only with --workdir"
        raise UserError(f"--{', --'.join(lost)}: {reason}")
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
    other = {name: flags[name] for name in _OF_OTHER_DATA}
    report = evaluate_run(
        flags["workdir"],
        step=flags["checkpoint"],
        split=flags["split"],
        out=flags["out"],
        image_backbone=flags["image_backbone"],
        exchange_images=flags["exchange_images"],
        other=Sources(**other) if has_other else None,
    )
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
    )


def _options(flags: dict[str, Any], name: str) -> Any:
    from radejax.evaluation.report.measure import Options

    try:
        thresholds = tuple(float(word) for word in flags["iou"])
    except ValueError:
        raise UserError(
            f"--iou must be numbers, got {','.join(flags['iou'])}"
        ) from None
    chosen = {key: flags[key] for key in ("classes", "protocols") if flags[key]}
    if thresholds:
        chosen["iou_thresholds"] = thresholds
    return Options(
        run=flags["name"] or name,
        score_threshold=flags["score_threshold"],
        roi=None if flags["roi"] == "none" else flags["roi"],
        label_version=flags["label_version"] or "v2.1",
        bootstrap=200 if flags["bootstrap"] is None else flags["bootstrap"],
        invalid_sizes=flags["invalid_sizes"],
        **chosen,
    )
