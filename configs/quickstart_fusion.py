"""A small radar-camera model on simulated radar and images, in minutes on a CPU.

    python examples/pretrain_backbone.py --out backbones/small
    python train.py --config configs/quickstart_fusion.py:pretrained \\
        --image-backbone backbones/small
    python train.py --config configs/quickstart_fusion.py:radar

The second trains a narrow DinoRADE with the small image transformer of the first,
frozen, the third the same model without its camera, on the same simulated data: the
difference is what the camera adds. `docs/radar_camera.md` has the numbers to expect.
Without an option the transformer is trained with the rest, from scratch, which is too
little to learn it by.

Options: `radar` for the model without the camera; `silhouettes` for images of the objects
alone, in the colour of their class and brighter when nearer, a control of what a perfect
image would give; `pretrained` for an image transformer that stays as it is given, by
`--image-backbone` (`examples/pretrain_backbone.py` makes one), `resnet50` for a ResNet-50
of a quarter of the width in its place; `long` for the scenes and the training of
`configs/quickstart.py` itself, three times what it is without; `short` makes a run of two
minutes that learns next to nothing, to see that everything works.
"""

import pathlib
import types

from ml_collections import ConfigDict

from radejax.core.config import load_module, parse_options
from radejax.models.lifting import LiftingAxes
from radejax.simulation.config import SimulationConfig


def _neighbour(name: str) -> types.ModuleType:
    """Another config of this folder."""
    return load_module(pathlib.Path(__file__).with_name(f"{name}.py"))


def get_config(arg: str | None = None) -> ConfigDict:
    """One complete config; see the module's text for `arg`."""
    sensors, content, length, backbone = parse_options(
        arg, ("radar",), ("silhouettes",), ("short", "long"), ("pretrained", "resnet50")
    )
    options = {None: "ablation", "short": "ablation,short", "long": ""}[length]
    config = _neighbour("quickstart").get_config(options)
    config.simulation.update(
        output="projection",
        image_width=640,  # the whole view, squeezed in height: objects are side by side
        image_height=80,
    )
    if content == "silhouettes":
        config.simulation.camera_mode = "oracle"
    config.model.input_stem = True
    if sensors != "radar":
        _add_camera(config)
        config.model.image.freeze = backbone is not None
        if backbone == "resnet50":
            # As many weights as the transformer: half a million.
            config.model.image.update(kind="resnet50", resnet_width=16)
    if length == "short":
        config.simulation.update(
            train_sequences=4, test_sequences=2, frames_per_sequence=2
        )
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
        hidden_size=128,
        num_layers=4,
        num_heads=4,
        mlp_dim=256,
        num_registers=0,
    )
    config.model.fusion = full.model.fusion
    # Without the necks before the attention and with fewer samples: half the time.
    config.model.fusion.update(num_elevation=4, num_points=2, necks=False)
    config.model.query_grid = ConfigDict(
        {
            name: getattr(axes, name)
            for name in ("range_m", "azimuth_deg", "elevation_deg")
        }
    )
    # Four segments over the sensor's 36 degrees would pass above and below the cars.
    config.model.query_grid.elevation_deg = (-6.0, 6.0)
