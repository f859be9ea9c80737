"""The `radejax` command line. Commands import heavy modules only when they run."""

from __future__ import annotations

import click

from radejax.cli import entry
from radejax.cli.data import data, embed, points, preprocess, reduce, simulate
from radejax.cli.detect import detect, export
from radejax.cli.evaluate import calibrate, compare, evaluate, runs, score
from radejax.cli.figures import demo, overlay, view
from radejax.cli.train import train
from radejax.core.version import __version__

_COMMANDS = (
    demo,
    simulate,
    data,
    reduce,
    points,
    preprocess,
    overlay,
    view,
    train,
    evaluate,
    calibrate,
    score,
    compare,
    runs,
    detect,
    embed,
    export,
)


@click.group(commands=_COMMANDS, context_settings=entry.SETTINGS)
@click.version_option(__version__)
def main() -> None:
    """3D object detection in 4D radar tensors: data, training, figures."""
