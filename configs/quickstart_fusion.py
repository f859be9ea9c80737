"""A small radar-camera model on simulated radar and images, in minutes on a CPU.

    python train.py --config configs/quickstart_fusion.py
    python train.py --config configs/quickstart_fusion.py:radar

The first trains a narrow DinoRADE with a small image transformer from scratch, the
second the same model without its camera, on the same simulated data: the difference is
what the camera adds. `docs/radar_camera.md` has the numbers to expect.

Words: `radar` for the model without the camera; `silhouettes` for images of the objects
alone, in the colour of their class and brighter when nearer, a control of what a perfect
image would give; `pretrained` for an image transformer that stays as it is given, by
`--image_backbone` (`examples/pretrain_backbone.py` makes one); `short` makes a run of two
minutes that learns next to nothing, to see that everything works.
"""

import pathlib
import types

from ml_collections import ConfigDict

from radejax.core.config import base_config, load_module, parse_words
from radejax.models.lifting import LiftingAxes
from radejax.simulation.config import SimulationConfig, default_config


def _neighbour(name: str) -> types.ModuleType:
    """Another config of this folder."""
    return load_module(pathlib.Path(__file__).with_name(f"{name}.py"))


def get_config(arg: str | None = None) -> ConfigDict:
    """One complete config; see the module's text for `arg`."""
    sensors, content, length, backbone = parse_words(
        arg, ("radar",), ("silhouettes",), ("short",), ("pretrained",)
    )
    config = base_config()
    config.simulation = ConfigDict(default_config())
    config.simulation.update(
        train_sequences=896,
        test_sequences=192,
        frames_per_sequence=1,  # another scene teaches more than the next 0.1 s
        output="projection",
        image_width=640,  # the whole view, squeezed in height: objects are side by side
        image_height=80,
    )
    if content == "silhouettes":
        config.simulation.camera_content = "objects"
    grid = config.simulation.grid
    config.data.mirror_probability = 0.5
    config.model.update(
        doppler_bins=grid.num_doppler,
        elevation_bins=grid.num_elevation,
        input_stem=True,
        widths=(32, 64, 128),
        decoder_width=32,
        num_groups=8,
        heatmap_prior=0.02,
    )
    config.loss.sigma_cells = 1.0
    config.train.update(
        batch_size=4,
        num_epochs=5,
        warmup_steps=50,
        log_every_steps=20,
        checkpoint_every_steps=200,
    )
    config.evaluation.score_threshold = 0.05
    config.evaluation.protocols = ("kradar_r40", "exact")
    if sensors != "radar":
        _add_camera(config)
        config.model.image.freeze = backbone == "pretrained"
    if length == "short":
        config.simulation.update(
            train_sequences=4, test_sequences=2, frames_per_sequence=2
        )
        config.train.update(num_epochs=2, warmup_steps=0, checkpoint_every_steps=2)
        config.evaluation.num_pictures = 2
    return config


def _add_camera(config: ConfigDict) -> None:
    full = _neighbour("dinorade").get_config()
    axes = LiftingAxes.of_grid(
        SimulationConfig.from_mapping(config.simulation).make_grid()
    )
    config.data.camera = full.data.camera
    config.model.name = "dinorade"
    config.model.image = full.model.image
    config.model.image.update(
        size=(config.simulation.image_height, config.simulation.image_width),
        freeze=False,  # from scratch: no weights to download
        hidden_size=64,
        num_layers=3,
        num_heads=4,
        mlp_dim=128,
        num_registers=0,
    )
    config.model.fusion = full.model.fusion
    # Without the necks before the attention and with fewer samples: half the time.
    config.model.fusion.update(num_elevation=4, num_points=2, necks=False)
    config.model.axes = ConfigDict(
        {
            name: getattr(axes, name)
            for name in ("range_m", "azimuth_deg", "elevation_deg")
        }
    )
    # Four segments over the sensor's 36 degrees would pass above and below the cars.
    config.model.axes.elevation_deg = (-6.0, 6.0)
