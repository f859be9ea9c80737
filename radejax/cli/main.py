"""`radejax`: the command line. One file a command, which imports what it runs last."""

from __future__ import annotations

import click

from radejax.cli import options
from radejax.cli.data import data
from radejax.cli.demo import demo
from radejax.cli.detect import detect
from radejax.cli.embed import embed
from radejax.cli.evaluate import compare, evaluate, score
from radejax.cli.export import export
from radejax.cli.overlay import overlay
from radejax.cli.preprocess import preprocess
from radejax.cli.simulate import simulate
from radejax.cli.train import train
from radejax.cli.view import view


@click.group(
    cls=options.Group,
    commands=[
        demo,
        simulate,
        data,
        preprocess,
        overlay,
        view,
        train,
        evaluate,
        score,
        compare,
        detect,
        embed,
        export,
    ],
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.option("--debug", is_flag=True, help="Show tracebacks of user errors.")
@click.version_option(package_name="radejax")
def main(debug: bool) -> None:
    """3D object detection in 4D radar tensors: data, training, pictures."""
    del debug  # read by Command
