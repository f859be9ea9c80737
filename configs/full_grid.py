"""A RADE-Net of reduced width on K-Radar's full grid of 256 x 107 bins, simulated.

    python train.py --config configs/full_grid.py

The quickstart's road scenes, measured by K-Radar's sensors: projections with 64 Doppler and 37
elevation bins, and images of 1280 x 720 pixels for the figures. Widths and schedule are those of
`quickstart:ablation`. The numbers of `docs/results.md` were made with the radar `ideal` by code
before commit 07e885cf. This config simulates the radar `realistic`, for which none are stored.

Option `short`: a run of two minutes that tests the installation and hardly learns anything.
"""

from radejax.config import Config, load_config, parse_options
from radejax.simulation.config import FULL_SIZE


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; `arg` is None or "short"."""
    (length,) = parse_options(arg, ("short",))
    frames = {"train_sequences": 800}
    if length == "short":
        frames = {"train_sequences": 2, "test_sequences": 1, "frames_per_sequence": 4}
    return load_config(f"quickstart:ablation,{length or ''}").replace(
        # A 4D tensor has 260 MB.
        simulation=FULL_SIZE | frames | {"output": "projection"},
        model={"doppler_bins": 64, "elevation_bins": 37},
        # The same width in meters as in `quickstart:ablation`: bins are 2.6 times finer.
        loss={"heatmap_sigma_bins": 2.6},
        train={} if length == "short" else {"num_epochs": 5},
    )
