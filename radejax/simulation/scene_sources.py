"""Where the sequences of a data set come from: procedural, or real label files.

A source names its sequences and their frames (numbers, time stamps, split) without
simulating anything, and makes the scene of one sequence when asked.
"""

from __future__ import annotations

import collections
import dataclasses

import numpy as np

from radejax.core.errors import UserError
from radejax.data.kradar import Frame, KRadar, sequences
from radejax.data.kradar.labels import LabelHeader
from radejax.simulation.config import SimulationConfig
from radejax.simulation.world.replay import make_real_sequence
from radejax.simulation.world.scene import FRAME_PERIOD_S, Sequence
from radejax.simulation.world.traffic import make_sequence

_FIRST_TIMESTAMP_S = 1.65e9


@dataclasses.dataclass(frozen=True)
class FrameSpec:
    """One frame of a data set before it is simulated.

    Attributes:
        scene_idx: Its index in the scene of the sequence.
        indices: Frame numbers of radar, LiDAR OS2-64, front camera, LiDAR OS1-128 and
            the other cameras: the header of its label file.
        timestamp_s: Unix time.
        split: "train" or "test".
    """

    scene_idx: int
    indices: tuple[int, int, int, int, int]
    timestamp_s: float
    split: str

    @property
    def name(self) -> str:
        return f"{self.indices[0]:05d}_{self.indices[1]:05d}"


class ProceduralSource:
    """Invented sequences numbered from 1, the training ones first."""

    def __init__(self, config: SimulationConfig) -> None:
        self._config = config
        count = config.train_sequences + config.test_sequences
        self.numbers = list(range(1, count + 1))
        self.conditions = config.conditions

    def frames(self, number: int) -> list[FrameSpec]:
        """Frames of a sequence, in order."""
        config = self._config
        rng = np.random.default_rng([config.seed, number, 3])
        radar, camera, long_lidar, others = map(int, rng.integers(1, 42, size=4))
        split = "train" if self._is_training(number) else "test"
        start = _FIRST_TIMESTAMP_S + 1000.0 * number
        return [
            FrameSpec(
                scene_idx=i,
                indices=(n + radar, n, n + camera, n + long_lidar, n + others),
                timestamp_s=start + FRAME_PERIOD_S * i,
                split=split,
            )
            for i, n in enumerate(range(1, config.frames_per_sequence + 1))
        ]

    def _is_training(self, number: int) -> bool:
        return number <= self._config.train_sequences

    def make(self, number: int) -> Sequence:
        """The scene of a sequence."""
        environment, time, weather = self.conditions(number)
        times = self._config.vru_density_scale if self._is_training(number) else 1.0
        return make_sequence(
            number,
            environment=environment,
            time=time,
            weather=weather,
            num_frames=self._config.frames_per_sequence,
            vru_density_scale=times,
            rng=np.random.default_rng([self._config.seed, number]),
        )


class LabelSource:
    """Sequences of a K-Radar label folder or zip, with K-Radar's own split."""

    def __init__(self, config: SimulationConfig) -> None:
        self._config = config
        # Objects outside the field of view block and appear in images: keep all.
        data = KRadar(
            labels=config.scenes,
            version=config.label_version,
            visibility=None,
            field_of_view=False,
            sequence_numbers=config.sequences,
        )
        self._frames: dict[int, list[Frame]] = collections.defaultdict(list)
        for frame in data:
            self._frames[frame.sequence].append(frame)
        if not self._frames:
            raise UserError(f"{config.scenes}: no frames of the chosen sequences")
        self.numbers = sorted(self._frames)

    def conditions(self, number: int) -> tuple[str, str, str]:
        """Environment, time and weather of a sequence."""
        frame = self._frames[number][0]
        return frame.environment, frame.time, frame.weather

    def frames(self, number: int) -> list[FrameSpec]:
        """Frames of a sequence, in order."""
        config, frames = self._config, self._frames[number]
        names = [f.name for f in frames]
        train = set(sequences.split_by_rule(names, "train"))
        chosen = range(0, len(frames), config.frame_stride)
        if config.frames_per_sequence:
            chosen = chosen[: config.frames_per_sequence]
        return [
            FrameSpec(
                scene_idx=index,
                indices=_header_indices(frames[index].header),
                timestamp_s=frames[index].header.timestamp_s,
                split="train" if names[index] in train else "test",
            )
            for index in chosen
        ]

    def make(self, number: int) -> Sequence:
        """The scene of a sequence."""
        return make_real_sequence(
            self._frames[number],
            radar_from_lidar_m=self._config.radar_from_lidar_m,
            rng=np.random.default_rng([self._config.seed, number]),
        )


def _header_indices(header: LabelHeader) -> tuple[int, int, int, int, int]:
    """Frame numbers of `FrameSpec`; old labels name some sensors only."""
    maybe = header.camera_front, header.lidar_long, header.camera_lrr
    camera, long_lidar, others = (header.lidar if n is None else n for n in maybe)
    return header.radar, header.lidar, camera, long_lidar, others


SceneSource = ProceduralSource | LabelSource


def make_source(config: SimulationConfig) -> SceneSource:
    """The source that a config names."""
    return (ProceduralSource if config.scenes == "procedural" else LabelSource)(config)
