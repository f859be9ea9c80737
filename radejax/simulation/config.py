"""The settings of a simulated dataset."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any, Literal

from radejax.core.errors import (
    POSITIVE,
    UserError,
    check_options,
    integer,
    number,
    one_of,
    require,
    several,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar.tensor import RadarParameters

SIMULATOR_VERSION = 4
"""Raised whenever the same config gives other files than before."""

# Environment, time and weather of the procedural sequences, in turn.
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
    "vru_density_scale": number(0, 5),  # more would leave no space for other road users
    "output": one_of("tesseract", "projection"),
    "camera_mode": one_of("scene", "oracle"),
    "label_distance_m": POSITIVE,
    "radar_from_lidar_m": several(number(-math.inf), "three numbers", 3),
}

FULL_SIZE = {
    "grid": "kradar",
    "radar": {},
    "image_width": 1280,
    "image_height": 720,
}
"""Fields of a config with K-Radar's own sensors."""


@dataclasses.dataclass(frozen=True)
class SimulationConfig:
    """Settings of a simulated dataset; the defaults are a small one for tests.

    Attributes:
        seed: Everything random follows from it.
        scenes: "procedural", or the path of a K-Radar label folder or zip.
        train_sequences: How many procedural sequences, numbered from 1. Conditions go
            round `CONDITIONS`.
        test_sequences: As many after them.
        sequences: Numbers of the sequences of real labels; None for all.
        label_version: Version of real labels.
        frames_per_sequence: At 10 frames a second; 0 for all of real labels.
        frame_stride: Use every n-th frame of real labels.
        vru_density_scale: Number of pedestrians, motorcycles and bicycles in procedural
            training scenes, as a multiple of what a road of the type has; at most 5.
            Test scenes are not changed.
        grid: Arguments of `RadarGrid.reduced`, or "kradar".
        radar: Fields of `RadarParameters` that differ from its defaults.
        output: "tesseract" for K-Radar's files, "projection" for projections only.
        image_width: Of one of the two stereo images; 0 for none.
        image_height: The same.
        cover_lens: Let bad weather cover the lens, as often as in K-Radar.
        camera_mode: "scene" renders all that a camera sees; "oracle" only silhouettes
            of the objects in the color of their class, an upper bound for the camera.
        radar_from_lidar_m: `p_radar = p_lidar + t`; z as in K-Radar's own loaders.
        label_distance_m: Objects farther away get no label.

    Raises:
        UserError: A field is out of its range; names it.
    """

    seed: int = 0
    scenes: str = "procedural"
    # Many short sequences: frames of one sequence resemble each other, and a network
    # learns more from 20 roads for 2 seconds than from 10 roads for 4.
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
        """Settings from plain values or a ConfigDict; missing fields have defaults.

        Raises:
            UserError: A field is unknown or out of its range.
        """
        values = dict(plain(values))
        fields = {field.name: field for field in dataclasses.fields(cls)}
        for name in values:
            require(name in fields, "config.simulation field", name, ", ".join(fields))
        for name in ("sequences", "radar_from_lidar_m"):
            if isinstance(values.get(name), list):
                values[name] = tuple(values[name])
        return cls(**values)

    def __post_init__(self) -> None:
        check_options(vars(self), "config.simulation", _RANGES)
        if self.scenes == "procedural":
            is_any = self.train_sequences + self.test_sequences > 0
            self._require(
                is_any, "train_sequences", "a sequence to train or to test on"
            )
            frames = "an integer of at least 1"
            self._require(self.frames_per_sequence > 0, "frames_per_sequence", frames)
            selects = "None: it selects sequences of real labels"
            self._require(self.sequences is None, "sequences", selects)
        else:
            is_one = self.vru_density_scale == 1
            self._require(is_one, "vru_density_scale", "1 for scenes of real labels")
        self.make_grid()
        self.make_parameters()

    def _require(self, holds: bool, name: str, expected: str) -> None:
        require(holds, f"config.simulation.{name}", getattr(self, name), expected)

    def make_grid(self) -> RadarGrid:
        """The radar's axes."""
        if self.grid == "kradar":
            return RadarGrid.kradar()
        fields: Any = self.grid
        is_mapping = isinstance(fields, Mapping)
        self._require(is_mapping, "grid", "'kradar' or arguments of RadarGrid.reduced")
        try:
            return RadarGrid.reduced(**fields)
        except (TypeError, ValueError) as error:
            raise UserError(f"config.simulation.grid: {error}") from None

    def make_parameters(self) -> RadarParameters:
        """The rest of the radar."""
        try:
            return RadarParameters(**self.radar)
        except TypeError as error:
            raise UserError(f"config.simulation.radar: {error}") from None

    def to_json(self) -> str:
        """Canonical text: equal settings give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    def fingerprint(self) -> str:
        """Short hash of everything the files depend on."""
        text = f"{SIMULATOR_VERSION} {self.to_json()}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def conditions(self, number: int) -> tuple[str, str, str]:
        """Environment, time and weather of sequence `number` (from 1)."""
        return CONDITIONS[(number - 1) % len(CONDITIONS)]


def default_config() -> dict[str, Any]:
    """Fields and defaults of `SimulationConfig` as fresh plain values."""
    return dataclasses.asdict(SimulationConfig())


def plain(config: Any) -> Any:
    """ConfigDicts and other mappings as dictionaries, recursively."""
    if hasattr(config, "to_dict"):
        config = config.to_dict()
    if isinstance(config, Mapping):
        return {str(key): plain(value) for key, value in config.items()}
    return config
