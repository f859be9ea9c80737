"""A small radar-camera model on simulated radar and images, trained in minutes on a CPU.

    python examples/pretrain_backbone.py --out backbones/small
    python train.py --config configs/quickstart_fusion.py:pretrained \\
        --image-backbone backbones/small
    python train.py --config configs/quickstart_fusion.py:radar

The second command trains a DinoRADE of reduced width with the frozen image transformer of the
first. The third trains the same model without the camera on the same data: the difference is what
the camera adds. `docs/results.md` lists the expected numbers. Without an option, the transformer
is trained from scratch with the rest, for which the dataset is too small.

Options:

- `radar`: the model without the camera.
- `silhouettes`: oracle images, in which every object is a silhouette in the color of its class,
  brighter when nearer; an upper bound for what a camera can add.
- `pretrained`: a frozen image transformer from `--image-backbone`
  (`examples/pretrain_backbone.py` makes one).
- `resnet50`: a ResNet-50 of a quarter of the width instead of the transformer.
- `long`: the scenes and schedule of `configs/quickstart.py`, with three times the steps.
- `short`: a run of two minutes that tests the installation and hardly learns anything.
"""

import pathlib
import types

from ml_collections import ConfigDict

from radejax.core.config import load_module, parse_options
from radejax.models.lifting import LiftingAxes
from radejax.simulation.config import SimulationConfig


def _load_neighbor(name: str) -> types.ModuleType:
    """Load another config of this folder."""
    return load_module(pathlib.Path(__file__).with_name(f"{name}.py"))


def get_config(arg: str | None = None) -> ConfigDict:
    """Return the complete config; see the module docstring for `arg`."""
    sensors, content, length, backbone = parse_options(
        arg, ("radar",), ("silhouettes",), ("short", "long"), ("pretrained", "resnet50")
    )
    options = {None: "ablation", "short": "ablation,short", "long": ""}[length]
    config = _load_neighbor("quickstart").get_config(options)
    config.simulation.update(
        output="projection",
        image_width=640,  # reduced in height, as objects stand side by side
        image_height=80,
    )
    if content == "silhouettes":
        config.simulation.camera_mode = "oracle"
    config.model.input_stem = True
    if sensors != "radar":
        _add_camera(config)
        config.model.image.freeze = backbone is not None
        if backbone == "resnet50":
            # Half a million parameters, as many as the transformer.
            config.model.image.update(kind="resnet50", resnet_width=16)
    if length == "short":
        config.simulation.update(
            train_sequences=4, test_sequences=2, frames_per_sequence=2
        )
    return config


def _add_camera(config: ConfigDict) -> None:
    full = _load_neighbor("dinorade").get_config()
    axes = LiftingAxes.of_grid(
        SimulationConfig.from_mapping(config.simulation).make_grid()
    )
    config.data.camera = full.data.camera
    config.model.name = "dinorade"
    config.model.image = full.model.image
    config.model.image.update(
        size=(config.simulation.image_height, config.simulation.image_width),
        freeze=False,  # trained from scratch, without downloads
        hidden_size=128,
        num_layers=4,
        num_heads=4,
        mlp_dim=256,
        num_registers=0,
    )
    config.model.fusion = full.model.fusion
    # No necks before the attention and fewer sampling points halve the time.
    config.model.fusion.update(num_elevation=4, num_points=2, necks=False)
    config.model.query_grid = ConfigDict(
        {
            name: getattr(axes, name)
            for name in ("range_m", "azimuth_deg", "elevation_deg")
        }
    )
    # Four segments over the sensor's 36 degrees would lie above and below the cars.
    config.model.query_grid.elevation_deg = (-6.0, 6.0)
