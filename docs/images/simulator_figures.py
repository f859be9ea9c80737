"""Draws the figures of `docs/simulator.md`: one row of full-size maps per kind of weather, and the
statistics of the simulated radar beside those of K-Radar's public map.

python docs/images/simulator_figures.py --out docs/images
"""

import argparse
import pathlib

import numpy as np
from matplotlib.lines import Line2D

from radejax.core.structures import CLASSES
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.camera.renderer import CameraRenderer
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.simulation.simulator import SequenceSimulator
from radejax.simulation.world.traffic import make_sequence
from radejax.visualize.draw import draw_map
from radejax.visualize.style import (
    COLOR_MAP,
    Label,
    draw_labels,
    footprints,
    halo,
    new_figure,
)

SCENES = (
    ("normal", "urban", "day", 4),
    ("overcast", "highway", "day", 3),
    ("fog", "mountain", "day", 5),
    ("rain", "countryside", "night", 6),
    ("sleet", "parkinglots", "day", 8),
    ("lightsnow", "university", "day", 2),
    ("heavysnow", "highway", "day", 1),
)
GRID = RadarGrid.kradar()
LIMITS_DB = (112, 145)  # from the noise to the echoes of cars
ANGLE_LIMITS_DB = (120, 165)  # the maximum over ranges comes mostly from near objects
SEEN = {"color": "white", "lw": 1.0, "ls": "-"}
SIMULATED, REAL = "#0072B2", "#D55E00"
REAL_PROFILE_DB = {
    (0, 1): 12.4, (1, 5): 4.4, (5, 10): -3.2, (10, 25): -0.7, (25, 50): 0.0, (50, 75): 0.0,
    (75, 100): 0.0, (107, 114): -4.1, (114, 119): 1.1,
}  # fmt: skip
"""Bands in m and medians of K-Radar's public map, as in the table of `docs/simulator.md`."""
REAL_LEAKAGE_DB = -15.5
UNSEEN = {"color": "#E69F00", "lw": 1.2, "ls": (0, (3, 1))}


def draw(weather, environment, time, seed, path):
    """Draw camera image, range-azimuth, azimuth-elevation and range-Doppler maps."""
    rng = np.random.default_rng(seed)
    sequence = make_sequence(seed, (environment, time, weather), 60, rng)
    simulator = SequenceSimulator(sequence, SimulationOptions(**FULL_SIZE, seed=seed))
    frame = sequence.frame(30)
    given = simulator.radar_input(frame)
    power_db = 10 * np.log10(simulator.run(given, "tesseract") + 1e-10)  # [D, R, E, A]
    options = SimulationOptions(
        image_width=640, image_height=360, cover_lens=weather == "sleet"
    )
    renderer = CameraRenderer(sequence, options)
    figure = new_figure(14, 3.3, layout="constrained")
    axes = figure.subplots(1, 4, width_ratios=(1.75, 1.25, 1, 1))
    axes[0].imshow(renderer.render(frame)[:, :640])
    axes[0].axis("off")
    axes[0].set_title(f"{weather}, {environment}, {time}", fontsize=10)
    maps = draw_maps(axes[1:], power_db)
    for axis, drawn in zip(axes[1:], maps, strict=True):
        axis.tick_params(labelsize=7)
        axis.xaxis.label.set_size(8)
        axis.yaxis.label.set_size(8)
        bar = figure.colorbar(drawn, ax=axis, extend="both", pad=0.02)
        bar.ax.tick_params(labelsize=7)
    bar.set_label("maximum power over the other axes [dB]", fontsize=8)
    figure.draw_without_rendering()  # labels need the final positions of the axes
    draw_boxes(axes[1], frame, simulator.is_radar_visible(frame, given))
    figure.savefig(path, dpi=110)  # a color palette would lose the orange


def draw_maps(axes, power_db):
    """Draw three maps, each the maximum over the axes that it does not show."""
    ground, angles, doppler = axes
    centers = GRID.bin_centers_ego()
    colors = {"cmap": COLOR_MAP, "vmin": LIMITS_DB[0], "vmax": LIMITS_DB[1]}
    first = ground.pcolormesh(
        centers[..., 1], centers[..., 0], power_db.max((0, 2)), shading="nearest",
        rasterized=True, **colors,
    )  # fmt: skip
    ground.set(
        xlim=(45, -45), ylim=(0, 90), xlabel="y, left [m]", ylabel="x, ahead [m]"
    )
    ground.set_aspect("equal")
    ground.set_facecolor("0.9")
    second = angles.imshow(
        power_db[:, (GRID.range_m > 5) & (GRID.range_m < 100)].max((0, 1)),
        origin="lower",
        aspect="auto",
        extent=(-53, 53, -18, 18),
        cmap=COLOR_MAP,
        vmin=ANGLE_LIMITS_DB[0],
        vmax=ANGLE_LIMITS_DB[1],
    )
    angles.set_title("from 5 to 100 m", fontsize=8)  # without the direct leak
    angles.set(xlabel="azimuth, right positive [deg]", ylabel="elevation [deg]")
    speeds = (GRID.doppler_mps[0], GRID.doppler_mps[-1], 0, GRID.range_m[-1])
    third = doppler.imshow(
        power_db.max((2, 3)).T, origin="lower", aspect="auto", extent=speeds, **colors
    )
    doppler.set(xlabel="Doppler [m/s]", ylabel="range [m]", ylim=(0, 90))
    return first, second, third


def draw_boxes(axis, frame, is_visible):
    """Draw boxes in the field of view: flag `R` white with name, `L` orange and dashed."""
    labels = []
    for box, is_seen, cls in zip(frame.boxes, is_visible, frame.cls, strict=True):
        if not GRID.in_field_of_view(box[0], box[1]):
            continue
        outline = footprints(box[None])[0][:, ::-1]
        style = SEEN if is_seen else UNSEEN
        axis.plot(*outline.T, path_effects=halo(style["lw"] + 0.8), **style)
        if is_seen:
            labels.append(Label(outline, CLASSES[cls].split()[0], "white", "right"))
    draw_labels(axis, labels, font_size=5.5)
    axis.legend(
        handles=[
            Line2D([], [], label=name, path_effects=halo(style["lw"] + 1.0), **style)
            for name, style in (
                ("R: visible to the radar", SEEN),
                ("L: not visible", UNSEEN),
            )
        ],
        loc="lower right",
        fontsize=6,
        framealpha=0.8,
        facecolor="0.8",
        handlelength=1.6,
    )


def draw_statistics(path):
    """Draw mean power of one frame, and profiles and echoes of all scenes beside K-Radar's."""
    levels = []
    for weather, environment, time, seed in SCENES:
        rng = np.random.default_rng(seed)
        sequence = make_sequence(seed, (environment, time, weather), 2, rng)
        options = SimulationOptions(**FULL_SIZE, seed=seed)
        simulator = SequenceSimulator(sequence, options)
        given = simulator.radar_input(sequence.frame(0))
        power = simulator.run(given, "tesseract").mean((0, 2), dtype=np.float64)
        levels.append(10 * np.log10(power))
    figure = new_figure(14, 4, layout="constrained")
    ground, profile, beams = figure.subplots(1, 3, width_ratios=(1.1, 1.2, 1.2))
    draw_map(
        levels[0], GRID, ax=ground, color_limits=(104, 135), label="mean power [dB]"
    )
    ground.set_title("simulated map", fontsize=10)
    range_m, azimuth_deg = GRID.range_m, np.rad2deg(GRID.azimuth_rad)
    inside = (range_m > 30) & (range_m < 95)
    for level in levels:
        row = np.median(level, axis=1)
        profile.plot(range_m, row - np.median(level[inside]), color=SIMULATED, lw=0.7)
        above = np.where(inside[:, None], level - row[:, None], 0.0)
        index, peak = np.unravel_index(above.argmax(), above.shape)
        echo = 10 ** (level[index] / 10) - 10 ** (np.median(level[inside]) / 10)
        with np.errstate(divide="ignore", invalid="ignore"):
            echo_db = 10 * np.log10(np.maximum(echo / echo[peak], 1e-4))
        beams.plot(azimuth_deg - azimuth_deg[peak], echo_db, color=SIMULATED, lw=0.7)
    for (low, high), level_db in REAL_PROFILE_DB.items():
        profile.plot([low, high], [level_db] * 2, color=REAL, lw=3)
    profile.set(ylim=(-10, 25), xlabel="range [m]", ylabel="relative to the noise [dB]")
    profile.set_title("median over azimuth", fontsize=10)
    beams.axhline(REAL_LEAKAGE_DB, color=REAL, lw=3)
    beams.set(xlim=(-60, 60), ylim=(-30, 1), xlabel="azimuth from the peak [degrees]")
    beams.set_ylabel("relative to the peak [dB]")
    beams.set_title("strongest echo; median leakage of the map", fontsize=10)
    names = ("simulated, seven scenes", SIMULATED, 1), ("real, one map", REAL, 3)
    lines = [Line2D([], [], color=c, lw=w, label=name) for name, c, w in names]
    profile.legend(handles=lines, fontsize=8)
    figure.savefig(path, dpi=110)


def main():
    """Draw all scenes, or those of the named kinds of weather, and the statistics."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/images"))
    parser.add_argument("--weather", nargs="*", default=[s[0] for s in SCENES])
    given = parser.parse_args()
    for scene in SCENES:
        if scene[0] in given.weather:
            draw(*scene, given.out / f"simulator_{scene[0]}.png")
    draw_statistics(given.out / "simulator_statistics.png")


if __name__ == "__main__":
    main()
