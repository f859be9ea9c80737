"""What the commands of `radejax` share: options, output, exit codes."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable
from typing import Any

import click

from radejax.cli import entry

COUNT = click.IntRange(1)
FILE = click.Path(path_type=pathlib.Path, dir_okay=False)
FOLDER = click.Path(path_type=pathlib.Path, file_okay=False)
EXISTING = click.Path(path_type=pathlib.Path, exists=True)


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


class Group(click.Group):
    """Turns the user's errors into one line and an exit code, for every command."""

    def invoke(self, ctx: click.Context) -> Any:
        with entry.exit_codes(debug=ctx.params.get("debug", False)):
            return super().invoke(ctx)


def json_option(command: Callable) -> Callable:
    """`--json`: the result as one JSON value on standard output, and nothing else."""
    return click.option(
        "--json", "as_json", is_flag=True, help="Print the result as JSON."
    )(command)


def echo_result(as_json: bool, values: Any, text: str) -> None:
    """Prints the result for a machine or for a person."""
    click.echo(json.dumps(values) if as_json else text)
