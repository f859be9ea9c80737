"""Sequences of a simulated dataset, and the radar input and labels of their frames.

A source lists sequences and their frames (numbers, time stamps, split) without simulating
them. It creates the scene of each sequence on request, procedurally or from label files.
"""

from __future__ import annotations

import collections
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt32

from radejax.core.errors import UserError, require
from radejax.data.kradar import Frame, KRadar
from radejax.data.kradar.folders import split_by_rule
from radejax.data.kradar.labels import Label
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar import propagation, scattering, sensor, tensor
from radejax.simulation.world import own_scenes, scene
from radejax.simulation.world.replay import make_real_sequence
from radejax.simulation.world.scene import SceneFrame, Sequence
from radejax.simulation.world.traffic import make_sequence

MIN_SNR_DB = 10.0
"""SNR that an object must exceed to be visible to the radar."""

MIN_LIT = 0.15
"""Fraction of an object's power that must reach the radar unblocked for it to be visible."""


class RadarInput(NamedTuple):
    """Input from which one radar frame is computed.

    Attributes:
        scatterers: Point targets.
        noise_power: Mean noise power of each range and Doppler bin.
        key: Random key of the noise.
        state: Imperfections of the sensor in this sequence, or None for an ideal one.
        snr_db: Ratio of the total power of each box's scatterers to the receiver noise.
        lit: Fraction of each box's power that no other box blocks.
    """

    scatterers: tensor.Scatterers
    noise_power: Float[np.ndarray, "R D"]
    key: UInt32[np.ndarray, "2"]
    state: tensor.SensorState | None
    snr_db: Float[np.ndarray, " N"]
    lit: Float[np.ndarray, " N"]

    @property
    def arrays(self) -> tuple[object, ...]:
        """The arrays from which `tensor.simulate` computes the frame."""
        return self.scatterers, self.noise_power, self.key, self.state


class SequenceSimulator:
    """Simulates radar frames and labels of one sequence, reproducibly for a given seed.

    Frames are independent of each other and can be simulated in any order and on any
    thread.

    Args:
        sequence: Scene of the sequence.
        options: Options of the dataset. Their seed and the numbers of sequence and frame
            determine scattering centers, phases, noise and drawn parameters of the radar.
    """

    def __init__(self, sequence: Sequence, options: SimulationOptions) -> None:
        self.sequence = sequence
        self.options = options
        self.grid = options.make_grid()
        self.parameters = options.radar.make_parameters()
        rng = np.random.default_rng([options.seed, sequence.name, 11])
        tracks = sequence.tracks
        sizes_m = np.median(tracks.size_m, axis=0)
        self._centers = scattering.make_object_scatterers(tracks.cls, sizes_m, rng)
        count = len(sequence.reflectors.kind)
        self._static_phase = rng.uniform(0.0, 2.0 * np.pi, count)
        rng = np.random.default_rng([options.seed, sequence.name, 13])
        self.drawn = self.parameters.draw(rng, self.grid.num_doppler)
        self._state = sensor.draw_state(self.grid, self.drawn, rng)

    def radar_input(self, frame: SceneFrame) -> RadarInput:
        """Computes scatterers and noise of a frame as NumPy input of `tensor.simulate`."""
        sequence = self.sequence
        weather = sequence.weather
        parameters = self.drawn
        wavelength_m = parameters.wavelength_m
        objects, lit = scattering.scatter_objects(frame, self._centers, parameters)
        static = scattering.scatter_surroundings(frame, self._static_phase, parameters)
        ghosts = scattering.scatter_ghosts(objects, sequence.mirrors_m)
        kinds = zip(objects, static, ghosts, strict=True)
        found = scattering.FrameScattering(*map(np.concatenate, kinds))
        surface = propagation.WEATHERS[weather].surface
        position = found.position_m
        bounce = propagation.bounce(position, sequence.ground_m, surface, wavelength_m)
        # The cross-section of the ground already includes its reflections.
        is_ground = frame.reflectors.kind == scene.REFLECTOR_KINDS.index("ground")
        count = len(objects.power)
        bounce[count : count + len(is_ground)][is_ground] = 1.0
        distance = np.linalg.norm(position, axis=1)
        air = propagation.attenuation(weather, distance)
        found = found._replace(
            power=found.power * air * np.square(np.abs(bounce)),
            phase_rad=found.phase_rad + np.angle(bounce),
        )
        power = np.bincount(objects.owner, found.power[:count], len(frame.boxes))
        noise_db = parameters.noise_db + parameters.receiver_db
        ego_mps = frame.ego_velocity_mps
        noise = propagation.noise_profile(weather, self.grid, parameters, ego_mps)
        return RadarInput(
            scatterers=scattering.to_scatterers(found, ego_mps, wavelength_m),
            noise_power=noise,
            key=tensor.frame_key(self.options.seed, sequence.name, frame.index),
            state=self._state,
            snr_db=10.0 * np.log10(power + 1e-30) - noise_db,
            lit=lit,
        )

    def run(
        self, given: RadarInput, output: tensor.Output = "projection"
    ) -> Float[np.ndarray, "..."]:
        """Computes the 4D radar tensor `[D, R, E, A]` or the projection `[R, A, D+E]`."""
        of_radar = {"grid": self.grid, "parameters": self.parameters}
        rows = np.asarray(tensor.simulate(*given.arrays, **of_radar, output=output))
        is_whole = output == "tesseract"
        return rows.transpose(tensor.TESSERACT_OF_ROWS) if is_whole else rows

    def is_radar_visible(
        self, frame: SceneFrame, given: RadarInput
    ) -> Bool[np.ndarray, " N"]:
        """Returns True for boxes that the radar can detect.

        These are in the field of view, have an SNR above `MIN_SNR_DB`, and more than
        `MIN_LIT` of their power is not blocked by other boxes.
        """
        visible: np.ndarray = self.grid.in_field_of_view(*frame.boxes[:, :2].T)
        visible &= given.snr_db > MIN_SNR_DB
        visible &= given.lit > MIN_LIT
        return visible

    def labels(self, frame: SceneFrame, given: RadarInput) -> list[Label]:
        """Returns the labels of one frame in the LiDAR frame, as in K-Radar's files."""
        visible = self.is_radar_visible(frame, given)
        distance = np.hypot(frame.boxes[:, 0], frame.boxes[:, 1])
        tracks = self.sequence.tracks
        labels = []
        for n in np.flatnonzero(distance < self.options.label_distance_m):
            box = frame.boxes[n].copy()
            box[:3] -= self.options.radar_from_lidar_m
            track = frame.track[n]
            cls = tracks.label_cls[track]
            visibility = "R" if visible[n] else "L"
            track_id = int(tracks.track_id[track])
            labels.append(Label(cls, tuple(box.tolist()), visibility, track_id))
        return labels


_FIRST_TIMESTAMP_S = 1.65e9


class FrameSpec(NamedTuple):
    """One frame of a dataset before it is simulated.

    Attributes:
        sequence: Number of the sequence.
        scene_idx: Index of the frame in the scene of the sequence.
        indices: Frame numbers of radar, LiDAR OS2-64, front camera, LiDAR OS1-128 and
            the other cameras, as in the header of the label file.
        timestamp_s: Unix time in seconds.
        split: "train" or "test".
    """

    sequence: int
    scene_idx: int
    indices: tuple[int, ...]
    timestamp_s: float
    split: str

    @property
    def name(self) -> str:
        return f"{self.indices[0]:05d}_{self.indices[1]:05d}"


class ProceduralSource:
    """Source of procedural sequences, numbered from 1 with training sequences first."""

    def __init__(self, options: SimulationOptions) -> None:
        self._options = options
        count = options.train_sequences + options.test_sequences
        self.numbers = list(range(1, count + 1))
        self.conditions = options.conditions

    def frames(self, number: int) -> list[FrameSpec]:
        """Returns the frames of the sequence `number`, in order."""
        options = self._options
        rng = np.random.default_rng([options.seed, number, 3])
        radar, camera, long_lidar, others = map(int, rng.integers(1, 42, size=4))
        split = "train" if number <= options.train_sequences else "test"
        start = _FIRST_TIMESTAMP_S + 1000.0 * number
        specs = []
        for i in range(options.frames_per_sequence):
            offsets = radar, 0, camera, long_lidar, others
            indices = tuple(i + 1 + offset for offset in offsets)
            timestamp_s = start + scene.FRAME_PERIOD_S * i
            specs.append(FrameSpec(number, i, indices, timestamp_s, split))
        return specs

    def make(self, number: int) -> Sequence:
        """Creates the scene of the sequence `number`."""
        options = self._options
        rng = np.random.default_rng([options.seed, number])
        is_training = number <= options.train_sequences
        scale = options.vru_density_scale if is_training else 1.0
        conditions = self.conditions(number)
        return make_sequence(
            number, conditions, options.frames_per_sequence, rng, scale
        )


class LabelSource:
    """Source of the sequences in a K-Radar label folder or zip, with K-Radar's split.

    Or of the sequences in a CSV file of own scenes, with all of their frames.
    """

    def __init__(self, options: SimulationOptions) -> None:
        if options.is_own:
            options = options.replace(frames_per_sequence=0)
            data = own_scenes.read_frames(options.scenes, options.radar_from_lidar_m)
        else:
            # Objects outside the field of view are kept, as they can block other objects
            # and appear in images.
            labels = KRadar(
                labels=options.scenes,
                version=options.label_version,
                visibility=None,
                field_of_view=False,
                sequences=options.sequences,
            )
            data = list(labels)
        self._options = options
        self._frames: dict[int, list[Frame]] = collections.defaultdict(list)
        for frame in data:
            if not options.sequences or frame.sequence in options.sequences:
                self._frames[frame.sequence].append(frame)
        self.numbers = sorted(self._frames)
        if not self.numbers or set(options.sequences or ()) - set(self.numbers):
            raise UserError(f"{options.scenes}: no frames of {options.sequences}")
        for number in self.numbers:
            _, time, weather = self.conditions(number)
            is_known = time in ("day", "night") and weather in propagation.WEATHERS
            name = f"{options.scenes}: time, weather of {number}/description.txt"
            expected = f"day or night, and one of {', '.join(propagation.WEATHERS)}"
            require(is_known, name, f"{time},{weather}", expected)

    def conditions(self, number: int) -> scene.Conditions:
        """Returns environment, time and weather of the sequence `number`."""
        frame = self._frames[number][0]
        return frame.environment, frame.time, frame.weather

    def frames(self, number: int) -> list[FrameSpec]:
        """Returns the frames of the sequence `number`, in order."""
        options = self._options
        frames = self._frames[number]
        names = [f.name for f in frames]
        train = set(split_by_rule(names, "train"))
        chosen = range(0, len(frames), options.frame_stride)
        if count := options.frames_per_sequence:
            # The first frames can all be in the train split. Half of the chosen ones are
            # then those before the first test frame.
            is_test = [names[index] not in train for index in chosen]
            first_test = is_test.index(True) if True in is_test else 0
            start = first_test - (count + 1) // 2 if count <= first_test else 0
            chosen = chosen[start : start + count]
        specs = []
        for index in chosen:
            header = frames[index].header
            # Sensors that are missing in old labels get the frame number of the LiDAR.
            maybe = header.camera_front, header.lidar_long, header.camera_lrr
            others = (header.lidar if n is None else n for n in maybe)
            indices = (header.radar, header.lidar, *others)
            split = "train" if names[index] in train else "test"
            specs.append(FrameSpec(number, index, indices, header.timestamp_s, split))
        return specs

    def make(self, number: int) -> Sequence:
        """Creates the scene of the sequence `number`."""
        rng = np.random.default_rng([self._options.seed, number])
        shift_m = self._options.radar_from_lidar_m
        return make_real_sequence(self._frames[number], shift_m, rng)


SceneSource = ProceduralSource | LabelSource


def make_source(options: SimulationOptions) -> SceneSource:
    """Creates the source of scenes that the options select."""
    is_procedural = options.scenes == "procedural"
    return (ProceduralSource if is_procedural else LabelSource)(options)
