"""A narrow RADE-Net on all of K-Radar's grid, simulated: 256 ranges and 107 azimuths.

    python train.py --config configs/full_grid.py

The quickstart's road scenes, seen by K-Radar's own sensors: the radar's projections, 64
Doppler and 37 elevation bins of each of the 256 x 107 bins, and images of 1280 x 720
pixels for the figures. Widths and recipe are those of `quickstart:ablation`;
`docs/results.md` has the numbers to expect, and the time.

The argument `short` makes a run of two minutes that learns next to nothing, to see
that everything works.
"""

import pathlib

from ml_collections import ConfigDict

from radejax.core.config import load_module, parse_options
from radejax.simulation.config import FULL_SIZE, plain


def get_config(arg: str | None = None) -> ConfigDict:
    """One complete config; `arg` is None or "short"."""
    (length,) = parse_options(arg, ("short",))
    quickstart = load_module(pathlib.Path(__file__).with_name("quickstart.py"))
    config = quickstart.get_config(",".join(filter(None, ("ablation", length))))
    config.simulation = ConfigDict(plain(config.simulation) | FULL_SIZE)
    config.simulation.output = "projection"  # a tensor in K-Radar's files has 1 GB
    config.model.update(doppler_bins=64, elevation_bins=37)
    # The spread of `quickstart:ablation` in metres of range: bins are 2.6 times finer.
    config.loss.heatmap_sigma_bins = 2.6
    if length == "short":
        config.simulation.update(
            train_sequences=2, test_sequences=1, frames_per_sequence=4
        )
    else:
        config.simulation.update(train_sequences=800)
        config.train.num_epochs = 5
    return config
