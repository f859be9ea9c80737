"""The options of a simulated dataset."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Literal

import pydantic
from annotated_types import Ge, Le

from radejax.core.errors import UserError, require
from radejax.core.options import AtLeastOne, Count, Options, Positive
from radejax.geometry.radar_grid import RadarGrid, is_uniform
from radejax.simulation.radar.tensor import DRAWN, RadarParameters

SIMULATOR_VERSION = 4
"""Version that increases whenever the same options give different files than before."""

# Environment, time and weather of the procedural sequences, used cyclically.
CONDITIONS = (
    ("urban", "day", "normal"),
    ("highway", "day", "overcast"),
    ("mountain", "day", "fog"),
    ("countryside", "night", "rain"),
    ("parkinglots", "day", "sleet"),
    ("highway", "night", "lightsnow"),
    ("urban", "day", "heavysnow"),
    ("alleyway", "night", "normal"),
    ("university", "day", "normal"),
    ("shoulder", "day", "fog"),
    ("urban", "night", "rain"),
    ("highway", "day", "normal"),
    ("countryside", "day", "sleet"),
    ("urban", "day", "lightsnow"),
    ("highway", "night", "heavysnow"),
    ("mountain", "day", "fog"),
)

PRESETS: dict[str, dict[str, object]] = {
    "ideal": {},
    "realistic": {
        "gain_db": (206.0, 210.0),
        "gain_doppler_bins": 64,
        "noise_db": (108.0, 110.0),
        "receiver_db": (-0.8, 0.8),
        "range_profile": (0.8, 1.2),
        "high_pass_m": (13.0, 17.0),
        "leakage": (0.035, 0.07),
        "range_correlation": (0.25, 0.4),
        "beam_spread_db": (0.05, 0.12),
        "ground_clutter": (0.0001, 0.0004),
        "array_pedestal": 0.5,
        "doppler_pedestal": 1.0,
    },
}
"""Sensors: the fields of `RadarParameters` that differ from its defaults. Of two numbers,
each sequence draws its own value between them. "ideal" is the sensor of version 0.3."""


class ReducedGrid(Options, section="config.simulation.grid"):
    """Arguments of `RadarGrid.reduced`; None for its defaults, which are K-Radar's."""

    num_doppler: Count
    num_range: Annotated[int, Ge(2)]
    num_elevation: Count
    num_azimuth: Annotated[int, Ge(2)]
    max_range_m: Positive | None = None
    max_azimuth_deg: Positive | None = None
    max_elevation_deg: Positive | None = None
    max_doppler_mps: Positive | None = None


class AxesGrid(Options, section="config.simulation.grid"):
    """Fields of a `RadarGrid`: bin centers of its axes, and the field of view."""

    range_m: tuple[float, ...]
    azimuth_rad: tuple[float, ...]
    elevation_rad: tuple[float, ...]
    doppler_mps: tuple[float, ...]
    fov_range_m: float
    fov_azimuth_rad: float


class RadarOptions(Options, section="config.simulation.radar"):
    """A sensor of `PRESETS`, and the fields of `RadarParameters` that differ from it.

    Two numbers are a range from which each sequence draws.
    """

    model_config = pydantic.ConfigDict(extra="allow")

    preset: Literal["ideal", "realistic"] = "realistic"
    """Name of the sensor."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> RadarOptions:
        self.make_parameters()
        return self

    def make_parameters(self) -> RadarParameters:
        """Returns the parameters of the radar."""
        fields = PRESETS[self.preset] | (self.model_extra or {})
        drawn = {n: x for n, x in fields.items() if n in DRAWN and isinstance(x, tuple)}
        for name, value in drawn.items():
            expected = "a number, or the lowest and the highest number"
            require(len(value) == 2, f"{self.section}.{name}", value, expected)
        ranges = tuple((name, *drawn[name]) for name in sorted(drawn))
        lowest = {name: low for name, low, _ in ranges}
        return RadarParameters(**{"ranges": ranges} | fields | lowest)


FULL_SIZE: dict[str, object] = {
    "grid": "kradar",
    "radar": RadarOptions(),
    "image_width": 1280,
    "image_height": 720,
}
"""Fields of options that simulate K-Radar's own radar and camera."""


class SimulationOptions(Options, section="config.simulation"):
    """Options of a simulated dataset. The defaults give a small dataset for tests."""

    seed: Count = 0
    """Seed of all random numbers."""
    scenes: str = "procedural"
    """procedural; the path of a CSV file of own scenes, of which all frames are simulated; or
    that of a K-Radar label folder or zip."""
    # Many short sequences, as the frames of one sequence resemble each other: a network
    # learns more from 20 roads for 2 seconds than from 10 roads for 4 seconds.
    train_sequences: Count = 20
    """Number of procedural training sequences, numbered from 1. The conditions of procedural
    sequences repeat `CONDITIONS` cyclically."""
    test_sequences: Count = 8
    """Number of procedural test sequences, numbered after the training sequences."""
    sequences: tuple[int, ...] | None = None
    """Numbers of the sequences to use from real labels; None: all."""
    label_version: str = "v2.1"
    """Version of the real labels."""
    frames_per_sequence: Count = 20
    """Number of frames per sequence, at 10 frames per second in procedural scenes; 0: all
    frames of real labels. With two or more,
    both of K-Radar's splits have some frames of a sequence of real labels."""
    frame_stride: AtLeastOne = 1
    """Stride at which the frames of real labels are used."""
    # A larger factor leaves no space for other road users.
    vru_density_scale: Annotated[float, Ge(0), Le(5)] = 1.0
    """Factor on the number of pedestrians, motorcycles and bicycles in procedural training
    scenes. Test scenes are not affected."""
    grid: Literal["kradar"] | ReducedGrid | AxesGrid = ReducedGrid(
        num_doppler=16,
        num_range=64,
        num_elevation=9,
        num_azimuth=56,
        max_range_m=75.6,
    )
    """Axes of the radar: arguments of `RadarGrid.reduced`; or the fields of a `RadarGrid`,
    whose axes are tuples of bin centers, empty without elevation or Doppler; or kradar."""
    radar: RadarOptions = RadarOptions.model_validate(
        {"azimuth_elements": 40.0, "elevation_elements": 12.0}
    )
    """Parameters of the radar other than its axes."""
    output: Literal["tesseract", "projection"] = "tesseract"
    """tesseract to write 4D tensors in K-Radar's file format, projection to write only
    projections."""
    image_width: Count = 320
    """Width in pixels of each of the two stereo images; 0: no images."""
    image_height: Count = 180
    """Height in pixels of the images."""
    cover_lens: bool = True
    """Cover the lens by bad weather as often as in K-Radar."""
    camera_mode: Literal["scene", "oracle"] = "scene"
    """scene renders everything that the camera sees. oracle renders only silhouettes of the
    objects in the color of their class, as an upper bound for the camera."""
    radar_from_lidar_m: tuple[float, float, float] = (-2.54, 0.3, 0.7)
    """Translation t of `p_radar = p_lidar + t` in meters; its z is the value in K-Radar's own
    data loaders."""
    label_distance_m: Positive = 90.0
    """Maximum distance of labeled objects."""

    @pydantic.field_validator("grid", mode="before")
    @classmethod
    def _of_form(cls, grid: object) -> object:
        if isinstance(grid, Mapping):
            return (AxesGrid if "range_m" in grid else ReducedGrid)(**grid)
        expected = "'kradar', or arguments of RadarGrid.reduced or RadarGrid"
        is_known = isinstance(grid, Options) or grid == "kradar"
        require(is_known, "config.simulation.grid", grid, expected)
        return grid

    @pydantic.model_validator(mode="after")
    def _check(self) -> SimulationOptions:
        if self.scenes == "procedural":
            is_any = self.train_sequences + self.test_sequences > 0
            expected = "a sequence to train or to test on"
            self._require(is_any, "train_sequences", expected)
            frames = "an integer of at least 1"
            self._require(self.frames_per_sequence > 0, "frames_per_sequence", frames)
            selects = "None: it selects sequences of real labels"
            self._require(self.sequences is None, "sequences", selects)
        else:
            is_one = self.vru_density_scale == 1
            self._require(is_one, "vru_density_scale", "1 for scenes of real labels")
        if self.is_own:
            # All frames are simulated, and the default is that of other scenes.
            is_whole = self.frames_per_sequence in (0, 20)
            all_frames = "0, all frames of a CSV file"
            self._require(is_whole, "frames_per_sequence", all_frames)
        self.make_grid()
        return self

    def _require(self, holds: bool, name: str, expected: str) -> None:
        require(holds, f"config.simulation.{name}", getattr(self, name), expected)

    @property
    def is_own(self) -> bool:
        """Whether the scenes are those of a CSV file."""
        return self.scenes.lower().endswith(".csv")

    def make_grid(self) -> RadarGrid:
        """Returns the axes of the radar tensor.

        Raises:
            UserError: `grid` describes no grid, or its Doppler bins are not uniform.
        """
        if isinstance(self.grid, str):
            return RadarGrid.kradar()
        make = RadarGrid if isinstance(self.grid, AxesGrid) else RadarGrid.reduced
        try:
            grid = make(**self.grid.model_dump(exclude_none=True))
        except ValueError as error:
            raise UserError(f"config.simulation.grid: {error}") from None
        doppler = grid.doppler_mps
        name = "config.simulation.grid.doppler_mps"
        require(is_uniform(doppler), name, doppler.tolist(), "uniform bins of an FFT")
        return grid

    def to_json(self) -> str:
        """Returns canonical JSON text, which is equal for equal options."""
        values = self.model_dump(exclude_none=True) | {"sequences": self.sequences}
        return json.dumps(values, sort_keys=True)

    def fingerprint(self) -> str:
        """Returns a short hash of the options and the simulator version."""
        text = f"{SIMULATOR_VERSION} {self.to_json()}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def conditions(self, number: int) -> tuple[str, str, str]:
        """Returns environment, time and weather of sequence `number`, counted from 1."""
        return CONDITIONS[(number - 1) % len(CONDITIONS)]
