"""What the commands of `radejax` share: options, output, exit codes."""

from __future__ import annotations

import gc
import itertools
import json
import os
import pathlib
from typing import Any

import click

from radejax.cli import entry
from radejax.core import memory
from radejax.core.errors import UserError

COUNT = click.IntRange(1)
FILE = click.Path(path_type=pathlib.Path, dir_okay=False)
FOLDER = click.Path(path_type=pathlib.Path, file_okay=False)
EXISTING = click.Path(path_type=pathlib.Path, exists=True)


class Paths(click.ParamType):
    """Existing folders or files: A,B, or one path that has a comma in its name."""

    name = "A,B,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[pathlib.Path, ...]:
        """The paths; click's error for one that is not there."""
        names = (value,) if os.path.exists(value) else entry.words([value]) or (value,)
        return tuple(EXISTING.convert(name, param, ctx) for name in names)


def split_words(_: click.Context, __: click.Parameter, values: Any) -> tuple[str, ...]:
    """Callback of options that are repeated, or given once with commas."""
    return entry.words(values)


def _chained(
    _: click.Context, __: click.Parameter, values: tuple[tuple[pathlib.Path, ...], ...]
) -> tuple[pathlib.Path, ...]:
    return tuple(itertools.chain(*values))


_roots: dict[str, Any] = {"nargs": -1, "type": Paths(), "callback": _chained}
roots = click.argument("roots", required=True, **_roots)
roots_or_none = click.argument("roots", **_roots)
data_roots = click.option(
    "--data",
    "roots",
    multiple=True,
    required=True,
    type=Paths(),
    callback=_chained,
    help="Roots of K-Radar.",
)
labels = click.option(
    "--labels", type=EXISTING, help="Folder or zip of a label revision."
)
label_version = click.option("--label-version", default="v2.1", show_default=True)


def numbers(
    context: click.Context, parameter: click.Parameter, values: Any
) -> tuple[int, ...] | None:
    """Callback of `--sequences`: None for all."""
    try:
        return entry.numbers(parameter.opts[0], values) or None
    except UserError as error:
        raise click.BadParameter(str(error), context, parameter) from None


sequences = click.option(
    "--sequences",
    "--sequence",
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
    """A command with `--json`, whose user's errors are one line and an exit code.

    `--with_underscores` is understood as `--with-hyphens` is. `--debug`, of the command
    or before it, lets tracebacks through.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.context_settings["token_normalize_func"] = _hyphenated
        self.context_settings["help_option_names"] = ["-h", "--help"]
        self.params.append(
            click.Option(
                ["--json", "as_json"], is_flag=True, help="Print the result as JSON."
            )
        )

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            is_argument = any(
                param.name == "roots" and isinstance(param, click.Argument)
                for param in self.params
            )
            if error.option_name == "--data" and is_argument:
                text = f"folders are given without --data: {ctx.command_path} FOLDER"
                raise click.UsageError(text, ctx) from None
            raise

    def invoke(self, ctx: click.Context) -> Any:
        debug = any(c.params.get("debug") for c in (ctx, ctx.find_root()))
        with entry.exit_codes(debug=debug):
            return super().invoke(ctx)


def _hyphenated(name: str) -> str:
    return name.replace("_", "-")


def echo_result(as_json: bool, values: Any, text: str) -> None:
    """Prints the result for a machine or for a person."""
    click.echo(json.dumps(values) if as_json else text)
