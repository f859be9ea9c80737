"""Checksums that a checkpoint carries, so that damage is found when it is restored."""

from __future__ import annotations

import hashlib
import json
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from radejax.core import files
from radejax.core.errors import DataError


def of_arrays(tree: Any) -> dict[str, int]:
    """A checksum of 32 bits for every array of a tree, by its path "params/conv/bias".

    Each element, as an unsigned integer, is mixed with its position so that different
    values stay different, and all are summed modulo 2**32: whatever happens to one
    element changes the sum, and other damage is missed once in 2**32. Computed where
    the arrays are, so that nothing is moved, and the same for every placement over
    devices and processes.

    Args:
        tree: Arrays of numbers of at most 32 bits, or bool.
    """
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    # One small program a shape: all in one take twice as long to compile.
    sums = jax.device_get([_sum(leaf) for _, leaf in leaves])
    names = ["/".join(map(_key, path)) for path, _ in leaves]
    return dict(zip(names, map(int, sums), strict=True))


def of_values(values: Any) -> str:
    """Checksum of plain values as JSON has them; bytes are those of such a text."""
    if isinstance(values, bytes):
        values = json.loads(values)
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def read(folder: pathlib.Path) -> dict[str, Any] | None:
    """Those in a checkpoint's folder; None of one of an earlier version."""
    folder = folder / "checksums"
    return files.read_json(folder / "metadata") if folder.is_dir() else None


def check(found: Mapping[str, Any], saved: Mapping[str, Any], what: str) -> None:
    """Compares what was restored with what was saved.

    Args:
        found: Checksums by name.
        saved: The same, of all that was saved; more than was restored are fine.
        what: They are of, for the message.

    Raises:
        DataError: Names one that differs.
    """
    for name, value in found.items():
        if saved.get(name) != value:
            raise DataError(
                f"{what} {name} is not what was saved: its checksum differs"
            )


@jax.jit
def _sum(array: jax.Array) -> jax.Array:
    if array.dtype == bool:
        array = array.astype(jnp.uint8)
    bits = jnp.dtype(f"uint{8 * array.dtype.itemsize}")
    values = jax.lax.bitcast_convert_type(array, bits).astype(jnp.uint32)
    position = jnp.zeros(array.shape, jnp.uint32)
    for axis, size in enumerate(array.shape):
        place = jax.lax.broadcasted_iota(jnp.uint32, array.shape, axis)
        position = position * jnp.uint32(size) + place
    return jnp.sum(_mixed(values ^ _mixed(position + jnp.uint32(1))), dtype=jnp.uint32)


def _mixed(x: jax.Array) -> jax.Array:
    """A permutation of the 32 bit integers that looks random: murmur3's last step."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    return x ^ (x >> 16)


def _key(entry: Any) -> str:
    """Of a dictionary, an attribute or a list: as it reads once restored."""
    for name in ("key", "name", "idx"):
        if hasattr(entry, name):
            return str(getattr(entry, name))
    raise TypeError(f"a tree with {entry!r} in a path")
