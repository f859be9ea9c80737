"""Options of the data: the section `config.data`."""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic
from annotated_types import Ge, MinLen

from radejax.core.errors import require
from radejax.core.options import AtLeastOne, Count, Fraction, Options, Seed
from radejax.data.cameras import CameraOptions
from radejax.data.dataset import data_set
from radejax.data.kradar.conditions import WEATHERS
from radejax.data.kradar.labels import VERSIONS, VISIBILITY_FLAGS
from radejax.geometry.radar_grid import AzimuthMapping

DATA_PATHS = (
    *("roots", "labels", "records", "embeddings", "image_backbone"),
    "camera_calibration",
)
"""Fields of `DataOptions` that differ from machine to machine."""

_VERSIONS = (*VERSIONS, *(version.removeprefix("v") for version in VERSIONS))
Path = Annotated[str, MinLen(1)]


class DataOptions(Options, section="config.data"):
    """Frames to read, and how samples are made of them."""

    format: str = "kradar"
    """kradar, or module:Class for another reader."""
    roots: tuple[Path, ...] = ()
    """Folders of the dataset; empty: the dataset that `simulation` describes."""
    labels: Path | None = None
    """Folder or zip of a label revision; None: the labels in the roots."""
    release: Literal["polar3d", "rpc"] | None = None
    """Form of the radar data that a model is for, polar3d or rpc (reduced releases);
    None: radar tensors, or projections of them. Arrays of projections may be of any."""
    records: Path | None = None
    """Folder of preprocessed projections; None: in the first root."""
    embeddings: Path | None = None
    """Folder of embedded images (`radejax embed`); None: the images themselves."""
    image_backbone: Path | None = None
    """Weights of the frozen image backbone: file or folder."""
    camera_calibration: Path | None = None
    """Folder of camera calibrations; None: those in the roots."""
    label_version: str = "v2.1"
    """v1.0, v1.1, v2.0 or v2.1."""
    visibility: tuple[str, ...] | None = ("R",)
    """Visibility flags of the objects that count: R, L, L1; None: all."""
    include_unstarred_v11_labels: bool = False
    """Count label lines of v1.1 without an asterisk as objects, as released."""
    sequences: tuple[AtLeastOne, ...] = ()
    """Only these sequences, such as (1, 58); empty: all."""
    weather: tuple[str, ...] = ()
    """Only these kinds of weather, such as ("fog", "rain"); empty: all."""
    validation: tuple[int | float, ...] = ()
    """Sequences of the train split that are held out for validation, by number,
    or a fraction of them, such as (0.1,); empty: none."""
    validation_seed: Seed = 0
    """Seed with which a fraction is drawn; independent of `seed`."""
    num_frames: AtLeastOne = 1
    """Frames of a sample: the frame and those that precede it in its sequence, whose
    channels are concatenated."""
    max_objects: AtLeastOne = 32
    """Number of objects to which each frame is padded; K-Radar v2.1 has at most 14."""
    azimuth_mapping: AzimuthMapping = "true"
    """Mapping of azimuth bins to angles: true, or stretched for official checkpoints."""
    num_threads: Count | None = None
    """Number of threads that read frames; None: one per CPU that the process may use;
    0: the main thread reads them."""
    mirror_probability: Fraction = 0.0
    """Probability of mirroring a frame left to right."""
    label_permutation_seed: Annotated[int, Ge(0)] | None = None
    """Sanity check: shuffles the labels of the training frames with this seed."""
    camera: CameraOptions | None = None
    """Images and calibrations; None for radar-only models."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> DataOptions:
        data_set(self.format)
        for name, known in (
            ("label_version", _VERSIONS),
            ("visibility", VISIBILITY_FLAGS),
            ("weather", WEATHERS),
        ):
            value = getattr(self, name)
            values = (value,) if isinstance(value, str) else value or ()
            is_known = set(values) <= set(known) and len(set(values)) == len(values)
            expected = f"different ones of {', '.join(known)}"
            require(is_known, f"config.data.{name}", value, expected)
        is_different = len(set(self.sequences)) == len(self.sequences)
        expected = "different sequence numbers; () for all"
        require(is_different, "config.data.sequences", self.sequences, expected)
        values = self.validation
        is_fraction = len(values) == 1 and 0 < values[0] < 1
        are_numbers = all(isinstance(x, int) and x > 0 for x in values)
        is_fine = is_fraction or (are_numbers and len(set(values)) == len(values))
        expected = "different sequence numbers, or one fraction between 0 and 1"
        require(is_fine, "config.data.validation", values, f"{expected}; () for none")
        return self

    @property
    def used_camera(self) -> CameraOptions:
        """The camera's options, or their defaults if there are none."""
        return self.camera or CameraOptions()
