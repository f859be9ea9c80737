"""A small radar-camera model on simulated radar and images, trained in minutes on a CPU.

    python examples/pretrain_backbone.py --out backbones/small
    python train.py --config configs/quickstart_fusion.py:pretrained \\
        --image-backbone backbones/small
    python train.py --config configs/quickstart_fusion.py:radar

The second command trains a DinoRADE of reduced width with the frozen image transformer of the
first. The third trains the same model without the camera on the same data: the difference is what
the camera adds. `docs/results.md` lists the expected numbers, of `long` with the radar `ideal`
only. Without an option, the transformer is trained from scratch with the rest, for which the
dataset is too small.

Options:

- `radar`: the model without the camera.
- `silhouettes`: oracle images, in which every object is a silhouette in the color of its class,
  brighter when nearer; an upper bound for what a camera can add.
- `pretrained`: a frozen image transformer from `--image-backbone`
  (`examples/pretrain_backbone.py` makes one).
- `resnet50`: a ResNet-50 of a quarter of the width instead of the transformer.
- `long`: the scenes and schedule of `configs/quickstart.py`, with 2.5 times the steps.
- `short`: a run of two minutes that tests the installation and hardly learns anything.
"""

from radejax.config import Config, load_config, parse_options
from radejax.data.options import CameraOptions
from radejax.models.options import (
    DinoRadeOptions,
    FusionOptions,
    ImageOptions,
    QueryGridOptions,
)


def get_config(arg: str | None = None) -> Config:
    """Returns the complete config; see the module docstring for `arg`."""
    sensors, content, length, backbone = parse_options(
        arg, ("radar",), ("silhouettes",), ("short", "long"), ("pretrained", "resnet50")
    )
    options = {None: "ablation", "short": "ablation,short", "long": ""}[length]
    config = load_config(f"quickstart:{options}").replace(
        simulation={
            "output": "projection",
            "image_width": 640,  # reduced in height, as objects stand side by side
            "image_height": 80,
            "camera_mode": "oracle" if content == "silhouettes" else "scene",
        },
        model={"input_stem": True},
    )
    if sensors != "radar":
        config = _with_camera(config)
        # Without `pretrained` or `resnet50`, the backbone is trained from scratch.
        image: dict[str, object] = {"freeze": backbone is not None}
        if backbone == "resnet50":
            # Half a million parameters, as many as the transformer.
            image |= {"kind": "resnet50", "resnet_width": 16}
        config = config.replace(model={"image": image})
    if length == "short":
        config = config.replace(
            simulation={
                "train_sequences": 4,
                "test_sequences": 2,
                "frames_per_sequence": 2,
            }
        )
    return config


def _with_camera(config: Config) -> Config:
    """Returns a config of DinoRADE with the radar branch of another config."""
    simulation = config.simulation
    assert simulation is not None  # the quickstart simulates its data
    axes = QueryGridOptions.of_grid(simulation.make_grid())
    model = DinoRadeOptions(
        **dict(config.model) | {"name": "dinorade"},
        image=ImageOptions(
            size=(simulation.image_height, simulation.image_width),
            hidden_size=128,
            num_layers=4,
            num_heads=4,
            mlp_dim=256,
            num_registers=0,
        ),
        # No necks before the attention and fewer sampling points halve the time.
        fusion=FusionOptions(num_elevation=4, num_points=2, necks=False),
        # Four segments over the sensor's 36 degrees would lie above and below the cars.
        query_grid=axes.replace(elevation_deg=(-6.0, 6.0)),
    )
    return config.replace(model=model, data={"camera": CameraOptions()})
