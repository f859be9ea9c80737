"""Speed and memory of the simulator.

    python benchmarks/simulation.py [--grid kradar|quickstart] [--frames 4] [--rows 1]

Prints one line per piece: milliseconds a frame (wall, CPU time of the process) and the
process's peak memory so far. On an accelerator use `--rows 64`.
"""

import argparse
import pathlib
import resource
import tempfile
import time

import jax
import numpy as np

from radejax.data import kradar_write
from radejax.simulation import radar
from radejax.simulation.camera import CameraRenderer, stereo_calibration
from radejax.simulation.config import SimulationConfig, default_config
from radejax.simulation.dataset import encode_png
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.traffic import make_sequence


def measure(name, function, frames):
    function(0)  # compile, allocate
    wall, cpu = time.perf_counter(), time.process_time()
    for i in range(frames):
        function(i)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:34s} {1e3 * wall / frames:9.1f} ms wall {1e3 * cpu / frames:9.1f} ms cpu"
        f" {frames / wall:7.2f} frames/s   peak {peak:6.0f} MiB",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--grid", default="kradar", choices=["kradar", "quickstart"])
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--rows", type=int, default=1, help="range rows per step")
    parser.add_argument("--batch", type=int, default=0, help="frames in one call")
    arguments = parser.parse_args()
    values = default_config()
    if arguments.grid == "kradar":
        values |= {"grid": "kradar", "radar": {}}
        values |= {"image_width": 1280, "image_height": 720}
    config = SimulationConfig.from_mapping(values)
    sequence = make_sequence(
        1, environment="urban", time="day", weather="rain",
        num_frames=max(arguments.frames, arguments.batch),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    grid, parameters = config.make_grid(), config.make_parameters()
    simulator = SequenceSimulator(sequence, grid, parameters, seed=0)
    pair = stereo_calibration(
        config.lidar_to_radar_m, config.image_width, config.image_height
    )
    renderer = CameraRenderer(sequence, pair, seed=0)
    inputs = [simulator.radar_input(i) for i in range(sequence.num_frames)]
    amplitude = np.abs(inputs[0].scatterers.amplitude).sum(-1)
    print(f"{jax.devices()[0].platform}, {int((amplitude > 0).sum())} scatterers")

    frames = arguments.frames
    measure("scene to scatterers", simulator.radar_input, frames)
    measure(
        "fused projection",
        lambda i: simulator.run(inputs[i], "projection", arguments.rows),
        frames,
    )
    if arguments.batch:
        batch = jax.device_put(
            jax.tree.map(
                lambda *leaves: np.stack(leaves),
                *[(x.scatterers, x.noise_power, x.key) for x in inputs],
            )
        )
        run = jax.jit(
            jax.vmap(
                lambda s, n, k: radar.simulate(
                    s, n, k, grid=grid, parameters=parameters,
                    rows_per_step=arguments.rows,
                )
            )
        )  # fmt: skip
        measure(
            f"fused projection, {len(inputs)} frames",
            lambda i: run(*batch).block_until_ready(),
            frames,
        )
    measure(
        "tesseract",
        lambda i: simulator.run(inputs[i], "tesseract", arguments.rows),
        frames,
    )
    tesseract = simulator.run(inputs[0], "tesseract", arguments.rows)
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "tesseract_00001.mat"
        measure(
            "tesseract to .mat",
            lambda i: kradar_write.write_tesseract(path, tesseract),
            frames,
        )
    image = renderer.render(sequence.frame(0))
    measure("camera image", lambda i: renderer.render(sequence.frame(i)), frames)
    measure("camera image to .png", lambda i: encode_png(image), frames)


if __name__ == "__main__":
    main()
