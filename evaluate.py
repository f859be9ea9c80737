"""Evaluates a run, or predictions made elsewhere, or compares two.

    python evaluate.py --workdir runs/quickstart
    python evaluate.py --workdir runs/radenet --data /other/kradar
    python evaluate.py --predictions found.json --data /data/kradar --out results
    python evaluate.py --predictions kitti_folder --out results
    python evaluate.py --compare results_a results_b

Predictions: .npz, .json, .csv, or a folder of text files as K-Radar's tools write them.
Ground truth: --data (K-Radar), --labels (a label revision alone), --ground_truth (a file),
or what lies in the folder of predictions. docs/evaluation.md explains every number.
"""

import sys

from absl import app, flags

from radejax.cli import entry

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run of train.py.")
_CHECKPOINT = flags.DEFINE_string(
    "checkpoint", None, "Step, or best; the newest by default."
)
_PREDICTIONS = flags.DEFINE_string("predictions", None, "File or folder.")
_COMPARE = flags.DEFINE_string(
    "compare", None, "Runs: --compare A B [C ...]. Folders of reports, or predictions."
)
_OUT = flags.DEFINE_string(
    "out",
    None,
    "Folder of the report; beside the predictions or in the workdir if none.",
)
_DATA = flags.DEFINE_list(
    "data", [], "Root folders of K-Radar; with --workdir other ones than the run's."
)
_RECORDS = flags.DEFINE_string(
    "records",
    None,
    "With --workdir: folder of projected frames; made beside other data if missing.",
)
_CALIBRATION = flags.DEFINE_string(
    "camera_calibration",
    None,
    "With --workdir: folder of camera calibrations; other data's own by default.",
)
_EMBEDDINGS = flags.DEFINE_string(
    "embeddings", None, "With --workdir: folder of `radejax embed` of other images."
)
_LABELS = flags.DEFINE_string("labels", None, "Folder or zip of a label revision.")
_LABEL_VERSION = flags.DEFINE_string(
    "label_version", None, "v1.0, v1.1, v2.0, v2.1 (default), or a run's own."
)
_SPLIT = flags.DEFINE_string("split", "test", "train, test, all or a split file.")
_GROUND_TRUTH = flags.DEFINE_string("ground_truth", None, "File of ground truth.")
_FRAMES = flags.DEFINE_string("frames", None, "JSON of frame columns, for it.")
_CLASSES = flags.DEFINE_list("classes", None, "Classes; K-Radar's five by default.")
_PROTOCOLS = flags.DEFINE_list("protocols", None, "Protocols; all by default.")
_IOU = flags.DEFINE_list("iou", ["0.3", "0.5", "0.7"], "IoU thresholds.")
_ROI = flags.DEFINE_string("roi", "narrow", "narrow, wide or none.")
_SCORE = flags.DEFINE_float("score_threshold", 0.0, "Predictions need more than this.")
_BOOTSTRAP = flags.DEFINE_integer(
    "bootstrap",
    None,
    "Resamples of sequences for intervals: 200 by default, 2000 in --compare; 0: none.",
)
_NAME = flags.DEFINE_string("name", None, "Name of the run in tables.")
_SIZES = flags.DEFINE_enum(
    "invalid_sizes",
    "error",
    ["error", "false_positive"],
    "Predicted sizes that are not positive.",
)
_BACKBONE = flags.DEFINE_string(
    "image_backbone",
    None,
    "With --workdir: weights of a frozen image backbone, where they are not at the "
    "place any more that the run was trained from.",
)
_EXCHANGE = flags.DEFINE_integer(
    "exchange_images",
    None,
    "With --workdir: a seed; every frame sees the image of another, as a control.",
)
_DEBUG = flags.DEFINE_bool("debug", False, "Show tracebacks of user errors.")

_OF_OTHER_DATA = (_DATA, _LABELS, _LABEL_VERSION, _RECORDS, _CALIBRATION, _EMBEDDINGS)
_OF_RUNS = (_CHECKPOINT, _BACKBONE, _EXCHANGE, _RECORDS, _CALIBRATION, _EMBEDDINGS)
_OF_FILES = (_GROUND_TRUTH, _FRAMES, _CLASSES, _PROTOCOLS, _IOU, _ROI, _SCORE)
_OF_FILES += (_BOOTSTRAP, _NAME, _SIZES)
_BY_CONFIG = (
    "config.evaluation of the run says that; its predictions can be scored again by "
    "--predictions WORKDIR/evaluation"
)


def main(argv: list[str]) -> None:
    """Chooses between a run, files and a comparison."""
    with entry.exit_codes(debug=_DEBUG.value):
        from radejax.core.errors import UserError

        modes = [f for f in (_WORKDIR, _PREDICTIONS, _COMPARE) if f.value is not None]
        if len(modes) != 1:
            raise UserError("give one of --workdir, --predictions and --compare A B")
        if len(argv) > 1 and _COMPARE.value is None:
            raise UserError(f"unexpected arguments: {' '.join(argv[1:])}")
        is_run = _WORKDIR.value is not None
        if lost := [f.name for f in (_OF_FILES if is_run else _OF_RUNS) if f.present]:
            raise UserError(
                f"--{', --'.join(lost)}: "
                + (_BY_CONFIG if is_run else "only with --workdir")
            )
        if is_run:
            evaluate_workdir()
        elif _PREDICTIONS.value is not None:
            evaluate_files()
        else:
            compare([_COMPARE.value, *argv[1:]])


def evaluate_workdir() -> None:
    """Runs the detector of a run over a split; the config of the run has the options."""
    entry.set_up_jax()
    from radejax.core.errors import UserError
    from radejax.runs.data import OtherData
    from radejax.runs.evaluate import evaluate_run

    step = _CHECKPOINT.value
    if step is not None and step != "best":
        if not step.isdigit():
            raise UserError(f"--checkpoint must be a step or best, got {step}")
        step = int(step)
    other = None
    if _DATA.present and not any(_DATA.value):
        raise UserError("--data names no folder")
    if any(flag.present for flag in _OF_OTHER_DATA):
        given = {flag.name: flag.value for flag in _OF_OTHER_DATA}
        other = OtherData(**given | {"data": tuple(_DATA.value)})
    evaluate_run(
        _WORKDIR.value,
        step=step,
        split=_SPLIT.value,
        out=_OUT.value,
        image_backbone=_BACKBONE.value,
        exchange_images=_EXCHANGE.value,
        other=other,
    )


def evaluate_files() -> None:
    """Evaluates predictions in files."""
    import pathlib

    from radejax.evaluation.report import compare as commands

    path = pathlib.Path(_PREDICTIONS.value)
    out = _OUT.value or path.with_name(f"{path.stem}_evaluation")
    report = commands.evaluate_files(path, out, _source(), _options(path.stem))
    sys.stdout.write(f"{report.text}\nWritten to {out}\n")


def compare(paths: list[str]) -> None:
    """Compares runs with the first of them."""
    from radejax.core.errors import UserError
    from radejax.evaluation.report import compare as commands

    if _BOOTSTRAP.value == 0:
        raise UserError("--bootstrap=0: a comparison needs resamples")
    text, _ = commands.compare_files(
        paths,
        _OUT.value,
        _source(),
        _options("comparison"),
        resamples=2000 if _BOOTSTRAP.value is None else _BOOTSTRAP.value,
    )
    sys.stdout.write(text)


def _source() -> object:
    from radejax.evaluation.files.load import Source

    return Source(
        data=tuple(_DATA.value),
        labels=_LABELS.value,
        label_version=_LABEL_VERSION.value or "v2.1",
        split=None if _SPLIT.value == "all" else _SPLIT.value,
        ground_truth=_GROUND_TRUTH.value,
        frames=_FRAMES.value,
    )


def _options(name: str) -> object:
    from radejax.core.errors import UserError
    from radejax.evaluation.report.measure import Options

    try:
        thresholds = tuple(float(value) for value in _IOU.value)
    except ValueError:
        raise UserError(f"--iou must be numbers, got {','.join(_IOU.value)}") from None
    changes = {}
    if _CLASSES.value:
        changes["classes"] = tuple(_CLASSES.value)
    if _PROTOCOLS.value:
        changes["protocols"] = tuple(_PROTOCOLS.value)
    return Options(
        run=_NAME.value or name,
        iou_thresholds=thresholds,
        score_threshold=_SCORE.value,
        roi=None if _ROI.value == "none" else _ROI.value,
        label_version=_LABEL_VERSION.value or "v2.1",
        bootstrap=200 if _BOOTSTRAP.value is None else _BOOTSTRAP.value,
        invalid_sizes=_SIZES.value,
        **changes,
    )


if __name__ == "__main__":
    app.run(main, flags_parser=entry.parse_flags)
