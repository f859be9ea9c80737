"""What a simulated data set depends on, as plain values, and the checks on them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any, Literal

from radejax.core.errors import UserError
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


_LATER_FIELDS = {"camera_content": "scene", "vulnerable_road_users": 1.0}
"""What configs and data sets of earlier versions are without."""

_MOST_VULNERABLE = 5.0
"""Of `vulnerable_road_users`: more would fill the roads with nobody else."""

_RADAR_LIMITS = {
    "gain_db": (-1e3, 1e3),
    "noise_db": (-1e3, 1e3),
    "wavelength_m": (1e-4, 1.0),
    "azimuth_elements": (1.0, 512.0),
    "elevation_elements": (1.0, 512.0),
    "array_pedestal": (0.0, 1.0),
    "range_resolution_m": (0.0, 100.0),
    "pattern_exponent": (0.0, 100.0),
    "max_scatterers_per_row": (1, 4096),
}
"""Of the fields of `RadarParameters`; an integer where the least is one."""

FULL_SIZE = {
    "grid": "kradar",
    "radar": {},
    "image_width": 1280,
    "image_height": 720,
}
"""Fields that make a config one of K-Radar's own sensors."""


@dataclasses.dataclass(frozen=True)
class SimulationConfig:
    """Checked values of a simulation; by default the quickstart's.

    Its data set is small, but with every kind of thing in it.

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
        vulnerable_road_users: Pedestrians, motorcycles and bicycles of procedural
            training scenes, as a multiple of what there is of them on a road of the
            type. Test scenes have what there is.
        grid: Arguments of `RadarGrid.reduced`, or "kradar".
        radar: Fields of `RadarParameters` that differ from its defaults.
        output: "tesseract" for K-Radar's files, "projection" for the projections alone.
        image_width: Of one of the two stereo images; 0 for none.
        image_height: The same.
        cover_lens: Let bad weather cover the lens, as often as in K-Radar.
        camera_content: "scene" draws all that a camera sees; "objects" silhouettes of the
            objects alone, in the colour of their class: what a perfect image would give.
        lidar_to_radar_m: Radar position = LiDAR position + this; z as in K-Radar's own
            loaders.
        label_distance_m: Farther objects get no label.
    """

    seed: int = 0
    scenes: str = "procedural"
    # Many short sequences: frames of one sequence resemble each other, and a network
    # learns more from 20 roads for 2 seconds than from 10 roads for 4.
    train_sequences: int = 20
    test_sequences: int = 8
    sequences: list[int] | None = None
    label_version: str = "v2.1"
    frames_per_sequence: int = 20
    frame_stride: int = 1
    vulnerable_road_users: float = 1.0
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
    camera_content: str = "scene"
    lidar_to_radar_m: tuple[float, float, float] = (-2.54, 0.3, 0.7)
    label_distance_m: float = 90.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> SimulationConfig:
        """Checks a mapping (or ConfigDict) of plain values, all of the fields.

        Raises:
            UserError: A field is unknown, missing or has a value out of range.
        """
        values = _LATER_FIELDS | plain(values)
        names = [f.name for f in dataclasses.fields(cls)]
        for key in values:
            if key not in names:
                raise UserError(
                    f"unknown simulation field {key!r}; fields: {', '.join(names)}"
                )
        for name in names:
            if name not in values:
                raise UserError(f"simulation field {name!r} is missing")
        offset = values["lidar_to_radar_m"]
        if isinstance(offset, list) and all(map(_is_number, offset)):
            offset = tuple(map(float, offset))
        return cls(**dict(values, lidar_to_radar_m=offset))

    def __post_init__(self) -> None:
        is_procedural = self.scenes == "procedural"
        for name, least in (
            ("seed", 0),
            ("train_sequences", 0),
            ("test_sequences", 0),
            ("frames_per_sequence", 1 if is_procedural else 0),
            ("frame_stride", 1),
            ("image_width", 0),
            ("image_height", 0),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise UserError(
                    f"simulation.{name} must be an integer of at least {least},"
                    f" got {value!r}"
                )
        for is_wrong, text in (
            (
                not isinstance(self.scenes, str),
                ".scenes must be 'procedural' or a path of labels,"
                f" got {self.scenes!r}",
            ),
            (
                is_procedural and self.train_sequences + self.test_sequences == 0,
                " has no sequences: train_sequences is 0",
            ),
            (
                is_procedural and self.sequences is not None,
                ".sequences chooses sequences of real labels; procedural ones"
                " are counted by train_sequences and test_sequences",
            ),
            (
                not isinstance(self.vulnerable_road_users, int | float)
                or not 0.0 <= self.vulnerable_road_users <= _MOST_VULNERABLE,
                ".vulnerable_road_users must be a number from 0 to"
                f" {_MOST_VULNERABLE:g}, got {self.vulnerable_road_users!r}",
            ),
            (
                not is_procedural and self.vulnerable_road_users != 1.0,
                ".vulnerable_road_users is of procedural scenes; those of real labels"
                " have what the labels say: leave it at 1, not"
                f" {self.vulnerable_road_users!r}",
            ),
            (
                self.output not in ("tesseract", "projection"),
                f".output must be 'tesseract' or 'projection', got {self.output!r}",
            ),
            (
                self.camera_content not in ("scene", "objects"),
                ".camera_content must be 'scene' or 'objects', got "
                f"{self.camera_content!r}",
            ),
            (
                not _is_number(self.label_distance_m) or not self.label_distance_m > 0,
                f".label_distance_m must be a number above 0, got {self.label_distance_m!r}",
            ),
            (
                not isinstance(self.lidar_to_radar_m, tuple)
                or len(self.lidar_to_radar_m) != 3,
                f".lidar_to_radar_m must be three numbers, got {self.lidar_to_radar_m!r}",
            ),
        ):
            if is_wrong:
                raise UserError(f"simulation{text}")
        self.make_grid()
        self.make_parameters()

    def make_grid(self) -> RadarGrid:
        """The radar's axes."""
        if self.grid == "kradar":
            return RadarGrid.kradar()
        if isinstance(self.grid, str):
            raise UserError(
                f"simulation.grid must be 'kradar' or sizes, got {self.grid!r}"
            )
        try:
            return RadarGrid.reduced(**self.grid)
        except (TypeError, ValueError) as error:
            raise UserError(f"simulation.grid: {error}") from None

    def make_parameters(self) -> RadarParameters:
        """The rest of the radar."""
        for name, value in self.radar.items():
            if name not in _RADAR_LIMITS:
                raise UserError(
                    f"simulation.radar: unknown field {name!r};"
                    f" fields: {', '.join(_RADAR_LIMITS)}"
                )
            least, most = _RADAR_LIMITS[name]
            kind = type(least)
            if not _is_number(value, kind) or not least <= value <= most:
                word = "an integer" if kind is int else "a number"
                raise UserError(
                    f"simulation.radar.{name} must be {word} from {least:g} to {most:g},"
                    f" got {value!r}"
                )
        return RadarParameters(**self.radar)

    def to_json(self) -> str:
        """Canonical text: equal configs give equal text, also that of earlier versions."""
        values = without_later_fields(dataclasses.asdict(self))
        return json.dumps(values, sort_keys=True)

    def fingerprint(self) -> str:
        """Short hash of everything the files depend on."""
        text = f"{SIMULATOR_VERSION} {self.to_json()}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def conditions(self, number: int) -> tuple[str, str, str]:
        """Environment, time and weather of sequence `number` (from 1)."""
        return CONDITIONS[(number - 1) % len(CONDITIONS)]


def _is_number(value: Any, kind: type = float) -> bool:
    kinds = (int,) if kind is int else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool)


def without_later_fields(values: dict[str, Any]) -> dict[str, Any]:
    """Less the fields at their defaults that earlier data sets were made without."""
    return {
        name: value
        for name, value in values.items()
        if name not in _LATER_FIELDS or value != _LATER_FIELDS[name]
    }


def default_config() -> dict[str, Any]:
    """Fields and defaults of `SimulationConfig` as fresh plain values."""
    return plain(dataclasses.asdict(SimulationConfig()))


def plain(config: Any) -> Any:
    """ConfigDicts and other mappings as dictionaries, tuples as lists, recursively."""
    if hasattr(config, "to_dict"):
        config = config.to_dict()
    if isinstance(config, Mapping):
        return {str(key): plain(value) for key, value in config.items()}
    if isinstance(config, list | tuple):
        return [plain(value) for value in config]
    return config
