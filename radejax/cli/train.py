"""The command `radejax train`, which `train.py` also runs."""

from __future__ import annotations

import contextlib
import functools
import logging
import pathlib
from collections.abc import Mapping
from typing import Any

import click

from radejax.cli import entry
from radejax.core.errors import UserError, one_line

_PREFIX = "--config."


class _Command(entry.Command):
    """A command that also takes any config field, such as `--config.train.batch_size=4`.

    If a field is given twice, the last value is used. A field without a value, such as
    `--config.logging.wandb`, is set to true.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments; the config fields become the parameter `fields`."""
        args = entry.expand_home(args)
        words = [word for word in args if not word.startswith(_PREFIX)]
        fields = [word.removeprefix(_PREFIX) for word in args if word not in words]
        pairs = (field.partition("=") for field in fields)
        values = {name: text if is_set else "true" for name, is_set, text in pairs}
        rest = super().parse_args(ctx, words)
        ctx.params["fields"] = values
        return rest


@click.command(cls=_Command)
@click.option(
    "--config",
    required=True,
    metavar="NAME[:OPTIONS]",
    help="A bundled config, such as radenet:official, or a file.py[:OPTIONS].",
)
@click.option(
    "--workdir", help="Folder of the run. Default: runs/<name of the config>."
)
@entry.several(
    "--data",
    "roots",
    help="Roots of K-Radar. Without it, configs with a `simulation` section simulate "
    "one under data/.",
)
@entry.part
@entry.beside_data
@entry.image_backbone
@click.option(
    "--init-from", help="Initial weights: an official .pth file or another workdir."
)
@click.option(
    "--init-partial",
    help="A workdir, exported folder or .pth file whose weights are used where name and "
    "shape are equal.",
)
@entry.several(
    "--seeds",
    kind=int,
    metavar="0,1,2",
    help="Train once per seed, in seed0, seed1, ..., instead of with config.seed.",
)
@click.option("--profile", help="Folder for a trace of a few training steps.")
@click.option(
    "--draw-samples",
    type=entry.FILE,
    help="Draw samples as the network gets them to this file instead of training.",
)
@click.option(
    "--distributed",
    is_flag=True,
    help="One of several processes, as Slurm starts them.",
)
@click.option(
    "--coordinator",
    help="host:port of process 0. Default: detected under Slurm, Open MPI and on TPU pods.",
)
@click.option("--num-processes", type=entry.COUNT, help="Total number of processes.")
@click.option(
    "--process-id", type=click.IntRange(0), help="Rank of this process, from 0."
)
def train(
    *,
    config: str,
    fields: Mapping[str, str],
    workdir: str | None,
    init_from: str | None,
    init_partial: str | None,
    seeds: tuple[int, ...] | None,
    profile: str | None,
    draw_samples: pathlib.Path | None,
    distributed: bool,
    **data: Any,
) -> None:
    """Train a detector, then evaluate it.

    Any field of the config can be set: --config.train.batch_size=4. Run the same
    command again to continue where an earlier start ended. On several hosts start it
    once on each, with --distributed (docs/training.md, examples/slurm.sh).

    Example: radejax train --config quickstart

    Example: radejax train --config radenet:official --data /disk1/kradar,/disk2/kradar
    """
    from radejax.config import config_name, load_config, with_texts
    from radejax.core.devices import end_with_others
    from radejax.runs.experiment import run, run_seeds
    from radejax.runs.figures import draw_training_samples
    from radejax.visualize.style import figure_format, save_figure

    place = [data.pop(n) for n in ("coordinator", "num_processes", "process_id")]
    is_distributed = distributed or place != [None] * 3
    entry.set_up_jax(is_distributed=is_distributed)
    workdir = workdir or f"runs/{config_name(config)}"
    with contextlib.ExitStack() as processes:
        if is_distributed:
            join_processes(*place)
            processes.enter_context(end_with_others())
        # Parts that a config names are imported, and may use JAX.
        settings = with_texts(load_config(config), fields)
        settings = settings.replace(data={name: x for name, x in data.items() if x})
        if draw_samples is not None:
            figure_format(draw_samples)  # checks the ending before data are prepared
            save_figure(draw_training_samples(settings), draw_samples)
            click.echo(f"drew {draw_samples}")
            return
        start = functools.partial(run, settings, workdir)
        if seeds:
            start = functools.partial(run_seeds, settings, workdir, seeds)
        start(init_from=init_from, init_partial=init_partial, profile=profile)


def join_processes(
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> None:
    """Joins the other processes of a run.

    It must be called before anything uses JAX. Under Slurm, Open MPI, Kubernetes and on
    TPU pods, JAX finds the arguments itself.

    Args:
        coordinator: "host:port" of process 0, with a free port on its host.
        num_processes: Number of processes of the run.
        process_id: Index of this process, counted from 0.

    Raises:
        UserError: JAX finds no cluster, or the coordinator cannot be reached.
    """
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, num_processes, process_id)
    except (ValueError, RuntimeError) as error:
        raise UserError(
            f"cannot join the other processes ({one_line(error)}); without Slurm, Open "
            "MPI or a TPU pod give --coordinator HOST:PORT, --num-processes and "
            "--process-id"
        ) from error
    if jax.process_index():
        logging.getLogger("radejax").setLevel(logging.ERROR)
