"""Options, error handling, logging and JAX set-up of the commands and the examples.

JAX and absl are only imported in the function that uses them, so that `--help` is fast.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import math
import os
import pathlib
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

import radejax
from radejax.core.compilation_cache import enable_compilation_cache
from radejax.core.errors import UserError, one_line
from radejax.core.files import is_no_space

if TYPE_CHECKING:
    from radejax.config import Config
    from radejax.data.dataset import LabeledFrame, LabeledFrames

Function = Callable[..., object]
Decorator = Callable[[Function], Function]
"""Adds one or more options to the function of a command."""

FAILED = 1
WRONG_USE = 2
INTERRUPTED = 128 + signal.SIGINT

_HOME = re.compile(r"(?:^|(?<=[=,('\"]))~(?=[/,)'\"]|$)")

_WRONG_PATH = (
    FileNotFoundError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)


# Errors and set-up -------------------------------------------------------------------


@contextlib.contextmanager
def exit_codes(*, debug: bool = False) -> Iterator[None]:
    """Ends the program with a one-line message instead of a traceback for user errors.

    The exit code is 2 for wrong use (arguments, folders), 1 for corrupted data, a full
    disk or another error of a file system, and 130 for an interrupt (see `core.errors`).
    If the caller closed standard error, messages are discarded, as they could otherwise
    be written to another file that has its file descriptor.

    Args:
        debug: Whether to show the traceback.
    """
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, open until exit
    try:
        yield
    except (ValueError, OSError, KeyboardInterrupt) as error:
        code = _exit_code(error)
        if debug or code is None:
            raise
        sys.stderr.write(f"error: {_message(error)}\n")
        raise SystemExit(code) from None


def _exit_code(error: BaseException) -> int | None:
    """Returns the exit code of a user error, or None for any other error."""
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if not isinstance(error, OSError):
        return getattr(error, "exit_code", None)
    if is_no_space(error):
        return FAILED
    if isinstance(error, _WRONG_PATH) or error.errno == errno.EROFS:
        return WRONG_USE
    return FAILED if error.filename else None


def _message(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted ({error})" if str(error) else "interrupted"
    if not isinstance(error, OSError) or error.filename is None:
        return str(error)
    message = f"{error.strerror}: {error.filename}"
    if error.errno in (errno.EROFS, errno.EACCES):
        reason = "" if error.errno == errno.EROFS else "if it is to be written, "
        place = "name another place (--out, --workdir, --records, --data)"
        message += f"; {reason}{place}"
    return message


def set_up_jax(*, is_distributed: bool = False) -> None:
    """Sets up logging at level info, JAX's persistent compilation cache and its devices.

    Args:
        is_distributed: Whether the process will join others, before which it may not use
            the devices.

    Raises:
        UserError: There is no device of the platform `JAX_PLATFORMS`.
    """
    import jax
    from absl import flags

    log = logging.getLogger("radejax")
    if not log.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.setLevel(logging.INFO)
        log.propagate = False
    flags.FLAGS.mark_as_parsed()  # grain's worker processes read an absl flag
    enable_compilation_cache()
    if is_distributed:
        return
    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:
        reason = one_line(error) or "the platform has no device"
        raise UserError(
            f"JAX_PLATFORMS is {os.environ.get('JAX_PLATFORMS')!r}, and JAX cannot use it: "
            f"{reason}; expected an accelerator that is there and `pip install "
            "'radejax[cuda]'` or '[tpu]', or JAX_PLATFORMS=cpu"
        ) from None


# Commands ----------------------------------------------------------------------------


SETTINGS: dict[str, object] = {
    "help_option_names": ["-h", "--help"],
    "show_default": True,
}
"""Settings of a program, which its commands inherit."""


def expand_home(arguments: list[str]) -> list[str]:
    """Replaces `~` by the home folder in every path of the arguments.

    Shells replace it only at the start of an argument, not in `--data=~/kradar`.
    """
    return [_HOME.sub(lambda m: os.path.expanduser(m[0]), arg) for arg in arguments]


class Command(click.Command):
    """A command that reports user errors in one line with an exit code.

    Every command has the option `--debug`, which shows their tracebacks instead. Modules in
    the current folder can be imported, such as those of `config.data.format=module:Class`.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(context_settings=SETTINGS, **settings)
        text = "Show tracebacks of user errors."
        self.params.append(click.Option(["--debug"], is_flag=True, help=text))

    def format_options(
        self, ctx: click.Context, formatter: click.HelpFormatter
    ) -> None:
        """Writes the options by the group given to `together`, otherwise "Options"."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if isinstance(parameter, click.Option) and record is not None:
                group = vars(parameter).get("group", "Options")
                groups.setdefault(group, []).append(record)
        for group, records in groups.items():
            with formatter.section(group):
                formatter.write_dl(records)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        return super().parse_args(ctx, expand_home(args))

    def invoke(self, ctx: click.Context) -> object:
        with exit_codes(debug=ctx.params.pop("debug")):
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())
            return super().invoke(ctx)


def echo_result(as_json: bool, values: object, text: str) -> None:
    """Prints a result as JSON or as text."""
    click.echo(json.dumps(values) if as_json else text)


# Options -----------------------------------------------------------------------------


class _Number(click.FloatRange):
    """Finite numbers in a range; click's own type accepts NaN."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


COUNT = click.IntRange(1)
FRACTION = _Number(0, 1)
METERS = _Number(-100, 100)
DECIBELS = _Number(0, 100)
FILE = click.Path(path_type=pathlib.Path, dir_okay=False)
FOLDER = click.Path(path_type=pathlib.Path, file_okay=False)
EXISTING = click.Path(exists=True)


def _step(text: str) -> int | str:
    if text != "best" and not text.isdecimal():
        raise click.BadParameter(f'{text!r} is neither a number nor "best"')
    return text if text == "best" else int(text)


def several(
    *names: str,
    kind: Callable[[str], object] = str,
    metavar: str = "A,B,...",
    **settings: Any,
) -> Decorator:
    """Returns an option for several values: `--data A,B --data C` gives A, B and C.

    Args:
        *names: Names of the option, as for `click.option`.
        kind: Function that converts the text of each value.
        metavar: Example of the values, shown in the help.
        **settings: Other arguments of `click.option`.
    """

    def split(
        _: click.Context, __: click.Parameter, values: tuple[str, ...]
    ) -> tuple[object, ...] | None:
        words = (word.strip() for value in values for word in value.split(","))
        try:
            found = tuple(kind(word) for word in words if word)
        except ValueError:
            found = ()
        if values and not found:
            raise click.BadParameter(f"{','.join(values)!r}, expected {metavar}")
        return found or None

    return click.option(
        *names, multiple=True, callback=split, metavar=metavar, **settings
    )


def together(*options: Decorator, group: str = "Options") -> Decorator:
    """Returns a decorator that adds several options in order.

    Args:
        *options: Decorators of the options.
        group: Heading of the options in the help.
    """

    def decorate(function: Function) -> Function:
        count = len(vars(function).get("__click_params__", ()))
        for option in reversed(options):
            function = option(function)
        for parameter in vars(function)["__click_params__"][count:]:
            parameter.group = group
        return function

    return decorate


def score_threshold(meaning: str) -> Decorator:
    """Returns the option `--score-threshold`, see `options.class_thresholds`."""
    metavar = "NUMBER|CLASS=NUMBER,..."
    return click.option("--score-threshold", metavar=metavar, help=meaning)


def out_file(default: str, meaning: str) -> Decorator:
    """Returns the option `--out` for the file to write."""
    return click.option("--out", type=FILE, default=default, help=meaning)


def out_folder(meaning: str) -> Decorator:
    """Returns the required option `--out` for the folder to write."""
    return click.option("--out", required=True, type=FOLDER, help=meaning)


def batch_size(default: int, meaning: str) -> Decorator:
    """Returns the option `--batch-size`."""
    return click.option("--batch-size", type=COUNT, default=default, help=meaning)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON."
)
roots = click.argument("roots", nargs=-1, required=True, type=EXISTING)
labels = click.option(
    "--labels", type=EXISTING, help="Folder or zip of a label revision."
)
sequences = several(
    "--sequences",
    kind=int,
    metavar="1,5,58",
    help="Use these sequences only. Default: all.",
)
weather = several(
    "--weather",
    metavar="fog,rain",
    help="Use sequences with this weather only. Default: all.",
)
part = together(labels, sequences, weather)


own_reader = click.option(
    "--config",
    metavar="CONFIG",
    help="Config as of `radejax train` that names a reader of other data than K-Radar.",
)
labeled_frames = together(
    own_reader,
    click.option(
        "--label-version",
        help="Version of the labels: v1.0, v1.1, v2.0 or v2.1. Default: v2.1, or the config's.",
    ),
    part,
)


def read_frames(
    roots: Sequence[str],
    config: str | Config | None = None,
    *,
    any_visibility: bool = False,
    **fields: object,
) -> LabeledFrames[LabeledFrame]:
    """Reads the frames of folders by the reader of a config, that of K-Radar without one.

    Args:
        roots: Folders of the dataset.
        config: Config, or its file or name.
        any_visibility: Whether objects of every visibility flag are read.
        **fields: Other fields of `config.data`. Without `sequences` and `weather`, all are
            read; the others are the config's where they are None.
    """
    from radejax.data import dataset

    if isinstance(config, str):
        config = radejax.load_config(config)
    settings = config or radejax.Config()
    changes: dict[str, object] = {"roots": roots, "sequences": (), "weather": ()}
    changes |= {name: value for name, value in fields.items() if value is not None}
    if any_visibility:
        changes["visibility"] = None
    options = settings.data.replace(**changes)
    return dataset.read_frames(options, settings.classes)


camera_calibration = click.option(
    "--camera-calibration",
    type=EXISTING,
    help="Folder of camera calibrations (calib_seq_v2/ and common/ of K-Radar's "
    "repository). Default: in the data.",
)
beside_data = together(
    click.option(
        "--records",
        help="Folder of preprocessed frames; missing ones are written. Default: in the "
        "data.",
    ),
    click.option(
        "--embeddings", help="Folder of `radejax embed`, used instead of the images."
    ),
    camera_calibration,
)
step = click.option(
    "--checkpoint",
    "--step",
    "step",
    type=_step,
    metavar="NUMBER|best",
    help='Checkpoint step or "best". Default: latest.',
)
image_backbone = click.option(
    "--image-backbone",
    type=EXISTING,
    help="Weights of a frozen image backbone: a DINOv3 or DINOv2 folder from Hugging Face, "
    "a DINOv3 file of Meta or timm, or torchvision's ResNet-50 file.",
)
max_frames = click.option(
    "--max-frames",
    type=COUNT,
    help="Frames of an animation or recording. Default: all.",
)
workers = click.option(
    "--workers",
    "num_workers",
    type=COUNT,
    help="Number of processes. Default: as many as CPUs and memory allow.",
)
