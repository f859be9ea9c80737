"""RADE-Net on simulated radar frames of K-Radar's own scenes, with the quickstart's sensor.

    python train.py --config configs/simulate_real_scenes.py \\
        --config.simulation.scenes=LABELS.zip

LABELS is K-Radar's label revision v2.1, a folder or zip: every 15th frame of all 58 sequences
becomes a simulated radar frame, with K-Radar's split. `docs/reports/2026-11-22_simulator.md` lists
the expected numbers and those of a CFAR detector.
"""

from ml_collections import ConfigDict

from radejax.core.config import base_config, parse_options
from radejax.simulation.config import default_config


def get_config(arg: str | None = None) -> ConfigDict:
    """Return the complete config; there are no variants."""
    parse_options(arg)
    config = base_config()
    config.simulation = ConfigDict(default_config())
    config.simulation.update(
        scenes="labels_v2_1.zip",
        frame_stride=15,
        frames_per_sequence=0,
        image_width=0,
        image_height=180,
        output="projection",
    )
    grid = config.simulation.grid
    config.data.mirror_probability = 0.5
    config.model.update(
        doppler_bins=grid.num_doppler,
        elevation_bins=grid.num_elevation,
        widths=(32, 64, 128),
        decoder_width=32,
        num_groups=8,
        heatmap_prior=0.02,
    )
    config.loss.heatmap_sigma_bins = 1.0
    config.train.update(
        batch_size=4,
        num_epochs=4,
        warmup_steps=20,
        log_every_steps=20,
        checkpoint_every_steps=100,
    )
    config.evaluation.score_threshold = 0.05
    config.evaluation.protocols = (
        "all_point",
        "kradar_r40",
        "kradar_r40_corrected",
        "coco101",
    )
    return config
