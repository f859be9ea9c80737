"""Options, output and exit codes that the commands of `radejax` share."""

from __future__ import annotations

import gc
import json
import pathlib
from typing import Any

import click

from radejax.cli import entry
from radejax.core import memory

COUNT = click.IntRange(1)
FILE = click.Path(path_type=pathlib.Path, dir_okay=False)
FOLDER = click.Path(path_type=pathlib.Path, file_okay=False)
EXISTING = click.Path(path_type=pathlib.Path, exists=True)


def split_words(_: click.Context, __: click.Parameter, values: Any) -> tuple[str, ...]:
    """Callback of list options: `--data A,B --data C` gives A, B and C."""
    words = (word.strip() for value in values for word in value.split(","))
    return tuple(filter(None, words))


def numbers(
    context: click.Context, parameter: click.Parameter, values: Any
) -> tuple[int, ...] | None:
    """Callback of `--sequences`: None for all."""
    words = split_words(context, parameter, values)
    if wrong := [word for word in words if not word.isdecimal()]:
        message = f"{wrong[0]!r} is not a number, expected 1,5,58"
        raise click.BadParameter(message, context, parameter)
    return tuple(map(int, words)) or None


roots = click.argument("roots", nargs=-1, required=True, type=EXISTING)
roots_or_none = click.argument("roots", nargs=-1, type=EXISTING)
data_roots = click.option(
    "--data",
    "roots",
    multiple=True,
    required=True,
    callback=lambda *given: tuple(map(pathlib.Path, split_words(*given))),
    metavar="A,B,...",
    help="Roots of K-Radar.",
)
labels = click.option(
    "--labels", type=EXISTING, help="Folder or zip of a label revision."
)
label_version = click.option("--label-version", default="v2.1", show_default=True)


sequences = click.option(
    "--sequences",
    "sequence_numbers",
    multiple=True,
    callback=numbers,
    metavar="1,58",
    help="Only these; all by default.",
)
weather = click.option(
    "--weather",
    multiple=True,
    callback=lambda *given: split_words(*given) or None,
    metavar="fog,rain",
    help="Only sequences of these; all by default.",
)


class Step(click.ParamType):
    """Of a checkpoint: a number, or the best by the run's metric."""

    name = "NUMBER|best"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | str:
        """The number, or "best"."""
        if isinstance(value, int) or value == "best":
            return value
        if not value.isdecimal():
            self.fail(f'{value!r} is neither a number nor "best"', param, ctx)
        return int(value)


STEP = Step()


class Program(click.Command):
    """A command that sets up memory first when it runs as a program."""

    def main(self, args: Any = None, *others: Any, **options: Any) -> Any:
        """Runs it with some arguments, by default those of this process."""
        if args is None:
            memory.restart_with_huge_pages()
            # Tracing creates millions of objects that stay: with Python's thresholds
            # the collector takes a sixth of a start.
            gc.set_threshold(50_000, 20, 50)
        return super().main(args, *others, **options)


class Group(Program, click.Group):
    """Commands of one program."""


class Command(Program):
    """A command with `--json`; errors of the user are one line and an exit code.

    `--debug`, of the command or before it, lets tracebacks through.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.context_settings["help_option_names"] = ["-h", "--help"]
        self.params.append(
            click.Option(
                ["--json", "as_json"], is_flag=True, help="Print the result as JSON."
            )
        )

    def invoke(self, ctx: click.Context) -> Any:
        debug = any(c.params.get("debug") for c in (ctx, ctx.find_root()))
        with entry.exit_codes(debug=debug):
            return super().invoke(ctx)


def echo_result(as_json: bool, values: Any, text: str) -> None:
    """Prints the result for a machine or for a person."""
    click.echo(json.dumps(values) if as_json else text)
