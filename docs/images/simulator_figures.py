"""Draws the figures of `docs/simulated_radar.md`.

They show full-size maps of each kind of weather, and statistics of the simulated radar and of
a published map of K-Radar.
"""

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
NOISE_ROWS = (GRID.range_m > 30) & (GRID.range_m < 95)
LIMITS_DB = (112, 168)  # from the noise to the echoes of near trucks; of all maps
SEEN = {"color": "white", "lw": 1.0, "ls": "-"}
SIMULATED, REAL = "#0072B2", "#D55E00"
REAL_PROFILE_DB = {
    (0, 1): 12.4, (1, 5): 4.4, (5, 10): -3.2, (10, 25): -0.7, (25, 50): 0.0, (50, 75): 0.0,
    (75, 100): 0.0, (107, 114): -4.1, (114, 119): 1.1,
}  # fmt: skip
"""Bands in m and medians of a map of K-Radar, as in the table of `docs/simulated_radar.md`."""
REAL_LEAKAGE_DB = -15.5
UNSEEN = {"color": "#E69F00", "lw": 1.2, "ls": (0, (3, 1))}


def draw_scene(weather, environment, time, seed, path):
    """Draws camera image, range-azimuth, azimuth-elevation and range-Doppler maps."""
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
    figure = new_figure(9.6, 7.0, layout="constrained")
    axes = figure.subplots(2, 2, width_ratios=(1.15, 1))
    image, ground, angles, doppler = axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1]
    image.imshow(renderer.render(frame)[:, :640])
    image.axis("off")
    image.set_title("left camera")
    drawn = draw_maps((ground, angles, doppler), power_db)
    bar = figure.colorbar(drawn, ax=axes, extend="both", aspect=40, pad=0.02)
    bar.set_label("maximum of the power over the other axes [dB]")
    figure.suptitle(f"simulated frame: {weather}, {environment}, {time}")
    figure.draw_without_rendering()  # labels need the final positions of the axes
    draw_boxes(ground, image, frame, simulator.is_radar_visible(frame, given))
    figure.savefig(path)  # a color palette would lose the orange


def draw_maps(axes, power_db):
    """Draws three maps on one scale, each the maximum over the axes that it does not show."""
    ground, angles, doppler = axes
    centers = GRID.bin_centers_ego()
    colors = {"cmap": COLOR_MAP, "vmin": LIMITS_DB[0], "vmax": LIMITS_DB[1]}
    drawn = ground.pcolormesh(
        centers[..., 1], centers[..., 0], power_db.max((0, 2)), shading="nearest",
        rasterized=True, **colors,
    )  # fmt: skip
    ground.set(
        xlim=(45, -45), ylim=(0, 90), xlabel="y, left [m]", ylabel="x, ahead [m]"
    )
    ground.set_title("range and azimuth, on the ground")
    ground.set_aspect("equal")
    ground.set_facecolor("0.9")
    angles.imshow(
        power_db[:, (GRID.range_m > 5) & (GRID.range_m < 100)].max((0, 1)),
        origin="lower",
        aspect="auto",
        extent=(-53, 53, -18, 18),
        **colors,
    )
    angles.set_title("azimuth and elevation, 5 to 100 m")  # without the direct leak
    angles.set(xlabel="azimuth, right positive [deg]", ylabel="elevation [deg]")
    speeds = (GRID.doppler_mps[0], GRID.doppler_mps[-1], 0, GRID.range_m[-1])
    doppler.imshow(
        power_db.max((2, 3)).T, origin="lower", aspect="auto", extent=speeds, **colors
    )
    doppler.set_title("Doppler and range")
    doppler.set(xlabel="Doppler (aliased) [m/s]", ylabel="range [m]", ylim=(0, 90))
    return drawn


def draw_boxes(axis, legend_axis, frame, is_visible):
    """Draws boxes in the field of view: flag `R` white with name, `L` orange and dashed.

    The legend is below the image, where it covers no part of the map.
    """
    labels = []
    for box, is_seen, cls in zip(frame.boxes, is_visible, frame.cls, strict=True):
        if not GRID.in_field_of_view(box[0], box[1]):
            continue
        outline = footprints(box[None])[0][:, ::-1]
        style = SEEN if is_seen else UNSEEN
        axis.plot(*outline.T, path_effects=halo(style["lw"] + 0.8), **style)
        if is_seen:
            labels.append(Label(outline, CLASSES[cls], "white", "right"))
    draw_labels(axis, labels, font_size=7.5)
    legend_axis.legend(
        handles=[
            Line2D([], [], label=name, path_effects=halo(style["lw"] + 1.0), **style)
            for name, style in (
                ("R: visible to the radar", SEEN),
                ("L: not visible", UNSEEN),
            )
        ],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.02),
        ncols=2,
        facecolor="0.8",
    )


def draw_statistics(path):
    """Draws mean power of one frame, and profiles and echoes of all scenes beside K-Radar's."""
    levels = []
    for weather, environment, time, seed in SCENES:
        rng = np.random.default_rng(seed)
        sequence = make_sequence(seed, (environment, time, weather), 2, rng)
        options = SimulationOptions(**FULL_SIZE, seed=seed)
        simulator = SequenceSimulator(sequence, options)
        given = simulator.radar_input(sequence.frame(0))
        power = simulator.run(given, "tesseract").mean((0, 2), dtype=np.float64)
        levels.append(10 * np.log10(power))
    figure = new_figure(9.6, 8.0, layout="constrained")
    (ground, bands), (profile, beams) = figure.subplots(2, 2)
    draw_map(
        levels[0], GRID, ax=ground, color_limits=(104, 135), label="mean power [dB]"
    )
    ground.set_title("one simulated map")
    noise_db = [np.median(level[NOISE_ROWS]) for level in levels]
    draw_bands(bands, levels, noise_db)
    azimuth_deg = np.rad2deg(GRID.azimuth_rad)
    for level, noise in zip(levels, noise_db, strict=True):
        row = np.median(level, axis=1)
        profile.plot(GRID.range_m, row - noise, color=SIMULATED, lw=0.7)
        above = np.where(NOISE_ROWS[:, None], level - row[:, None], 0.0)
        index, peak = np.unravel_index(above.argmax(), above.shape)
        echo = 10 ** (level[index] / 10) - 10 ** (noise / 10)
        with np.errstate(divide="ignore", invalid="ignore"):
            echo_db = 10 * np.log10(np.maximum(echo / echo[peak], 1e-4))
        beams.plot(azimuth_deg - azimuth_deg[peak], echo_db, color=SIMULATED, lw=0.7)
    for (low, high), level_db in REAL_PROFILE_DB.items():
        profile.plot([low, high], [level_db] * 2, color=REAL, lw=3)
    profile.set(ylim=(-10, 25), xlabel="range [m]", ylabel="relative to the noise [dB]")
    profile.set_title("noise over range, median over azimuth")
    beams.axhline(REAL_LEAKAGE_DB, color=REAL, lw=3)
    beams.set(xlim=(-60, 60), ylim=(-30, 7), xlabel="azimuth from the peak [deg]")
    beams.set_ylabel("relative to the peak [dB]")
    beams.set_title("strongest echo over azimuth")
    simulated, real = {"color": SIMULATED, "lw": 1}, {"color": REAL, "lw": 3}
    handles = [Line2D([], [], label="simulated, seven scenes", **simulated)]
    for axis, name in ((profile, "real, one map"), (beams, "real: median leakage")):
        legend = [*handles, Line2D([], [], label=name, **real)]
        axis.legend(handles=legend, fontsize=9, loc="upper right")
    figure.savefig(path)


def draw_bands(axis, levels, noise_db):
    """Draws the median of every range band: of the real map, and of the simulated ones."""
    for place, ((low, high), real_db) in enumerate(REAL_PROFILE_DB.items()):
        is_in = (GRID.range_m >= low) & (GRID.range_m < high)
        found = [np.median(x[is_in]) - n for x, n in zip(levels, noise_db, strict=True)]
        axis.plot([min(found), max(found)], [place] * 2, color=SIMULATED, lw=2)
        axis.plot(np.median(found), place, "o", color=SIMULATED)
        axis.plot(real_db, place, "D", color=REAL)
    names = [f"{low} to {high} m" for low, high in REAL_PROFILE_DB]
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.axvline(0, color="0.6", lw=0.8)
    axis.set_xlabel("median relative to the noise [dB]")
    axis.set_title("range bands")
    handles = [
        Line2D([], [], color=SIMULATED, marker="o", lw=2, label="simulated, all seven"),
        Line2D([], [], color=REAL, marker="D", ls="", label="real, one map"),
    ]
    axis.legend(handles=handles, fontsize=9, loc="lower right")


def draw(out):
    """Draws all scenes and the statistics into a folder."""
    for scene in SCENES:
        draw_scene(*scene, out / f"simulator_{scene[0]}.png")
    draw_statistics(out / "simulator_statistics.png")
