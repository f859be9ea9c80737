"""The axes of the radar sensor and the mapping between bins and meters.

`RadarGrid` performs every conversion between bins of the radar tensor and positions in the
ego frame. No other module uses a bin size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Real

from radejax.core.errors import require
from radejax.geometry.boxes import array_module, as_floats

_AXES = ("range_m", "azimuth_rad", "elevation_rad", "doppler_mps")
_MAX_VALUE = 10_000.0  # larger than any value on a radar's axes

AzimuthMapping = Literal["true", "stretched"]
Positions = float | Real[Any, "*#bins"]
"""A number or an array; several positions broadcast against each other."""


class ArrayValues:
    """Base of frozen dataclasses (`eq=False`) whose fields are arrays and numbers.

    Instances can be static arguments of jitted functions and fields of flax modules.
    """

    def freeze(self, name: str) -> np.ndarray:
        """Replaces a field by a read-only float64 copy and returns the copy."""
        value = np.array(getattr(self, name), np.float64)
        value.setflags(write=False)
        object.__setattr__(self, name, value)
        return value

    def _key(self) -> tuple[object, ...]:
        fields: Any = dataclasses.fields(self)  # type: ignore[arg-type]
        values = (getattr(self, field.name) for field in fields)
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


@dataclasses.dataclass(frozen=True, eq=False)
class RadarGrid(ArrayValues):
    """Bin centers of a 4D radar tensor on four uniform, increasing axes.

    Azimuth is positive to the right of boresight, `azimuth = -atan2(y, x)`, as in
    K-Radar. Doppler is the aliased radial velocity. Grids compare and hash by value,
    so they can be static arguments of jitted functions.

    Attributes:
        range_m: `[R]` ranges in meters.
        azimuth_rad: `[A]` azimuths in radians.
        elevation_rad: `[E]` elevations in radians.
        doppler_mps: `[D]` radial velocities in meters per second.
        fov_range_m: Maximum range of the field of view in meters.
        fov_azimuth_rad: Maximum absolute azimuth of the field of view in radians.

    Raises:
        ValueError: An axis has fewer than 2 bins, is not uniform and increasing, or has a
            value above 10,000; or a limit of the field of view is not in (0, 10,000].

    References:
        Sensor axes: Paek et al., K-Radar, arXiv:2206.08171.
    """

    range_m: Float[np.ndarray, " R"]
    azimuth_rad: Float[np.ndarray, " A"]
    elevation_rad: Float[np.ndarray, " E"]
    doppler_mps: Float[np.ndarray, " D"]
    fov_range_m: float
    fov_azimuth_rad: float

    def __post_init__(self) -> None:
        for name in _AXES:
            axis = self.freeze(name)
            if axis.ndim != 1 or axis.size < 2:
                raise ValueError(
                    f"{name} must be a vector of at least 2 bins, got shape {axis.shape}"
                )
            if not (np.abs(axis) <= _MAX_VALUE).all():
                raise ValueError(f"{name} must be finite, got {axis}")
            step = (axis[-1] - axis[0]) / (axis.size - 1)
            deviation = np.abs(axis - (axis[0] + step * np.arange(axis.size))).max()
            if not step > 0 or deviation > 1e-3 * step:
                raise ValueError(f"{name} must be uniform and increasing, got {axis}")
        for name in ("fov_range_m", "fov_azimuth_rad"):
            value = getattr(self, name)
            if not 0 < value <= _MAX_VALUE:
                raise ValueError(f"{name} must be positive and finite, got {value}")

    # Construction --------------------------------------------------------------------

    @classmethod
    def kradar(cls) -> RadarGrid:
        """Returns K-Radar's grid: 64 Doppler, 256 range, 37 elevation and 107 azimuth bins."""
        return cls(
            range_m=0.462890625 * np.arange(256),
            azimuth_rad=np.deg2rad(np.arange(-53.0, 54.0)),
            elevation_rad=np.deg2rad(np.arange(-18.0, 19.0)),
            doppler_mps=np.linspace(-1.932591, 1.872198, 64),
            fov_range_m=118.0,
            fov_azimuth_rad=np.deg2rad(53.0),
        )

    @classmethod
    def reduced(
        cls,
        *,
        num_doppler: int,
        num_range: int,
        num_elevation: int,
        num_azimuth: int,
        max_range_m: float = 118.0,
        max_azimuth_deg: float = 53.0,
        max_elevation_deg: float = 18.0,
        max_doppler_mps: float = 1.932591,
    ) -> RadarGrid:
        """Returns a coarser grid with axes like K-Radar's, for tests and quick starts.

        Range starts at 0, azimuth and elevation are symmetric, and Doppler covers
        `[-max, max)` like the output of an FFT.
        """
        azimuth = np.deg2rad(max_azimuth_deg)
        elevation = np.deg2rad(max_elevation_deg)
        return cls(
            range_m=np.linspace(0.0, max_range_m, num_range),
            azimuth_rad=np.linspace(-azimuth, azimuth, num_azimuth),
            elevation_rad=np.linspace(-elevation, elevation, num_elevation),
            doppler_mps=np.linspace(
                -max_doppler_mps, max_doppler_mps, num_doppler, endpoint=False
            ),
            fov_range_m=float(max_range_m),
            fov_azimuth_rad=float(azimuth),
        )

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> RadarGrid:
        """Creates the grid that `to_dict` has written."""
        return cls(**{f.name: fields[f.name] for f in dataclasses.fields(cls)})

    def to_dict(self) -> dict[str, Any]:
        """Returns the fields as lists and floats, which JSON stores without rounding."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def padded(
        self, multiple: int = 8, azimuth_mapping: AzimuthMapping = "true"
    ) -> RadarGrid:
        """Returns the grid of maps whose range and azimuth are zero-padded.

        Args:
            multiple: The numbers of range and azimuth bins are increased to the next
                multiple of this by bins at the far and right end.
            azimuth_mapping: "true" continues the axes, so that bins keep their positions.
                "stretched" reproduces the released RADE-Net: the padded azimuth bins
                span the unpadded field of view, and the last range bin lies at the
                nominal maximum range. This displaces targets by up to 5 columns from the
                data; use it only for official checkpoints, which were trained with it.
        """
        num_range = -(-self.num_range // multiple) * multiple
        num_azimuth = -(-self.num_azimuth // multiple) * multiple
        kinds = get_args(AzimuthMapping)
        known = azimuth_mapping in kinds
        require(known, "azimuth_mapping", azimuth_mapping, " or ".join(kinds))
        first, last = self.azimuth_rad[0], self.azimuth_rad[-1]
        if azimuth_mapping == "true":
            range_m = self.range_m[0] + self.range_step_m * np.arange(num_range)
            azimuth = first + self.azimuth_step_rad * np.arange(num_azimuth)
        else:
            range_m = np.linspace(self.range_m[0], self.fov_range_m, num_range)
            azimuth = np.linspace(first, last, num_azimuth)
        return dataclasses.replace(self, range_m=range_m, azimuth_rad=azimuth)

    # Sizes ---------------------------------------------------------------------------

    @property
    def num_range(self) -> int:
        return self.range_m.size

    @property
    def num_azimuth(self) -> int:
        return self.azimuth_rad.size

    @property
    def num_elevation(self) -> int:
        return self.elevation_rad.size

    @property
    def num_doppler(self) -> int:
        return self.doppler_mps.size

    @property
    def shape_drea(self) -> tuple[int, int, int, int]:
        """Shape of a tesseract: Doppler, range, elevation, azimuth."""
        return self.num_doppler, self.num_range, self.num_elevation, self.num_azimuth

    @property
    def projection_shape(self) -> tuple[int, int, int]:
        """Shape of a projection: range, azimuth, Doppler + elevation channels."""
        return self.num_range, self.num_azimuth, self.num_doppler + self.num_elevation

    @property
    def range_step_m(self) -> float:
        return float((self.range_m[-1] - self.range_m[0]) / (self.num_range - 1))

    @property
    def azimuth_step_rad(self) -> float:
        span = self.azimuth_rad[-1] - self.azimuth_rad[0]
        return float(span / (self.num_azimuth - 1))

    # Bins and meters -----------------------------------------------------------------

    def bin_to_ego(
        self, range_bin: Positions, azimuth_bin: Positions
    ) -> Float[Any, "*bins 2"]:
        """Returns the positions of range-azimuth bins on the ground plane of the ego frame.

        Bin (i, j) lies at range r = r0 + i dr and azimuth a = a0 + j da, hence at
        x = r cos(a), y = -r sin(a).

        Args:
            range_bin: Position along range in bins, `[...]`; may be fractional.
            azimuth_bin: Position along azimuth in bins, `[...]`; may be fractional.

        Returns:
            `[..., 2]` x (forward) and y (left) in meters; NumPy float64 for NumPy
            or Python input, else a JAX array.
        """
        xp, range_bin, azimuth_bin = as_floats(range_bin, azimuth_bin)
        range_m = self.range_m[0] + range_bin * self.range_step_m
        azimuth = self.azimuth_rad[0] + azimuth_bin * self.azimuth_step_rad
        return xp.stack([range_m * xp.cos(azimuth), -range_m * xp.sin(azimuth)], -1)

    def ego_to_bin(self, x_m: Positions, y_m: Positions) -> Float[Any, "*bins 2"]:
        """Returns the fractional bins of ground positions, as the inverse of `bin_to_ego`.

        Returns:
            `[..., 2]` range and azimuth in bins, not clipped to the grid.
        """
        xp, x_m, y_m = as_floats(x_m, y_m)
        # The order of operations decides in which direction exact half bins are rounded.
        # This order gives the bins of the released code. Azimuth is measured from the
        # middle of the axis, so that a point straight ahead lies exactly in the middle
        # even in float32.
        last_range, last_azimuth = self.num_range - 1, self.num_azimuth - 1
        range_span = float(self.range_m[-1] - self.range_m[0])
        azimuth_span = float(self.azimuth_rad[-1] - self.azimuth_rad[0])
        azimuth_mid = float(self.azimuth_rad[-1] + self.azimuth_rad[0]) / 2
        range_m = xp.sqrt(x_m * x_m + y_m * y_m) - float(self.range_m[0])
        azimuth = -xp.arctan2(y_m, x_m) - azimuth_mid
        range_bin = range_m * last_range / range_span
        azimuth_bin = azimuth * last_azimuth / azimuth_span + last_azimuth / 2
        return xp.stack([range_bin, azimuth_bin], -1)

    def nearest_bin(self, x_m: Positions, y_m: Positions) -> Int[Any, "*bins 2"]:
        """Returns the integer bins nearest to ground positions, clipped to the grid.

        Halves are rounded to even, as in the released ground-truth encoding.

        Returns:
            `[..., 2]` int32 range and azimuth indices.
        """
        bins = self.ego_to_bin(x_m, y_m)
        xp = array_module(bins)
        last = xp.asarray([self.num_range - 1, self.num_azimuth - 1], bins.dtype)
        last = xp.broadcast_to(last, bins.shape)
        return xp.clip(xp.round(bins), 0, last).astype(xp.int32)

    def bin_centers_ego(self) -> Float[np.ndarray, "R A 2"]:
        """Returns x and y of every range-azimuth bin center in meters, `[R, A, 2]` float64."""
        return self.bin_to_ego(
            np.arange(self.num_range)[:, None], np.arange(self.num_azimuth)[None, :]
        )

    def boxes_at(
        self,
        params: Float[jax.Array, "*bins 8"],
        bins: Int[jax.Array, "*bins 2"],
    ) -> Float[jax.Array, "*bins 8"]:
        """Returns the boxes that a detector's maps describe at the given bins.

        Args:
            params: `[..., 8]` raw dx, dy, z, l, w, h, sin, cos of the bins, where dx and
                dy are offsets from the center of the bin in meters.
            bins: `[..., 2]` integer range and azimuth bins.

        Returns:
            `[..., 8]` float32 x, y, z, l, w, h and the raw sin, cos.

        Raises:
            AssertionError: The shape of `params` or `bins` is wrong.

        Examples:
            >>> boxes = RadarGrid.kradar().boxes_at(
            ...     jnp.ones((1, 8)), jnp.array([[10, 53]]))
            >>> boxes[0, 2:4].tolist()
            [1.0, 1.0]
        """
        chex.assert_shape(params, (*bins.shape[:-1], 8))
        chex.assert_axis_dimension(bins, -1, 2)
        params = params.astype(jnp.float32)
        range_m = jnp.asarray(self.range_m, jnp.float32)[bins[..., 0]]
        cos = jnp.asarray(np.cos(self.azimuth_rad), jnp.float32)[bins[..., 1]]
        sin = jnp.asarray(np.sin(self.azimuth_rad), jnp.float32)[bins[..., 1]]
        zeros = jnp.zeros_like(sin)
        center = jnp.stack([range_m * cos, -range_m * sin, zeros], -1)
        return jnp.concatenate([center + params[..., :3], params[..., 3:]], -1)

    def check_maps(self, heatmap: Any, box_params: Any) -> None:
        """Raises `ValueError` if the shapes of a detector's maps do not match the grid.

        Examples:
            >>> maps = jnp.zeros((1, 256, 107, 5)), jnp.zeros((1, 256, 107, 8))
            >>> RadarGrid.kradar().check_maps(*maps)
        """
        logits, params = heatmap.shape, box_params.shape
        expected = (self.num_range, self.num_azimuth)
        if len(logits) != 4 or params != (*logits[:3], 8):
            raise ValueError(
                f"maps must be [B, R, A, C] and [B, R, A, 8], got {logits} and {params}"
            )
        if logits[1:3] != expected:
            raise ValueError(
                f"maps have {logits[1]} x {logits[2]} range x azimuth bins, the grid "
                f"{expected[0]} x {expected[1]}: pass the grid of the maps "
                "(grid.padded(...) where the model pads and does not crop)"
            )

    def in_field_of_view(self, x_m: Positions, y_m: Positions) -> Bool[Any, "*bins"]:
        """Returns True for positions in front of the radar within its azimuth and range."""
        xp, x_m, y_m = as_floats(x_m, y_m)
        is_ahead = (xp.abs(xp.arctan2(y_m, x_m)) <= self.fov_azimuth_rad) & (x_m >= 0)
        return is_ahead & (xp.sqrt(x_m * x_m + y_m * y_m) <= self.fov_range_m)
