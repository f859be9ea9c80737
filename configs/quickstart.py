"""A RADE-Net of reduced width on a small simulated dataset, trained in minutes on a CPU.

    python train.py --config configs/quickstart.py

Simulates K-Radar folders with a coarser sensor, preprocesses, trains, evaluates on held-out
sequences and draws figures. The code is that of the full model; only widths and grid differ.

Options:

- `ablation`: the training of `examples/ablation.py`, with two fifths of the scenes and steps and
  with the papers' input, loss weights and parameters.
- `short`: a run of two minutes that tests the installation and hardly learns anything.
"""

from radejax.config import Config, parse_options
from radejax.losses.detection import LossOptions
from radejax.models.options import RadeNetOptions
from radejax.simulation.config import SimulationOptions


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; see the module docstring for `arg`."""
    recipe, length = parse_options(arg, ("ablation",), ("short",))
    # One frame per sequence, as another scene is more informative than the next tenth
    # of a second. Rare classes are oversampled.
    simulation = SimulationOptions(
        train_sequences=640,
        test_sequences=224,
        frames_per_sequence=1,
        vru_density_scale=3.0,
    )
    grid = simulation.make_grid()
    config = Config(
        simulation=simulation,
        model=RadeNetOptions(
            doppler_bins=grid.num_doppler,
            elevation_bins=grid.num_elevation,
            widths=(32, 64, 128),
            decoder_width=32,
            num_groups=8,
            heatmap_prior=0.02,  # about the value that the first epochs would learn
        ),
        loss=LossOptions(heatmap_sigma_bins=1.0),  # a bin is 1.2 m long
    ).replace(
        data={"mirror_probability": 0.5},
        train={
            "batch_size": 2,
            "num_epochs": 7,
            "warmup_steps": 20,
            "log_every_steps": 20,
            "checkpoint_every_steps": 200,
        },
        evaluation={
            "score_threshold": 0.05,
            "protocols": ("kradar_r40", "all_point", "coco101"),
        },
    )
    if recipe != "ablation":
        config = _with_recipe(config)
    if length == "short":
        config = config.replace(
            simulation={
                "train_sequences": 2,
                "test_sequences": 1,
                "frames_per_sequence": 12,
            },
            train={
                "batch_size": 4,
                "num_epochs": 2,
                "warmup_steps": 0,
                "ema_decay": None,  # an average over so few steps would be the initial values
                "log_every_steps": 10,
                "checkpoint_every_steps": 2,
            },
            evaluation={"num_visualizations": 2},
        )
    return config


def _with_recipe(config: Config) -> Config:
    """Returns a config with the settings of `docs/reports/2026-11-24_quickstart_tuning.md`."""
    return config.replace(
        simulation={"train_sequences": 1600, "vru_density_scale": 5.0},
        # The input has mean 0.64 and standard deviation 0.044: without scaling, it is
        # almost constant.
        model={"input_center": 0.64, "input_scale": 14.0},
        # Classification is harder than box regression. Smooth L1 is dominated by boxes
        # with large errors, mostly trucks; the GWD also improves boxes that are nearly
        # right.
        loss={"heatmap_sigma_bins": 0.75, "weights": {"focal": 8.0, "gwd": 4.0}},
        train={"ema_decay": 0.999},
    )
