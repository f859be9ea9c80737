"""A RADE-Net of reduced width on K-Radar's full grid of 256 x 107 bins, simulated.

    python train.py --config configs/full_grid.py

The quickstart's road scenes, measured by K-Radar's sensors: projections with 64 Doppler and 37
elevation bins, and images of 1280 x 720 pixels for the figures. Widths and schedule are those of
`quickstart:ablation`; `docs/results.md` lists the expected numbers.

Option `short`: a run of two minutes that tests the installation and hardly learns anything.
"""

import pathlib

from ml_collections import ConfigDict

from radejax.core.config import load_module, parse_options, plain
from radejax.simulation.config import FULL_SIZE


def get_config(arg: str | None = None) -> ConfigDict:
    """Return the complete config; `arg` is None or "short"."""
    (length,) = parse_options(arg, ("short",))
    quickstart = load_module(pathlib.Path(__file__).with_name("quickstart.py"))
    config = quickstart.get_config(",".join(filter(None, ("ablation", length))))
    config.simulation = ConfigDict(plain(config.simulation) | FULL_SIZE)
    config.simulation.output = "projection"  # a 4D tensor has 260 MB
    config.model.update(doppler_bins=64, elevation_bins=37)
    # The same width in meters as in `quickstart:ablation`: bins are 2.6 times finer.
    config.loss.heatmap_sigma_bins = 2.6
    if length == "short":
        config.simulation.update(
            train_sequences=2, test_sequences=1, frames_per_sequence=4
        )
    else:
        config.simulation.update(train_sequences=800)
        config.train.num_epochs = 5
    return config
