"""A narrow RADE-Net on a small simulated data set: the whole way in minutes, on a CPU.

    python train.py --config configs/quickstart.py

Simulates K-Radar folders on a coarser sensor, projects, trains, evaluates on held-out
sequences and draws. The code is that of the full model; only widths and grid differ.

Options: `ablation` for the training of `examples/ablation.py`'s tables, where there are
many: two fifths of scenes and steps, and input, weights of the losses and parameters as
in the papers; `short` for a run of two minutes that learns next to nothing, to see that
everything works.
"""

from ml_collections import ConfigDict

from radejax.core.config import base_config, parse_options
from radejax.simulation.config import default_config


def get_config(arg: str | None = None) -> ConfigDict:
    """One complete config; see the module's text for `arg`."""
    recipe, length = parse_options(arg, ("ablation",), ("short",))
    config = base_config()
    config.simulation = ConfigDict(default_config())
    grid = config.simulation.grid
    # One frame a sequence: a network learns more from another scene than from the next
    # tenth of a second. More of the classes that roads have few of, to learn from.
    config.simulation.update(
        train_sequences=640,
        test_sequences=224,
        frames_per_sequence=1,
        vru_density_scale=3.0,
    )
    config.data.mirror_probability = 0.5
    config.model.update(
        doppler_bins=grid.num_doppler,
        elevation_bins=grid.num_elevation,
        widths=(32, 64, 128),
        decoder_width=32,
        num_groups=8,
        heatmap_prior=0.02,  # saves the first epochs, which push all bins down to here
    )
    config.loss.heatmap_sigma_bins = 1.0  # of bins of 1.2 m
    config.train.update(
        batch_size=2,
        num_epochs=7,
        warmup_steps=20,
        log_every_steps=20,
        checkpoint_every_steps=200,
    )
    config.evaluation.score_threshold = 0.05
    config.evaluation.protocols = ("kradar_r40", "all_point", "coco101")
    if recipe != "ablation":
        _teach_more(config)
    if length == "short":
        config.simulation.update(
            train_sequences=2, test_sequences=1, frames_per_sequence=12
        )
        config.train.update(
            batch_size=4,
            num_epochs=2,
            warmup_steps=0,
            ema_decay=None,  # of so few steps it would be where they began
            log_every_steps=10,
            checkpoint_every_steps=2,
        )
        config.evaluation.num_visualizations = 2
    return config


def _teach_more(config: ConfigDict) -> None:
    """What `docs/results.md` has found to help, beside more scenes and steps."""
    config.simulation.update(train_sequences=1600, vru_density_scale=5.0)
    # Noise is at 0.545 with a spread of 0.02: the input as it is is next to constant.
    config.model.update(input_center=0.545, input_scale=25.0)
    config.loss.heatmap_sigma_bins = 0.75
    # Finding is harder than boxing; and of boxes, smooth L1 learns from those that are
    # far off, trucks' most of all, the GWD from those that are nearly right.
    config.loss.weights.update(focal=8.0, gwd=4.0)
    config.train.update(num_epochs=7, ema_decay=0.999)
