"""Commands that evaluate runs and prediction files: `evaluate`, `score`, `compare` and `runs`."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from radejax.cli import entry
from radejax.cli.entry import several, together
from radejax.core import files
from radejax.core.errors import UserError

if TYPE_CHECKING:
    from radejax.evaluation.files import Source
    from radejax.evaluation.results import ReportOptions


def _roi(text: str) -> str | tuple[float, ...]:
    return tuple(map(float, text.split(","))) if "," in text else text


_DATA = together(
    click.option(
        "--split",
        default="test",
        help="train, test, all, validation (of a run), or a split file.",
    ),
    several(
        "--data",
        help="Roots of K-Radar. Default: those of the run, or the ground truth next to the "
        "predictions.",
    ),
    click.option(
        "--label-version", help="Version of the labels. Default: v2.1, or the run's."
    ),
    entry.part,
    group="Data",
)
_SETTINGS = together(
    several(
        "--classes", help="Classes to evaluate. Default: K-Radar's five, or the run's."
    ),
    several(
        "--protocols",
        help="Protocols in addition to all_point. Default: all, or the run's.",
    ),
    several(
        "--iou",
        "iou_thresholds",
        kind=float,
        metavar="0.3,0.5",
        help="IoU thresholds. Default: 0.3,0.5,0.7, or the run's.",
    ),
    click.option(
        "--roi",
        type=_roi,
        metavar="NAME|x0,x1,y0,y1,z0,z1",
        help="Region: narrow, wide, none or bounds. Default: narrow, or the run's.",
    ),
    click.option(
        "--score-threshold",
        type=entry.FRACTION,
        help="Threshold of all protocols except all_point. Default: 0, or the run's.",
    ),
    click.option(
        "--empty-frames",
        type=click.Choice(["protocol", "class", "frame", "none"]),
        help="Frames to ignore: those of the protocol's rule, those without the class, "
        "those without any object, or none. Default: protocol, or the run's.",
    ),
    click.option(
        "--invalid-sizes",
        type=click.Choice(["error", "false_positive"]),
        help="Predicted sizes that are not positive. Default: error; false_positive for "
        "runs.",
    ),
    click.option(
        "--bootstrap",
        type=click.IntRange(0),
        help="Resamples of sequences for 95 % intervals; 0: none. Default: 200 (score), "
        "2000 (compare), or the run's.",
    ),
    group="Metrics",
)
_FORMAT = click.Choice(["png", "pdf"])
_FIGURES = click.option("--figures", type=_FORMAT, help="Format. Default: png.")
_PREDICTIONS = together(
    click.option(
        "--ground-truth",
        help="Ground-truth file with frames.json next to it, or folder of a report or of a "
        "run.",
    ),
    click.option(
        "--z-offset",
        "z_offset_m",
        type=entry.METERS,
        help="Meters to add to the z of predictions.",
    ),
    click.option(
        "--yaw-degrees", is_flag=True, help="Yaws of predictions are in degrees."
    ),
    group="Data",
)


@click.command(cls=entry.Command)
@click.argument("run_folder", metavar="[RUN]", required=False)
@click.option("--workdir", help="The same as RUN.")
@entry.step
@click.option("--out", help="Output folder. Default: in the workdir.")
@click.option("--name", "run", help="Name of the run in tables.")
@_DATA
@together(entry.beside_data, group="Data")
@entry.image_backbone
@click.option(
    "--shuffle-images",
    type=click.IntRange(0),
    help="Seed. Sanity check: pair every frame with another frame's image.",
)
@click.option(
    "--min-score",
    type=entry.FRACTION,
    help="Do not store predictions below this score.",
)
@click.option(
    "--wanted-precision",
    type=entry.FRACTION,
    help="Precision for which score thresholds are chosen. Default: the run's.",
)
@click.option("--batch-size", type=entry.COUNT, help="Frames per batch.")
@click.option(
    "--num-visualizations", type=click.IntRange(0), help="Number of frames to draw."
)
@_FIGURES
@_SETTINGS
@entry.json_option
def evaluate(
    run_folder: str | None, workdir: str | None, as_json: bool, **options: object
) -> None:
    """Evaluate a checkpoint of a run of `radejax train` on a split.

    Example: radejax evaluate runs/quickstart
    """
    from radejax.data.options import DataOptions
    from radejax.runs.evaluate import evaluate_run

    workdir = run_folder or workdir
    if workdir is None:
        raise UserError("give the workdir of a run: radejax evaluate RUN")
    given = _given(options)
    if "data" in given:
        given["roots"] = given.pop("data")
    names = (given.keys() & DataOptions.model_fields) - {"image_backbone"}
    other = {name: given.pop(name) for name in names}
    entry.set_up_jax()
    report = evaluate_run(workdir, other=other or None, **given)
    assert report is not None  # because this is the only process
    # The tables have been logged to standard error.
    entry.echo_result(as_json, report.metrics, f"Written to {report.folder}")


@click.command(cls=entry.Command)
@click.argument("run_folder", metavar="RUN", type=entry.EXISTING)
@entry.step
@click.option(
    "--split",
    default="validation",
    help="validation, a split file, or, of other data, test or all.",
)
@several("--data", help="Roots of other labeled sequences. Default: those of the run.")
@entry.image_backbone
@entry.json_option
def calibrate(run_folder: str, as_json: bool, **options: object) -> None:
    """Fit probabilities to the scores of a run on sequences it was not trained on.

    `Detector`, `radejax detect` and exported programs then give the probability of every
    box. Scores and APs do not change. Without a validation split (config.data.validation),
    give other labeled sequences.

    Example: radejax calibrate runs/quickstart
    """
    from radejax.runs.evaluate import calibrate_run

    given = _given(options)
    other = {"roots": given.pop("data")} if "data" in given else None
    entry.set_up_jax()
    content = calibrate_run(run_folder, other=other, **given)
    classes = content["classes"].items()
    rows = [f"{cls}: temperature {t:.3g}, offset {x:.3g}" for cls, (t, x) in classes]
    entry.echo_result(as_json, content, "\n".join(rows))


@click.command(cls=entry.Command)
@click.argument("predictions", type=entry.EXISTING)
@click.option(
    "--out",
    help="Output folder. Default: next to the predictions, named after the options.",
)
@click.option("--name", help="Name of the run in tables.")
@_DATA
@_PREDICTIONS
@_FIGURES
@click.option("--kitti", is_flag=True, help="Also write files for K-Radar's script.")
@_SETTINGS
@entry.json_option
def score(
    predictions: str, out: str | None, name: str | None, as_json: bool, **options: Any
) -> None:
    """Evaluate predictions in files.

    PREDICTIONS is a .npz or .json file, a folder of `radejax detect`, a folder of text
    files as K-Radar's tools write them, or the folder of a run or report, whose options are
    the defaults. Ground truth: --data (K-Radar), --labels (a label
    revision without radar data), --ground-truth (a file), or the folder's own.

    Example: radejax score found.json --data /data/kradar --out results
    """
    from radejax.evaluation.files import evaluate_files
    from radejax.evaluation.results import name_of_changes

    path = pathlib.Path(predictions).absolute()  # as the folder "." has no name
    stem = path.name if path.is_dir() else path.stem
    given = _given(options)
    source, settings = _settings(predictions, given, bootstrap=200)
    usual_source, usual_settings = _settings(predictions, {}, bootstrap=200)
    usual = dict(usual_source) | dict(usual_settings)
    # The names of the data would be long, so they are not part of the folder's.
    names = given.keys() - {"data", "labels", "ground_truth"}
    changes = {name: value for name, value in given.items() if name in names}
    end = f"_evaluation{name_of_changes(changes, usual)}"
    folder = out or files.relative(path.with_name(f"{stem}{end}"))
    report = evaluate_files(predictions, folder, source, settings, run=name or stem)
    entry.echo_result(as_json, report.metrics, f"{report.text}\nWritten to {folder}")


@click.command(cls=entry.Command)
@click.argument(
    "runs", nargs=-1, required=True, type=entry.EXISTING, metavar="A B [C ...]"
)
@click.option("--out", help="Folder to write the comparison to. Default: none.")
@click.option(
    "--figures",
    type=_FORMAT,
    help="Also draw the curves of all runs in one panel and their scenes side by side into "
    "--out. Default: none.",
)
@_DATA
@_PREDICTIONS
@_SETTINGS
@entry.json_option
def compare(
    runs: tuple[str, ...],
    out: str | None,
    figures: str | None,
    as_json: bool,
    **options: object,
) -> None:
    """Compare runs with the first of them.

    Each is the folder of a run, of its seeds or of a report, or predictions as `radejax
    score` takes them. With three seeds or more of both runs, differences are tested.
    Without --protocols, all_point and kradar_r40 are compared.

    Example: radejax compare runs/a runs/b
    """
    from radejax.evaluation.comparison import compare_files

    given = _given(options)
    source, settings = _settings(runs[0], given, bootstrap=2000)
    if "protocols" not in given:  # more rows would make the correction for them larger
        settings = settings.replace(protocols=settings.main_protocols[:2])
    if figures and out is None:
        raise UserError("--figures needs a folder: give --out FOLDER")
    text, rows = compare_files(runs, out, source, settings, figures=figures)
    if figures and out is not None:
        from radejax.runs.figures import draw_compared

        draw_compared(runs, pathlib.Path(out), source, settings, figures)
    entry.echo_result(as_json, rows, text.rstrip("\n"))


@click.command(cls=entry.Command)
@click.argument("folder", type=entry.EXISTING)
@entry.json_option
def runs(folder: str, as_json: bool) -> None:
    """List the runs in FOLDER with the config fields in which they differ.

    AP is the metric that config.train.best_metric names, in the report of the run.

    Example: radejax runs runs
    """
    from radejax.runs.listing import list_runs, table_of_runs

    rows = list_runs(folder)
    entry.echo_result(as_json, rows, table_of_runs(rows).rstrip("\n"))


def _given(options: Mapping[str, object]) -> dict[str, Any]:
    """Returns the options that were given, with None for the region "none"."""
    given = {name: value for name, value in options.items() if value is not None}
    if given.get("roi") == "none":
        given["roi"] = None
    return given


def _settings(
    path: str, given: Mapping[str, Any], bootstrap: int
) -> tuple[Source, ReportOptions]:
    """Builds `Source` and `ReportOptions` from the options that are their fields.

    Options that are not given are those of the report in `path` or of the ground truth.
    """
    from radejax.evaluation.files import Source, stored_options
    from radejax.evaluation.results import ReportOptions

    values: dict[str, Any] = {"label_version": "v2.1"}
    for place in filter(None, (given.get("ground_truth"), path)):
        values |= stored_options(place)
    values |= {"bootstrap": bootstrap, **given}
    source = {n: x for n, x in given.items() if n in Source.model_fields}
    options = {n: x for n, x in values.items() if n in ReportOptions.model_fields}
    return Source(**source), ReportOptions(**options)
