"""RADE-Net on simulated radar frames of K-Radar's own scenes, with the quickstart's sensor.

    python train.py --config configs/simulate_real_scenes.py \\
        --config.simulation.scenes=LABELS.zip

LABELS is K-Radar's label revision v2.1, a folder or zip: every 15th frame of all 58 sequences
becomes a simulated radar frame, with K-Radar's split. `docs/reports/2026-11-22_simulator.md` lists
the expected numbers and those of a CFAR detector.
"""

from radejax.config import Config, load_config, parse_options
from radejax.simulation.config import SimulationOptions


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; there are no variants."""
    parse_options(arg)
    return load_config("quickstart:ablation").replace(
        simulation=SimulationOptions(
            scenes="labels_v2_1.zip",
            frame_stride=15,
            frames_per_sequence=0,
            image_width=0,
            image_height=180,
            output="projection",
        ),
        train={"batch_size": 4, "num_epochs": 4, "checkpoint_every_steps": 100},
        evaluation={
            "protocols": (
                "all_point",
                "kradar_r40",
                "kradar_r40_corrected",
                "coco101",
            ),
        },
    )
