"""The axes of the radar sensor and the mapping between bins and meters.

`RadarGrid` performs every conversion between bins of the radar tensor and positions in the
ego frame. No other module uses a bin size.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, TypeVar, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Real

from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject
from radejax.core.structures import Array
from radejax.geometry.boxes import ArrayT, Number, array_module, as_floats

_LEAST_BINS = {"range_m": 2, "azimuth_rad": 2, "elevation_rad": 0, "doppler_mps": 0}
_MAX_VALUE = 10_000.0  # larger than any value on a radar's axes

AzimuthMapping = Literal["true", "stretched"]
PositionT = TypeVar("PositionT", float, np.ndarray, jax.Array)


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
        values = vars(self).values()
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


def is_uniform(axis: Float[np.ndarray, " bins"]) -> bool:
    """Returns whether the bin centers of an axis have equal distances, up to 0.1 %.

    Examples:
        >>> is_uniform(np.arange(5.0)), is_uniform(np.sin(np.arange(5.0) / 5))
        (True, False)
    """
    return _is_uniform(np.asarray(axis, np.float64).tobytes())


@functools.lru_cache  # for positions on the host, which are converted in few microseconds
def _is_uniform(content: bytes) -> bool:
    axis = np.frombuffer(content)
    if axis.size < 3:
        return True
    even = np.linspace(axis[0], axis[-1], axis.size)
    return bool(np.abs(axis - even).max() <= 1e-3 * abs(_step(axis)))


def values_at(axis: Float[np.ndarray, " bins"], position: PositionT) -> PositionT:
    """Returns the values of an axis at fractional bins, which may be outside of it.

    They are linear between adjacent centers, and continue with the first and last step.

    Args:
        axis: Monotonic bin centers.
        position: Positions in bins, 0 at the first center.

    Examples:
        >>> values_at(np.array([1.0, 2.0, 4.0]), np.array([-1.0, 1.5, 3.0])).tolist()
        [0.0, 3.0, 6.0]
    """
    if is_uniform(axis):
        values: PositionT = axis[0] + position * _step(axis)
        return values
    return _interpolated(position, np.arange(axis.size), axis)


def _step(axis: Float[np.ndarray, " bins"]) -> float:
    return float((axis[-1] - axis[0]) / (axis.size - 1))


def _interpolated(x: PositionT, xs: np.ndarray, ys: np.ndarray) -> PositionT:
    """Evaluates the lines through adjacent points (xs, ys), where xs is monotonic."""
    xp = array_module(x)
    if xs[0] > xs[-1]:
        xs = xs[::-1]
        ys = ys[::-1]
    left = xp.searchsorted(xp.asarray(xs), x, side="right") - 1
    left = xp.clip(left, 0, xs.size - 2)
    tables = xs, ys, np.diff(ys) / np.diff(xs)
    start, value, slope = (xp.asarray(table)[left] for table in tables)
    interpolated: PositionT = value + (x - start) * slope
    return interpolated


@dataclasses.dataclass(frozen=True, eq=False)
class RadarGrid(ArrayValues):
    """Bin centers of a radar tensor on up to four monotonic axes.

    Azimuth is positive to the right of boresight, `azimuth = -atan2(y, x)`, as in
    K-Radar. Doppler is the aliased radial velocity. Bins may have different widths, such
    as those of azimuths that are uniform in sin(azimuth). Grids compare and hash by value,
    so they can be static arguments of jitted functions.

    Without elevation or Doppler, that axis is empty: it has one bin in tesseracts and no
    channel in projections.

    Attributes:
        range_m: `[R]` ranges in meters, increasing.
        azimuth_rad: `[A]` azimuths in radians.
        elevation_rad: `[E]` elevations in radians; empty if they are not measured.
        doppler_mps: `[D]` radial velocities in meters per second; empty if they are not
            measured.
        fov_range_m: Maximum range of the field of view in meters.
        fov_azimuth_rad: Maximum absolute azimuth of the field of view in radians.

    Raises:
        UserError: Range or azimuth has fewer than 2 bins, elevation and Doppler are both
            empty, an axis is not monotonic or has a value above 10,000, ranges decrease,
            or a limit of the field of view is not in (0, 10,000], or above twice the
            end of its axis, as if they had different units.

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
        for name, least in _LEAST_BINS.items():
            axis = self.freeze(name)
            is_vector = axis.ndim == 1 and axis.size >= least
            expected = f"one axis of at least {least} bins"
            require(is_vector, f"shape of {name}", axis.shape, expected)
            is_angle = name.endswith("_rad")
            limit = np.pi if is_angle else _MAX_VALUE
            if not (np.abs(axis) <= limit).all():
                hint = " radians (np.deg2rad converts degrees)" if is_angle else ""
                raise UserError(
                    f"{name} must be finite, to {limit:g}{hint}, got values from "
                    f"{axis.min():g} to {axis.max():g}"
                )
            kind = "increasing"
            steps = np.diff(axis)
            if name != "range_m":
                steps *= np.sign(axis[-1:] - axis[:1])
                kind = "increasing or decreasing"
            if not (steps > 0).all():
                first, then = axis[(i := int((steps <= 0).argmax())) : i + 2]
                raise UserError(f"{name} must be {kind}, got {first:g} before {then:g}")
        if not self.num_elevation + self.num_doppler:
            raise UserError(
                "elevation_rad and doppler_mps are both empty, expected at least one bin: "
                "give a radar of ranges and azimuths one Doppler bin, [0.0]"
            )
        for name in ("fov_range_m", "fov_azimuth_rad"):
            value = getattr(self, name)
            limit = np.pi if name.endswith("_rad") else _MAX_VALUE
            limit = min(limit, 2 * np.abs(getattr(self, name[len("fov_") :])).max())
            expected = f"a number above 0, to {limit:g} for its axis"
            require(0 < value <= limit, name, float(value), expected)

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

    @staticmethod
    def reduced(
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
        `[-max, max)` like the output of an FFT. A single elevation or Doppler is 0.

        Args:
            num_doppler: Number of Doppler bins.
            num_range: Number of range bins.
            num_elevation: Number of elevation bins.
            num_azimuth: Number of azimuth bins.
            max_range_m: Last range and maximum range of the field of view.
            max_azimuth_deg: Last azimuth and maximum azimuth of the field of view.
            max_elevation_deg: Last elevation.
            max_doppler_mps: Velocity at which the Doppler axis wraps.

        Raises:
            UserError: See `RadarGrid`.

        Examples:
            >>> grid = RadarGrid.reduced(
            ...     num_doppler=4, num_range=24, num_elevation=3, num_azimuth=16
            ... )
            >>> grid.shape_drea
            (4, 24, 3, 16)
        """
        azimuth = np.deg2rad(max_azimuth_deg)
        elevation = np.deg2rad(max_elevation_deg) if num_elevation > 1 else 0.0
        doppler = max_doppler_mps if num_doppler > 1 else 0.0
        return RadarGrid(
            range_m=np.linspace(0.0, max_range_m, num_range),
            azimuth_rad=np.linspace(-azimuth, azimuth, num_azimuth),
            elevation_rad=np.linspace(-elevation, elevation, num_elevation),
            doppler_mps=np.linspace(-doppler, doppler, num_doppler, endpoint=False),
            fov_range_m=float(max_range_m),
            fov_azimuth_rad=float(azimuth),
        )

    @classmethod
    def from_dict(cls, fields: JsonObject) -> RadarGrid:
        """Creates the grid that `to_dict` has written.

        Args:
            fields: Values of the fields by name, as in `radar_grid.json`.

        Raises:
            KeyError: A field is missing.
            UserError: See `RadarGrid`.
        """
        return cls(**{f.name: fields[f.name] for f in dataclasses.fields(cls)})

    def to_dict(self) -> JsonObject:
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
                data; use it only for checkpoints of the authors' code, which were trained with it.

        Raises:
            UserError: The mapping is unknown, or "stretched" for axes that are not uniform.
        """
        num_range = -(-self.num_range // multiple) * multiple
        num_azimuth = -(-self.num_azimuth // multiple) * multiple
        kinds = get_args(AzimuthMapping)
        known = azimuth_mapping in kinds
        require(known, "azimuth_mapping", azimuth_mapping, " or ".join(kinds))
        if azimuth_mapping == "true":
            range_m = values_at(self.range_m, np.arange(num_range))
            azimuth = values_at(self.azimuth_rad, np.arange(num_azimuth))
        else:
            even = is_uniform(self.range_m) and is_uniform(self.azimuth_rad)
            require(even, "azimuth_mapping", azimuth_mapping, "true for uneven axes")
            range_m = np.linspace(self.range_m[0], self.fov_range_m, num_range)
            first, last = self.azimuth_rad[[0, -1]]
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
        num_elevation = max(self.num_elevation, 1)
        return max(self.num_doppler, 1), self.num_range, num_elevation, self.num_azimuth

    @property
    def projection_shape(self) -> tuple[int, int, int]:
        """Shape of a projection: range, azimuth, Doppler + elevation channels."""
        return self.num_range, self.num_azimuth, self.num_doppler + self.num_elevation

    @property
    def range_step_m(self) -> float:
        """Mean distance of adjacent ranges."""
        return _step(self.range_m)

    @property
    def azimuth_step_rad(self) -> float:
        """Mean difference of adjacent azimuths, below 0 if they decrease."""
        return _step(self.azimuth_rad)

    @property
    def range_widths_m(self) -> float | Float[np.ndarray, " R"]:
        """Width of all range bins, or of each if ranges are not uniform."""
        return (
            self.range_step_m if is_uniform(self.range_m) else np.gradient(self.range_m)
        )

    def without_doppler(self) -> RadarGrid:
        """Returns the grid without its Doppler axis."""
        return dataclasses.replace(self, doppler_mps=np.array([]))

    def measured_channels(
        self, projection: Float[ArrayT, "*bins DE"]
    ) -> Float[ArrayT, "*bins _"]:
        """Returns the channels of a tesseract's projection that are not of an empty axis.

        Args:
            projection: Projection of a tesseract, which has one bin on an empty axis.
        """
        shape = self.shape_drea
        if self.projection_shape[2] == shape[0] + shape[2]:
            return projection
        return projection[..., 1:] if self.num_elevation else projection[..., :-1]

    # Bins and meters -----------------------------------------------------------------

    def bin_to_ego(
        self,
        range_bin: Number | Real[ArrayT, "*#bins"],
        azimuth_bin: Number | Real[ArrayT, "*#bins"],
    ) -> Float[ArrayT, "*bins 2"]:
        """Returns the positions of range-azimuth bins on the ground plane of the ego frame.

        Bin (i, j) lies at range r = r0 + i dr and azimuth a = a0 + j da on uniform axes,
        hence at x = r cos(a), y = -r sin(a). See `values_at` for other axes.

        Args:
            range_bin: Position along range in bins, `[...]`; may be fractional.
            azimuth_bin: Position along azimuth in bins, `[...]`; may be fractional.

        Returns:
            `[..., 2]` x (forward) and y (left) in meters; NumPy float64 for NumPy
            or Python input, else a JAX array.
        """
        xp, (range_bin, azimuth_bin) = as_floats(range_bin, azimuth_bin)
        range_m = values_at(self.range_m, range_bin)
        azimuth = values_at(self.azimuth_rad, azimuth_bin)
        y_m = -range_m * xp.sin(azimuth)
        positions: ArrayT = xp.stack([range_m * xp.cos(azimuth), y_m], -1)
        return positions

    def ego_to_bin(
        self, x_m: Number | Real[ArrayT, "*#bins"], y_m: Number | Real[ArrayT, "*#bins"]
    ) -> Float[ArrayT, "*bins 2"]:
        """Returns the fractional bins of ground positions, as the inverse of `bin_to_ego`.

        Args:
            x_m: Forward positions `[...]` in the ego frame.
            y_m: Left positions `[...]` in the ego frame.

        Returns:
            `[..., 2]` range and azimuth in bins, not clipped to the grid.
        """
        xp, (x_m, y_m) = as_floats(x_m, y_m)
        range_m = xp.sqrt(x_m * x_m + y_m * y_m)
        azimuth = -xp.arctan2(y_m, x_m)
        # The order of operations decides in which direction exact half bins are rounded.
        # This order gives the bins of the authors' code. Azimuth is measured from the
        # middle of the axis, so that a point straight ahead lies exactly in the middle
        # even in float32.
        axis = self.range_m
        last = axis.size - 1
        range_bin = (range_m - float(axis[0])) * last / float(axis[-1] - axis[0])
        if not is_uniform(axis):
            range_bin = _interpolated(range_m, axis, np.arange(axis.size))
        axis = self.azimuth_rad
        last = axis.size - 1
        span = float(axis[-1] - axis[0])
        middle = float(axis[-1] + axis[0]) / 2
        azimuth_bin = (azimuth - middle) * last / span + last / 2
        if not is_uniform(axis):
            azimuth_bin = _interpolated(azimuth, axis, np.arange(axis.size))
        bins: ArrayT = xp.stack([range_bin, azimuth_bin], -1)
        return bins

    def nearest_bin(
        self, x_m: Number | Real[ArrayT, "*#bins"], y_m: Number | Real[ArrayT, "*#bins"]
    ) -> Int[ArrayT, "*bins 2"]:
        """Returns the integer bins nearest to ground positions, clipped to the grid.

        Halves are rounded to even, as in the released ground-truth encoding.

        Args:
            x_m: Forward positions `[...]` in the ego frame.
            y_m: Left positions `[...]` in the ego frame.

        Returns:
            `[..., 2]` int32 range and azimuth indices.
        """
        bins = self.ego_to_bin(x_m, y_m)
        xp = array_module(bins)
        last = xp.asarray([self.num_range - 1, self.num_azimuth - 1], bins.dtype)
        last = xp.broadcast_to(last, bins.shape)
        nearest: ArrayT = xp.clip(xp.round(bins), 0, last).astype(xp.int32)
        return nearest

    def bin_centers_ego(self) -> Float[np.ndarray, "R A 2"]:
        """Returns x and y of every range-azimuth bin center in meters, `[R, A, 2]` float64."""
        return self.bin_to_ego(
            np.arange(self.num_range)[:, None], np.arange(self.num_azimuth)[None, :]
        )

    def boxes_at(
        self, params: Float[jax.Array, "*bins 8"], bins: Int[jax.Array, "*bins 2"]
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

    def check_maps(self, heatmap: Array, box_params: Array) -> None:
        """Raises `ValueError` if the shapes of a detector's maps do not match the grid.

        Args:
            heatmap: Map that should be `[B, R, A, C]`.
            box_params: Map that should be `[B, R, A, 8]`.

        Examples:
            >>> maps = jnp.zeros((1, 256, 107, 5)), jnp.zeros((1, 256, 107, 8))
            >>> RadarGrid.kradar().check_maps(*maps)
        """
        logits = heatmap.shape
        bins = (self.num_range, self.num_azimuth)
        is_maps = len(logits) == 4 and box_params.shape == (*logits[:3], 8)
        if not is_maps or logits[1:3] != bins:
            raise ValueError(
                f"maps have shapes {logits} and {box_params.shape}, expected [B, R, A, C] and "
                f"[B, R, A, 8] on the grid's {bins[0]} x {bins[1]} bins (range, azimuth): "
                "pass the grid of the maps, padded if the model pads and does not crop"
            )

    def in_field_of_view(
        self, x_m: Real[ArrayT, "*#bins"], y_m: Real[ArrayT, "*#bins"]
    ) -> Bool[ArrayT, "*bins"]:
        """Returns True for positions within the azimuth and range of the field of view.

        Args:
            x_m: Forward positions `[...]` in the ego frame.
            y_m: Left positions `[...]` in the ego frame.
        """
        xp, (x_m, y_m) = as_floats(x_m, y_m)
        is_ahead = xp.abs(xp.arctan2(y_m, x_m)) <= self.fov_azimuth_rad
        is_near = xp.sqrt(x_m * x_m + y_m * y_m) <= self.fov_range_m
        is_inside: ArrayT = is_ahead & is_near
        return is_inside
