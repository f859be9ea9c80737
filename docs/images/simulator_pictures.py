"""Makes the pictures of `docs/simulator.md`: one row of maps per weather, full size.

python docs/images/simulator_pictures.py [FOLDER]
"""

import pathlib
import sys

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.camera import CameraRenderer, stereo_calibration
from radejax.simulation.radar import RadarParameters
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.traffic import make_sequence
from radejax.structures import CLASSES

SCENES = (
    ("normal", "urban", "day", 4),
    ("overcast", "highway", "day", 3),
    ("fog", "mountain", "day", 5),
    ("rain", "countryside", "night", 6),
    ("sleet", "parkinglots", "day", 8),
    ("lightsnow", "university", "day", 2),
    ("heavysnow", "highway", "day", 1),
)
OFFSET = (-2.54, 0.3, 0.7)
GRID = RadarGrid.kradar()


def outline(box):
    """`[5, 2]` corners of a box on the ground, closed."""
    unit = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2 * box[3:5]
    c, s = np.cos(box[6]), np.sin(box[6])
    return unit @ np.array([[c, s], [-s, c]]) + box[:2]


def draw(weather, environment, time, seed, path):
    """Camera image, range-azimuth, azimuth-elevation and range-Doppler maps in a row."""
    sequence = make_sequence(
        seed, environment=environment, time=time, weather=weather, num_frames=60,
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    simulator = SequenceSimulator(sequence, GRID, RadarParameters(), seed)
    frame = sequence.frame(30)
    given = simulator.radar_input(30, frame)
    power_db = 10 * np.log10(simulator.run(given, "tesseract") + 1e-10)  # [D, R, E, A]
    visible = simulator.is_radar_visible(frame, given)
    renderer = CameraRenderer(
        sequence, stereo_calibration(OFFSET, 640, 360), 0, cover_lens=weather == "sleet"
    )
    figure, axes = plt.subplots(
        1, 4, figsize=(13, 3.1), width_ratios=(1.75, 1.15, 1, 1), layout="constrained"
    )
    axes[0].imshow(renderer.render(frame)[:, :640])
    axes[0].axis("off")
    axes[0].set_title(f"{weather}, {environment}, {time}", fontsize=9)
    colors = {"cmap": "viridis", "vmin": 96, "vmax": 130}
    centers = GRID.cell_centers_ego()
    axes[1].pcolormesh(
        -centers[..., 1], centers[..., 0], power_db.max((0, 2)), shading="nearest",
        rasterized=True, **colors,
    )  # fmt: skip
    for box, is_visible, cls in zip(frame.boxes, visible, frame.cls, strict=True):
        if GRID.in_field_of_view(box[0], box[1]):
            x, y = outline(box).T
            color = "red" if is_visible else "white"
            axes[1].plot(-y, x, color=color, lw=0.7)
            if is_visible:
                axes[1].text(
                    -box[1] + 1.5,
                    box[0],
                    CLASSES[cls][:3],
                    color="white",
                    fontsize=4.5,
                    clip_on=True,
                )
    axes[1].set(xlim=(-45, 45), ylim=(0, 90), xlabel="right [m]", ylabel="forward [m]")
    axes[1].set_aspect("equal")
    degrees = (-53, 53, -18, 18)
    axes[2].imshow(
        power_db.max((0, 1)), origin="lower", aspect="auto", extent=degrees, **colors
    )
    axes[2].set(xlabel="azimuth [deg]", ylabel="elevation [deg]")
    speeds = (GRID.doppler_mps[0], GRID.doppler_mps[-1], 0, GRID.range_m[-1])
    axes[3].imshow(
        power_db.max((2, 3)).T, origin="lower", aspect="auto", extent=speeds, **colors
    )
    axes[3].set(xlabel="Doppler [m/s]", ylabel="range [m]", ylim=(0, 90))
    for axis in axes[1:]:
        axis.tick_params(labelsize=6)
        axis.xaxis.label.set_size(7)
        axis.yaxis.label.set_size(7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    Image.open(path).convert("RGB").quantize(128).save(path, optimize=True)


if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    for scene in SCENES:
        draw(*scene, folder / f"simulator_{scene[0]}.png")
