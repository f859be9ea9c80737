"""One simulated sequence, frame by frame: what the radar receives, what the labels say."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt32

from radejax.data.kradar.labels import Label
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import clutter, scattering, tensor, two_ray, weather
from radejax.simulation.world.scene import REFLECTOR_KINDS, SceneFrame, Sequence

MIN_SNR_DB = 10.0
"""An object is visible to the radar from this ratio of its power to the noise on."""

MIN_LIT = 0.15
"""... and with this part of its power not blocked by other objects."""


@dataclasses.dataclass(frozen=True)
class RadarInput:
    """Everything that decides one radar frame.

    Attributes:
        scatterers: Point targets.
        noise_power: Mean noise power.
        key: Seed of the noise.
        snr_db: Power of each box's scatterers over the receiver noise.
        lit: Part of each box's power that no other box blocks.
    """

    scatterers: tensor.Scatterers
    noise_power: Float[np.ndarray, "R D"]
    key: UInt32[np.ndarray, "2"]
    snr_db: Float[np.ndarray, " N"]
    lit: Float[np.ndarray, " N"]


class SequenceSimulator:
    """Radar frames and labels of one sequence, the same for the same seed.

    Frames are independent of each other: any frame, in any order, on any thread.

    Args:
        sequence: The scene.
        grid: Axes of the radar.
        parameters: The rest of the radar.
        seed: Scattering centers, phases and noise follow from it, the sequence's
            number and the frame's index.
    """

    def __init__(
        self,
        sequence: Sequence,
        grid: RadarGrid,
        parameters: tensor.RadarParameters,
        seed: int,
    ) -> None:
        self.sequence, self.grid = sequence, grid
        self.parameters, self.seed = parameters, seed
        rng = np.random.default_rng([seed, sequence.name, 11])
        tracks = sequence.tracks
        self._centers = scattering.make_object_scatterers(
            tracks.cls, np.median(tracks.size_m, axis=0), rng
        )
        count = len(sequence.reflectors.kind)
        self._static_phase = rng.uniform(0.0, 2.0 * np.pi, count)

    def radar_input(self, frame: SceneFrame) -> RadarInput:
        """Scatterers and noise of a frame: NumPy, ready for `tensor.simulate`."""
        sequence, parameters = self.sequence, self.parameters
        objects, lit = scattering.scatter_objects(frame, self._centers, parameters)
        static = clutter.scatter_surroundings(frame, self._static_phase, parameters)
        ghosts = clutter.scatter_ghosts(objects, sequence.mirrors_m)
        found = scattering.join([objects, static, ghosts])
        count, is_mirrored = len(objects.power), np.ones(len(found.power), bool)
        # The cross-section of the ground stands for what it returns as it lies there.
        is_ground = frame.reflectors.kind == REFLECTOR_KINDS.index("ground")
        is_mirrored[count : count + len(is_ground)] = ~is_ground
        found = self._on_the_way(found, is_mirrored)
        power = np.bincount(objects.owner, found.power[:count], len(frame.boxes))
        return RadarInput(
            scatterers=scattering.to_scatterers(
                found, frame.ego_velocity_mps, parameters.wavelength_m
            ),
            noise_power=weather.noise_profile(
                sequence.weather, self.grid, parameters, frame.ego_velocity_mps
            ),
            key=tensor.frame_key(self.seed, sequence.name, frame.index),
            snr_db=10.0 * np.log10(power + 1e-30) - parameters.noise_db,
            lit=lit,
        )

    def _on_the_way(
        self, found: scattering.FrameScattering, is_mirrored: Bool[np.ndarray, " S"]
    ) -> scattering.FrameScattering:
        """Scatterers with what air and, where `is_mirrored`, road do to them."""
        sequence = self.sequence
        bounce = two_ray.bounce(
            found.position_m,
            sequence.ground_m,
            two_ray.SURFACES[sequence.weather],
            self.parameters.wavelength_m,
        )
        bounce = np.where(is_mirrored, bounce, 1.0)
        distance = np.linalg.norm(found.position_m, axis=1)
        air = weather.attenuation(sequence.weather, distance)
        return found._replace(
            power=found.power * air * np.square(np.abs(bounce)),
            phase_rad=found.phase_rad + np.angle(bounce),
        )

    def run(
        self,
        given: RadarInput,
        output: Literal["tesseract", "projection"] = "projection",
    ) -> Float[np.ndarray, "..."]:
        """The 4D radar tensor `[D, R, E, A]` or the projection `[R, A, D+E]`."""
        result = np.asarray(
            tensor.simulate(
                given.scatterers,
                given.noise_power,
                given.key,
                grid=self.grid,
                parameters=self.parameters,
                output="rows" if output == "tesseract" else "projection",
            )
        )
        is_whole = output == "tesseract"
        return result.transpose(tensor.TESSERACT_OF_ROWS) if is_whole else result

    def is_radar_visible(
        self, frame: SceneFrame, given: RadarInput
    ) -> Bool[np.ndarray, " N"]:
        """True for boxes in the field of view, strong enough, and not hidden."""
        inside = self.grid.in_field_of_view(frame.boxes[:, 0], frame.boxes[:, 1])
        return inside & (given.snr_db > MIN_SNR_DB) & (given.lit > MIN_LIT)

    def labels(
        self,
        frame: SceneFrame,
        given: RadarInput,
        radar_from_lidar_m: tuple[float, float, float],
        max_distance_m: float,
    ) -> list[Label]:
        """Labels of a frame, in the LiDAR frame as K-Radar's files have them.

        Args:
            frame: Scene of the frame.
            given: Radar input of the same frame.
            radar_from_lidar_m: `p_radar = p_lidar + t`.
            max_distance_m: Farther objects get no label.
        """
        visible = self.is_radar_visible(frame, given)
        distance = np.hypot(frame.boxes[:, 0], frame.boxes[:, 1])
        labels = []
        for n in np.flatnonzero(distance < max_distance_m):
            box = frame.boxes[n].copy()
            box[:3] -= radar_from_lidar_m
            labels.append(
                Label(
                    cls=self.sequence.tracks.label_cls[frame.track[n]],
                    box=tuple(box.tolist()),
                    visibility="R" if visible[n] else "L",
                    track_id=int(frame.track_id[n]),
                )
            )
        return labels
