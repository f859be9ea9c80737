"""Speed and memory of the simulator.

    python benchmarks/simulation.py                            # full size, on CPU
    python benchmarks/simulation.py --grid quickstart
    python benchmarks/simulation.py --batch 16                 # on a GPU or TPU

Every piece runs in a process of its own, so that its peak memory is its own. Pieces:

- `tree`: a whole data set on disk: tesseract, stereo image, labels; two frames at a time.
- `tesseract`: the radar's tensor alone, in memory.
- `fused`: projections without the tensor; with `--batch`, that many frames in one call.
- `parts`: what a frame of the tree consists of, one after the other.

One line each: wall and processor time per frame, frames/s, peak memory of the process.
"""

import argparse
import functools
import io
import pathlib
import resource
import subprocess
import sys
import tempfile
import time

import jax
import numpy as np

from radejax.data.kradar import write as kradar_write
from radejax.simulation.camera.renderer import CameraRenderer, stereo_calibration
from radejax.simulation.config import FULL_SIZE, SimulationConfig, default_config
from radejax.simulation.dataset import simulate_dataset, write_png
from radejax.simulation.radar import tensor
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.world.traffic import make_sequence

PIECES = ("tree", "tesseract", "fused", "parts")


def measure(name, function, frames, frames_per_call=1):
    """Calls once to compile and allocate, then for `frames` frames on the clock."""
    function(0)
    calls = max(frames // frames_per_call, 1)
    wall, cpu = time.perf_counter(), time.process_time()
    for i in range(calls):
        function(i)
    report(name, wall, cpu, calls * frames_per_call)


def report(name, wall, cpu, frames):
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:36s} {1e3 * wall / frames:8.1f} ms wall {1e3 * cpu / frames:8.1f} ms cpu"
        f" {frames / wall:8.2f} frames/s   peak {peak:6.0f} MiB {jax.default_backend()}",
        flush=True,
    )


class Bench:
    """One rainy urban sequence, and everything that makes frames of it."""

    def __init__(self, arguments):
        self.frames = arguments.frames
        self.batch_size = arguments.batch
        values = default_config()
        if arguments.grid == "kradar":
            values |= FULL_SIZE
        self.values = values
        self.config = SimulationConfig.from_mapping(values)
        self.sequence = make_sequence(
            1, environment="urban", time="day", weather="rain",
            num_frames=max(self.frames, self.batch_size),
            rng=np.random.default_rng(0),
        )  # fmt: skip
        self.simulator = SequenceSimulator(
            self.sequence,
            self.config.make_grid(),
            self.config.make_parameters(),
            seed=0,
        )
        self.inputs = [
            self.simulator.radar_input(self.sequence.frame(i))
            for i in range(len(self.sequence.ego_along_m))
        ]

    def run(self, output):
        return lambda i: self.simulator.run(self.inputs[i], output)

    def tesseract(self):
        measure("tesseract", self.run("tesseract"), self.frames)

    def fused(self):
        if not self.batch_size:
            measure("fused projection", self.run("projection"), self.frames)
            return
        batch = jax.device_put(
            jax.tree.map(
                lambda *leaves: np.stack(leaves),
                *[(x.scatterers, x.noise_power, x.key) for x in self.inputs],
            )
        )
        one = functools.partial(
            tensor.simulate,
            grid=self.simulator.grid,
            parameters=self.simulator.parameters,
        )
        run = jax.jit(jax.vmap(one))
        count = len(self.inputs)
        measure(
            f"fused projection, {count} frames a call",
            lambda i: run(*batch).block_until_ready(),
            4 * count,
            count,
        )

    def tree(self):
        """The writer of `radejax simulate`, compiled and with its threads."""
        count = 2 * self.frames
        with tempfile.TemporaryDirectory() as folder:

            def write(name, frames):
                values = self.values | {
                    "train_sequences": 1,
                    "test_sequences": 0,
                    "frames_per_sequence": frames,
                }
                root = pathlib.Path(folder) / name
                simulate_dataset(values, root, num_threads=2, progress=False)

            write("first", 1)
            wall, cpu = time.perf_counter(), time.process_time()
            write("second", count)
            report("tree: tesseract, image, labels", wall, cpu, count)

    def parts(self):
        frames, config = self.frames, self.config
        scatter, frame = self.simulator.radar_input, self.sequence.frame
        measure("scene to scatterers", lambda i: scatter(frame(i)), frames)
        tesseract = self.run("tesseract")(0)
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "tesseract_00001.mat"
            measure(
                "tesseract to .mat",
                lambda i: kradar_write.write_tesseract(path, tesseract),
                frames,
            )
        pair = stereo_calibration(
            config.lidar_to_radar_m, config.image_width, config.image_height
        )
        renderer = CameraRenderer(self.sequence, pair, seed=0)
        image = renderer.render(frame(0))
        measure("camera image", lambda i: renderer.render(frame(i)), frames)
        measure(
            "camera image to .png", lambda i: write_png(io.BytesIO(), image), frames
        )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", default="kradar", choices=["kradar", "quickstart"])
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--batch", type=int, default=0, help="frames in one call")
    parser.add_argument("--piece", choices=PIECES, help="only this one, in here")
    arguments = parser.parse_args()
    if arguments.piece:
        getattr(Bench(arguments), arguments.piece)()
        return
    print(f"{arguments.grid} grid", flush=True)
    for piece in PIECES:
        command = [sys.executable, __file__, *sys.argv[1:], "--piece", piece]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
