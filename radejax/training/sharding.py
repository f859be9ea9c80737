"""One mesh for any number of devices and hosts; batches and states placed on it.

Data parallel by default: every device holds all parameters and a slice of the batch.
With `fsdp` the large parameters and their optimizer state are split over the same
devices too; XLA gathers them where a layer needs them.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree, Shaped

from radejax.core.errors import UserError

DATA_AXIS = "data"

ParameterSharding = Literal["replicated", "fsdp"]


def make_mesh(num_devices: int | None = None) -> Mesh:
    """One-dimensional mesh over all devices of all processes, or the first few.

    Raises:
        UserError: More devices are asked for than there are.
    """
    devices = jax.devices()
    if num_devices is not None:
        if not 1 <= num_devices <= len(devices):
            raise UserError(
                f"asked for {num_devices} devices, this machine has {len(devices)}"
            )
        devices = devices[:num_devices]
    return jax.make_mesh(
        (len(devices),), (DATA_AXIS,), axis_types=(AxisType.Auto,), devices=devices
    )


def replicated(mesh: Mesh) -> NamedSharding:
    """Sharding of what every device holds whole."""
    return NamedSharding(mesh, PartitionSpec())


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of arrays whose leading axis is the batch."""
    return NamedSharding(mesh, PartitionSpec(DATA_AXIS))


def check_batch_size(
    batch_size: int, mesh: Mesh, name: str = "batch_size", num_accumulate: int = 1
) -> None:
    """Refuses a global batch that does not divide over the mesh.

    Args:
        batch_size: Of all devices.
        mesh: From `make_mesh`.
        name: The field's, for the message.
        num_accumulate: Parts of the batch, each of which must divide too.

    Raises:
        UserError: Names the field and the batch sizes that would do.
    """
    if num_accumulate < 1:
        raise UserError(
            f"train.gradient_accumulation_steps must be at least 1, got {num_accumulate}"
        )
    devices = mesh.devices.size
    size = devices * num_accumulate
    if batch_size < 1 or batch_size % size:
        lower = batch_size // size * size
        choices = f"{lower} or {lower + size}" if lower else f"{size}"
        raise UserError(
            f"{name}={batch_size} does not divide over {devices} devices"
            + f" times train.gradient_accumulation_steps={num_accumulate}"
            * (num_accumulate > 1)
            + f"; use a multiple, for example {choices}"
        )


def put_batch(
    batch: PyTree[Shaped[np.ndarray, "b ..."]], mesh: Mesh
) -> PyTree[Shaped[jax.Array, "B ..."]]:
    """Puts this process's share of a global batch onto the mesh.

    Args:
        batch: Frames of this process, `b = B / processes`.
        mesh: From `make_mesh`.

    Returns:
        The same pytree of global arrays, split along the batch.
    """
    sharding = batch_sharding(mesh)
    return jax.tree.map(
        lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), batch
    )


def state_sharding(
    state: Any, mesh: Mesh, parameters: ParameterSharding, min_size: int = 2**16
) -> Any:
    """Where each array of a train state lives.

    Args:
        state: Pytree of arrays or `jax.ShapeDtypeStruct`.
        mesh: From `make_mesh`.
        parameters: "replicated", or "fsdp": every array of at least `min_size`
            elements is split along its largest axis that divides over the mesh.
        min_size: Smaller arrays stay whole; splitting them costs more than it saves.

    Returns:
        Pytree of `NamedSharding` of the same structure.

    Raises:
        UserError: Unknown value of `parameters`.
    """
    if parameters not in ("replicated", "fsdp"):
        raise UserError(
            f"train.parameter_sharding must be 'replicated' or 'fsdp', got {parameters!r}"
        )
    size = mesh.devices.size

    def place(x: Any) -> NamedSharding:
        if parameters == "replicated" or np.prod(x.shape, dtype=int) < min_size:
            return replicated(mesh)
        axes = [a for a in range(len(x.shape)) if x.shape[a] % size == 0]
        if not axes:
            return replicated(mesh)
        widest = max(axes, key=lambda a: x.shape[a])
        spec: list[str | None] = [None] * len(x.shape)
        spec[widest] = DATA_AXIS
        return NamedSharding(mesh, PartitionSpec(*spec))

    return jax.tree.map(place, state)
