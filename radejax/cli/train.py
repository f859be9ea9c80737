"""`radejax train` and `train.py`: from data to metrics, by a config and its fields."""

from __future__ import annotations

from typing import Any

import click

from radejax.cli import entry, options

_PREFIX = "--config."


class _Command(options.Command):
    """Also takes any field of the config: `--config.train.batch_size=4`.

    The last one counts where a field is given twice, and `--config.logging.wandb` alone is
    true.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Click's words; fields and their texts go to `ctx.meta["fields"]`."""
        fields = ctx.meta["fields"] = {}
        words, left = [], list(args)
        while left:
            word = left.pop(0)
            if not word.startswith(_PREFIX):
                words.append(word)
                continue
            name, is_set, text = word.removeprefix(_PREFIX).partition("=")
            if not is_set:
                is_value = bool(left) and not left[0].startswith("--")
                text = left.pop(0) if is_value else "true"
            fields[name] = text
        return super().parse_args(ctx, words)


@click.command(cls=_Command)
@click.option(
    "--config",
    required=True,
    metavar="NAME[:OPTIONS]",
    help="A bundled config, such as radenet:official, or a file.py[:OPTIONS].",
)
@click.option(
    "--workdir", help="Folder of the run; runs/<name of the config> by default."
)
@click.option(
    "--data",
    multiple=True,
    callback=options.split_words,
    metavar="A,B,...",
    help="Roots of K-Radar. Without it, configs with a `simulation` section simulate "
    "one under data/.",
)
@click.option("--labels", help="Folder or zip of a label revision; the sequences' own.")
@options.sequences
@options.weather
@click.option("--records", help="Projected frames; made beside the data if missing.")
@click.option(
    "--init-from", help="Weights to start: official .pth, or another workdir."
)
@click.option("--embeddings", help="Folder of `radejax embed`, in place of images.")
@click.option(
    "--image-backbone",
    help="Its weights: a DINOv3 folder from Hugging Face, or torchvision's ResNet-50 "
    "file.",
)
@click.option(
    "--camera-calibration",
    help="Folder of camera calibrations (calib_seq_v2/ and common/ of K-Radar's "
    "repository); the roots' own by default.",
)
@click.option(
    "--seeds",
    multiple=True,
    callback=options.numbers,
    metavar="0,1,2",
    help="Train once per seed, in seed0, seed1, ..., instead of with config.seed.",
)
@click.option("--profile", help="Folder for a trace of a few training steps.")
@click.option(
    "--distributed",
    is_flag=True,
    help="One of several processes, as Slurm starts them.",
)
@click.option("--coordinator", help="host:port of process 0, where no cluster tells.")
@click.option("--num-processes", type=int, help="Likewise.")
@click.option("--process-id", type=int, help="Likewise, from 0.")
@click.option("--debug", is_flag=True, help="Show tracebacks of user errors.")
@click.pass_context
def train(
    ctx: click.Context,
    *,
    config: str,
    workdir: str | None,
    data: tuple[str, ...],
    sequence_numbers: tuple[int, ...] | None,
    weather: tuple[str, ...] | None,
    init_from: str | None,
    seeds: tuple[int, ...] | None,
    profile: str | None,
    distributed: bool,
    coordinator: str | None,
    num_processes: int | None,
    process_id: int | None,
    debug: bool,
    as_json: bool,
    **paths: Any,
) -> None:
    """Train a detector, then evaluate it.

    Any field of the config can be set: --config.train.batch_size=4. Run the same
    command again to continue where an earlier start ended. On several hosts start it
    once on each, with --distributed (docs/training.md, examples/slurm.sh).

    Example: radejax train --config quickstart

    Example: radejax train --config radenet:official --data /disk1/kradar,/disk2/kradar
    """
    from radejax.core.config import config_name, load_config, override
    from radejax.runs.experiment import run, run_seeds

    settings = load_config(config)
    override(settings, ctx.meta["fields"])
    paths |= {"roots": data, "sequences": sequence_numbers, "weather": weather}
    settings.data.update({name: value for name, value in paths.items() if value})
    entry.set_up_jax()
    place = coordinator, num_processes, process_id
    if distributed or place != (None,) * 3:
        entry.join_processes(*place)
    given: dict[str, Any] = {
        "name": config_name(config),
        "workdir": workdir,
        "init_from": init_from,
        "profile": profile or "",
    }
    folder = run_seeds(settings, seeds, **given) if seeds else run(settings, **given)
    options.echo_result(as_json, {"workdir": str(folder)}, "")
