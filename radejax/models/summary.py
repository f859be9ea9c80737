"""What a RADE-Net costs: parameters, operations and activation memory per part.

python -m radejax.models.summary --config configs/radenet.py
python -m radejax.models.summary --config configs/radenet.py:stem --batch=10
"""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Mapping

import flax
import jax
import jax.numpy as jnp
from absl import app, flags
from ml_collections import config_flags
from tabulate import tabulate

from radejax.cli import entry
from radejax.core.errors import UserError
from radejax.models import build
from radejax.models.radenet import RadeNet

Path = tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Cost:
    """What one part of a model costs for one batch.

    Attributes:
        num_parameters: Values of its parameters.
        flops: Additions and multiplications of its convolutions and linear layers.
        activation_bytes: Outputs of its convolutions, linear layers and norms. A
            backward pass keeps about that much.
    """

    num_parameters: int = 0
    flops: int = 0
    activation_bytes: int = 0

    def __add__(self, other: Cost) -> Cost:
        return Cost(
            self.num_parameters + other.num_parameters,
            self.flops + other.flops,
            self.activation_bytes + other.activation_bytes,
        )


def summarize(
    model: RadeNet, *, batch: int = 1, num_range: int = 256, num_azimuth: int = 107
) -> dict[str, Cost]:
    """Costs by part, in the order of the computation, without computing anything.

    Args:
        model: The network.
        batch: Frames.
        num_range: Range bins of the projection.
        num_azimuth: Azimuth bins of the projection.

    Returns:
        Costs by name, "backbone/encoder_1" and so on.
    """
    channels = model.doppler_bins + model.elevation_bins
    x = jax.ShapeDtypeStruct((batch, num_range, num_azimuth, channels), jnp.float32)
    variables = jax.eval_shape(model.init, jax.random.key(0), x)
    # Without rematerialisation every module's output can be seen.
    run = functools.partial(model.clone(remat="none").apply, capture_intermediates=True)
    _, captured = jax.eval_shape(run, variables, x)
    outputs = {
        path[:-1]: value[0]
        for path, value in flax.traverse_util.flatten_dict(
            captured["intermediates"]
        ).items()
    }
    costs: dict[str, Cost] = {}
    for path, leaf in flax.traverse_util.flatten_dict(variables["params"]).items():
        part = "/".join(path[:2])
        cost = _cost(path, leaf.shape, outputs[path[:-1]])
        costs[part] = costs.get(part, Cost()) + cost
    return {part: costs[part] for part in sorted(costs, key=_order(model))}


def _cost(path: Path, shape: tuple[int, ...], output: jax.ShapeDtypeStruct) -> Cost:
    size = math.prod(shape)
    if path[-1] == "bias":  # its layer is counted with the kernel or the scale
        return Cost(num_parameters=size)
    num_bytes = output.size * output.dtype.itemsize
    if path[-1] == "scale":
        return Cost(size, 0, num_bytes)
    # Every output value is a sum over the kernel's taps and input channels; each tap
    # of an upsampling makes outputs of its own.
    taps = 1 if "upsample" in path[-2] else math.prod(shape[:-2])
    return Cost(size, 2 * output.size * taps * shape[-2], num_bytes)


def _order(model: RadeNet) -> Callable[[str], int]:
    levels = range(1, len(model.widths) + 1)
    names = ["start", "stem", *(f"encoder_{i}" for i in levels)]
    names += ["bottleneck_1", "bottleneck_2"]
    names += [f"{part}_{i}" for i in levels for part in ("upsample", "cbam", "decoder")]
    names += ["block_1", "block_2", "block_3", "heatmap", "box"]
    return lambda part: names.index(part.split("/")[1])


def table(costs: Mapping[str, Cost]) -> str:
    """The costs as text, with a line per group and one for the whole."""
    rows, total = [], Cost()
    for group in dict.fromkeys(part.split("/")[0] for part in costs):
        parts = {k: v for k, v in costs.items() if k.startswith(f"{group}/")}
        rows += [_row(f"  {name.split('/')[1]}", cost) for name, cost in parts.items()]
        subtotal = sum(parts.values(), Cost())
        rows.append(_row(group, subtotal))
        total += subtotal
    rows.append(_row("total", total))
    headers = ["part", "parameters", "GFLOP", "activations MiB"]
    return tabulate(
        rows,
        headers,
        disable_numparse=True,
        colalign=("left", "right", "right", "right"),
        preserve_whitespace=True,
    )


def _row(name: str, cost: Cost) -> list[str]:
    return [
        name,
        f"{cost.num_parameters:,}",
        f"{cost.flops / 1e9:.2f}",
        f"{cost.activation_bytes / 2**20:.1f}",
    ]


def main(argv: list[str]) -> None:
    """Writes the table of `--config` to the standard output."""
    del argv
    with entry.exit_codes():
        model = build(flags.FLAGS.config.model)
        if not isinstance(model, RadeNet):
            raise UserError("the summary knows radar-only models (name = 'radenet')")
        costs = summarize(
            model,
            batch=flags.FLAGS.batch,
            num_range=flags.FLAGS.num_range,
            num_azimuth=flags.FLAGS.num_azimuth,
        )
    sys.stdout.write(table(costs) + "\n")


if __name__ == "__main__":
    config_flags.DEFINE_config_file("config", None, "Config file, with :words.")
    flags.DEFINE_integer("batch", 1, "Frames.", lower_bound=1)
    flags.DEFINE_integer("num_range", 256, "Range bins.", lower_bound=1)
    flags.DEFINE_integer("num_azimuth", 107, "Azimuth bins.", lower_bound=1)
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=entry.parse_flags)
