"""Options of the data: the section `config.data`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
import pydantic
from annotated_types import Ge, MinLen

from radejax.core.errors import require
from radejax.core.options import AtLeastOne, Count, Fraction, Options, Positive, Seed
from radejax.geometry.camera import ImageKind
from radejax.geometry.radar_grid import AzimuthMapping

DATA_PATHS = (
    "roots", "labels", "records", "embeddings", "image_backbone", "camera_calibration",
)  # fmt: skip
"""Fields of `DataOptions` that differ from machine to machine."""

Path = Annotated[
    str,
    pydantic.BeforeValidator(
        lambda x: os.fspath(x) if isinstance(x, os.PathLike) else x
    ),
    MinLen(1),
]


class CameraOptions(Options, section="config.data.camera"):
    """Options of images and calibrations."""

    projection: ImageKind = "raw"
    """raw (with lens distortion) or pinhole (without, as released)."""
    radar_from_lidar_m: tuple[float, float, float] | None = None
    """Translation t of `p_radar = p_lidar + t` in meters for all frames; None: each
    frame's own."""
    radar_from_lidar_z_m: float | None = None
    """z of t in the camera projection, which does not move boxes; None: K-Radar's 0.7, or
    the simulation's. Unused with `radar_from_lidar_m`."""
    calibration: Literal["sequence", "common"] = "sequence"
    """sequence (each sequence's own) or common (cam_front0.yml, as released)."""
    resize: bool = False
    """Resize images, and their calibrations, of another size than `model.image.size`;
    otherwise such an image is an error."""
    allow_missing: bool = True
    """Predict frames without an image or a calibration from the radar only; otherwise such a
    frame is an error."""

    def shift(
        self, own_m: Sequence[float] | np.ndarray, own_z_m: float
    ) -> tuple[float, ...]:
        """Returns the translation t of `p_radar = p_lidar + t` for one frame.

        Args:
            own_m: The frame's own t.
            own_z_m: z of the frame's t according to the mounting positions.
        """
        if self.radar_from_lidar_m is not None:
            return self.radar_from_lidar_m
        z = self.radar_from_lidar_z_m
        return tuple(map(float, (*own_m[:2], own_z_m if z is None else z)))


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
    """Weights of the image backbone, or its initial weights if it is trained: file or
    folder."""
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
    """Mapping of azimuth bins to angles: true, or stretched for the authors' checkpoints."""
    num_threads: Count | None = None
    """Number of threads that read frames; None: one per CPU that the process may use;
    0: the main thread reads them."""
    mirror_probability: Fraction = 0.0
    """Probability of mirroring a frame left to right."""
    random_gain_db: Positive | None = None
    """Largest change of the power of a frame in dB, which is drawn for each sample, as of
    receivers of another gain; None: no change."""
    augmentation: tuple[str, ...] = ()
    """Further augmentations in their order, each module:function."""
    targets: tuple[str, ...] = ()
    """Columns of the labels, such as velocity_mps, that loss terms and metrics use."""
    label_permutation_seed: Annotated[int, Ge(0)] | None = None
    """Sanity check: shuffles the labels of the training frames with this seed."""
    camera: CameraOptions | None = None
    """Images and calibrations; None for the defaults, or for radar-only models."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> DataOptions:
        is_different = len(set(self.sequences)) == len(self.sequences)
        expected = "different sequence numbers; () for all"
        require(is_different, "config.data.sequences", self.sequences, expected)
        values = self.validation
        is_fraction = len(values) == 1 and 0 < values[0] < 1
        are_numbers = all(isinstance(x, int) and x > 0 for x in values)
        is_fine = is_fraction or (are_numbers and len(set(values)) == len(values))
        expected = "different sequence numbers, or one fraction between 0 and 1"
        require(is_fine, "config.data.validation", values, f"{expected}; () for none")
        expected = "0 with config.data.targets: mirror in an own augmentation"
        is_fine = not (self.targets and self.mirror_probability)
        name = "config.data.mirror_probability"
        require(is_fine, name, self.mirror_probability, expected)
        return self

    @property
    def used_camera(self) -> CameraOptions:
        """The camera's options, or their defaults if there are none."""
        return self.camera or CameraOptions()
