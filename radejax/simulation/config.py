"""The settings of a simulated dataset."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any, Literal

from radejax.core import errors
from radejax.core.config import plain
from radejax.core.errors import UserError, integer, number, require
from radejax.geometry.radar_grid import RadarGrid, is_uniform
from radejax.simulation.radar.tensor import DRAWN, RadarParameters

SIMULATOR_VERSION = 4
"""Version that increases whenever the same config gives different files than before."""

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


_RANGES = {
    "seed": integer(0),
    "train_sequences": integer(0),
    "test_sequences": integer(0),
    "frames_per_sequence": integer(0),
    "frame_stride": integer(1),
    "image_width": integer(0),
    "image_height": integer(0),
    "vru_density_scale": number(0, 5),  # more leaves no space for other road users
    "output": errors.one_of("tesseract", "projection"),
    "camera_mode": errors.one_of("scene", "oracle"),
    "label_distance_m": errors.POSITIVE,
    "radar_from_lidar_m": errors.several(number(-math.inf), "three numbers", 3),
}

DEFAULT_PRESET = "realistic"
"""Entry of `PRESETS` that `simulation.radar` extends if it does not name one as `preset`."""

PRESETS: dict[str, dict[str, Any]] = {
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

FULL_SIZE = {
    "grid": "kradar",
    "radar": {"preset": DEFAULT_PRESET},
    "image_width": 1280,
    "image_height": 720,
}
"""Fields of a config that simulates K-Radar's own radar and camera."""


@dataclasses.dataclass(frozen=True)
class SimulationConfig:
    """Settings of a simulated dataset. The defaults give a small dataset for tests.

    Attributes:
        seed: Seed of all random numbers.
        scenes: "procedural", or the path of a K-Radar label folder or zip.
        train_sequences: Number of procedural training sequences, numbered from 1. The
            conditions of procedural sequences repeat `CONDITIONS` cyclically.
        test_sequences: Number of procedural test sequences, numbered after the training
            sequences.
        sequences: Numbers of the sequences to use from real labels, or None for all.
        label_version: Version of the real labels.
        frames_per_sequence: Number of frames per sequence, at 10 frames per second in
            procedural scenes; 0 uses all frames of real labels. Two or more frames of
            real labels are in both splits of K-Radar.
        frame_stride: Stride at which the frames of real labels are used.
        vru_density_scale: Factor on the number of pedestrians, motorcycles and bicycles
            in procedural training scenes, at most 5. Test scenes are not affected.
        grid: Arguments of `RadarGrid.reduced`; or the fields of a `RadarGrid`, whose axes
            are tuples of bin centers, empty without elevation or Doppler; or "kradar".
        radar: Name of an entry of `PRESETS` as `preset`, and fields of `RadarParameters`
            that differ from it. Two numbers are a range from which each sequence draws.
        output: "tesseract" to write 4D tensors in K-Radar's file format, "projection" to
            write only projections.
        image_width: Width in pixels of each of the two stereo images; 0 for no images.
        image_height: Height in pixels of the images.
        cover_lens: Whether bad weather covers the lens, as often as in K-Radar.
        camera_mode: "scene" renders everything that the camera sees. "oracle" renders only
            silhouettes of the objects in the color of their class, as an upper bound for
            the camera.
        radar_from_lidar_m: Translation t of `p_radar = p_lidar + t` in meters; its z is
            the value in K-Radar's own data loaders.
        label_distance_m: Maximum distance of labeled objects.

    Raises:
        UserError: A field is out of its range. The message names the field.
    """

    seed: int = 0
    scenes: str = "procedural"
    # Many short sequences, as the frames of one sequence resemble each other: a network
    # learns more from 20 roads for 2 seconds than from 10 roads for 4 seconds.
    train_sequences: int = 20
    test_sequences: int = 8
    sequences: tuple[int, ...] | None = None
    label_version: str = "v2.1"
    frames_per_sequence: int = 20
    frame_stride: int = 1
    vru_density_scale: float = 1.0
    grid: str | Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {
            "num_doppler": 16,
            "num_range": 64,
            "num_elevation": 9,
            "num_azimuth": 56,
            "max_range_m": 75.6,
        }
    )
    radar: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {"azimuth_elements": 40.0, "elevation_elements": 12.0}
    )
    output: Literal["tesseract", "projection"] = "tesseract"
    image_width: int = 320
    image_height: int = 180
    cover_lens: bool = True
    camera_mode: Literal["scene", "oracle"] = "scene"
    radar_from_lidar_m: tuple[float, float, float] = (-2.54, 0.3, 0.7)
    label_distance_m: float = 90.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> SimulationConfig:
        """Creates settings from plain values or a ConfigDict, with defaults where missing.

        Raises:
            UserError: A field is unknown or out of its range.
        """
        values = plain(values)
        fields = {field.name: field for field in dataclasses.fields(cls)}
        for name in values:
            require(name in fields, "config.simulation field", name, ", ".join(fields))
        return cls(**values)

    def __post_init__(self) -> None:
        errors.check_options(vars(self), "config.simulation", _RANGES)
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
        is_mapping = isinstance(self.radar, Mapping)
        self._require(is_mapping, "radar", "a preset and fields of RadarParameters")
        named = {"preset": DEFAULT_PRESET} | dict(self.radar)
        object.__setattr__(self, "radar", named)
        self.make_grid()
        self.make_parameters()

    def _require(self, holds: bool, name: str, expected: str) -> None:
        require(holds, f"config.simulation.{name}", getattr(self, name), expected)

    def make_grid(self) -> RadarGrid:
        """Returns the axes of the radar tensor."""
        if self.grid == "kradar":
            return RadarGrid.kradar()
        fields: Any = self.grid
        is_mapping = isinstance(fields, Mapping)
        self._require(is_mapping, "grid", "'kradar' or arguments of RadarGrid.reduced")
        try:
            make = RadarGrid if "range_m" in fields else RadarGrid.reduced
            grid = make(**fields)
        except (TypeError, ValueError) as error:
            raise UserError(f"config.simulation.grid: {error}") from None
        doppler, name = grid.doppler_mps, "config.simulation.grid.doppler_mps"
        require(is_uniform(doppler), name, doppler.tolist(), "uniform bins of an FFT")
        return grid

    def make_parameters(self) -> RadarParameters:
        """Returns the parameters of the radar other than its axes."""
        given = plain(self.radar)
        preset = given.pop("preset")
        name = "config.simulation.radar.preset"
        require(preset in PRESETS, name, preset, f"one of {', '.join(PRESETS)}")
        fields = PRESETS[preset] | given
        ranges = []
        for name in DRAWN & fields.keys():
            value = fields[name]
            if isinstance(value, list | tuple):
                expected = "a number, or the lowest and the highest number"
                require(
                    len(value) == 2, f"config.simulation.radar.{name}", value, expected
                )
                fields[name] = value[0]
                ranges.append((name, *value))
        try:
            return RadarParameters(**{"ranges": tuple(sorted(ranges))} | fields)
        except TypeError as error:
            raise UserError(f"config.simulation.radar: {error}") from None

    def to_json(self) -> str:
        """Returns canonical JSON text, which is equal for equal settings."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    def fingerprint(self) -> str:
        """Returns a short hash of the settings and the simulator version."""
        text = f"{SIMULATOR_VERSION} {self.to_json()}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def conditions(self, number: int) -> tuple[str, str, str]:
        """Returns environment, time and weather of sequence `number`, counted from 1."""
        return CONDITIONS[(number - 1) % len(CONDITIONS)]


def default_config() -> dict[str, Any]:
    """Returns the fields of `SimulationConfig` with their defaults as a new dictionary."""
    return dataclasses.asdict(SimulationConfig())
