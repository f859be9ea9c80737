"""Times of DinoRADE and its parts at full size, beside plain torch where it is at hand.

    python benchmarks/dinorade.py                      # everything, float32, batch 1
    python benchmarks/dinorade.py --parts attention    # deformable attention alone
    python benchmarks/dinorade.py --parts training     # gradient, embedded images too
    python benchmarks/dinorade.py --dtype bfloat16 --batch 1 6

256 x 112 x 10 queries, 720 x 1280 images, 180 x 320 x 128 camera map. Weights and inputs
are random. Rivals of one row run in turns within one process, and the fastest of the
repetitions counts, so that a busy machine hurts both alike; "CPU s" is the processor
time of all threads, which it hurts least. The torch column is the same network in plain
torch, `torch_dinorade.py`. Memory is what the compiled program needs beside inputs and
outputs.
"""

import argparse
import functools
import pathlib
import resource
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from tabulate import tabulate

from radejax.core.config import load_module
from radejax.geometry.calibration import CameraCalibration
from radejax.models import build
from radejax.models.deformable_attention import DeformableAttention
from radejax.models.lifting import static_reference_points
from radejax.training.state import merge_parameters, split_parameters

sys.path.insert(0, str(pathlib.Path(__file__).parent))
try:
    import torch
    import torch_dinorade
except ModuleNotFoundError:
    torch = None

BINS, ELEVATION, MAP, WIDTH, HEADS, POINTS = 256 * 112, 10, (180, 320), 128, 4, 4

# K-Radar's front camera, sequence 1.
CALIBRATION = CameraCalibration.from_angles(
    intrinsics=(567.7208, 577.2137, 628.7208, 369.3069),
    distortion=(-0.0288738, 0.0006023, 0.0039573, -0.0050472, 0.0),
    yaw_deg=88.6,
    pitch_deg=0.6,
    roll_deg=89.6,
    translation_m=(0.18, -0.13, 0.0),
)


def full_size_config(variant, dtype):
    path = pathlib.Path(__file__).parents[1] / "configs" / "dinorade.py"
    module = load_module(path)
    config = module.get_config(variant)
    config.model.dtype = dtype
    return config.model


def full_size_model(variant, dtype):
    return build(full_size_config(variant, dtype))


def measure(functions, repeats):
    """Fastest wall time and processor time of each function, run in turns."""
    best = dict.fromkeys(functions, (np.inf, np.inf))
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            wall, processor = time.perf_counter(), time.process_time()
            function()
            taken = (time.perf_counter() - wall, time.process_time() - processor)
            best[name] = tuple(map(min, best[name], taken))
    return best


def compiled(function, *args):
    """A call of the compiled function on its arguments, and its memory in MiB."""
    program = jax.jit(function).lower(*args).compile()
    memory = program.memory_analysis().temp_size_in_bytes / 2**20
    return lambda: jax.block_until_ready(program(*args)), memory


def matrix_rate(size=2048, repeats=5):
    """GFLOP/s of a float32 matrix product: what this machine can give at best."""
    x = jnp.ones((size, size))
    call, _ = compiled(jnp.matmul, x, x)
    (wall, _) = measure({"product": call}, repeats)["product"]
    return 2e-9 * size**3 / wall


# Deformable attention ----------------------------------------------------------------


def attention_inputs(batch):
    rng = np.random.default_rng(0)
    normal = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    scale = np.exp(normal(batch, BINS, ELEVATION))
    sizes = {"sampling_offsets": 2, "attention_weights": 1}
    sizes = {k: v * HEADS * POINTS for k, v in sizes.items()}
    sizes |= {"value_proj": WIDTH, "output_proj": WIDTH}
    params = {
        name: {"kernel": 0.1 * normal(WIDTH, size), "bias": normal(size)}
        for name, size in sizes.items()
    }
    model = full_size_model("rcw", "float32")
    reference = static_reference_points(CALIBRATION, model.axes, 256, 112)
    return (
        params,
        normal(batch, BINS, WIDTH),
        scale / scale.sum(-1, keepdims=True),
        reference.points.reshape(1, BINS, ELEVATION, 2),
        normal(batch, *MAP, WIDTH),
    )


def our_attention(params, feature, scale, points, value):
    module = DeformableAttention(WIDTH, HEADS, POINTS)
    weights = jnp.full(points.shape[:-1], 1 / ELEVATION)
    return module.apply(
        {"params": params}, feature, scale, points, weights, value, method="lifted"
    )


def torch_device():
    return "cuda" if torch.cuda.is_available() else "cpu"


def finish():
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def torch_calls(inputs):
    params, feature, scale, points, value = inputs
    module = torch_dinorade.Attention(WIDTH, HEADS, POINTS)
    state = {f"{k}.weight": v["kernel"].T for k, v in params.items()}
    state |= {f"{k}.bias": v["bias"] for k, v in params.items()}
    module.load_state_dict({k: torch.tensor(v) for k, v in state.items()})
    module = module.to(torch_device())
    feature, scale, points, value = (
        torch.tensor(np.array(x), device=torch_device())
        for x in (feature, scale, points[0], value.transpose(0, 3, 1, 2))
    )

    def forward():
        with torch.no_grad():
            out = module(feature, scale, points, value)
        finish()
        return out

    def gradient():
        module.zero_grad(set_to_none=True)
        given = [x.detach().requires_grad_() for x in (feature, scale, value)]
        module(*given[:2], points, given[2]).square().sum().backward()
        finish()

    return forward, gradient


def attention_rows(batch, repeats):
    inputs = attention_inputs(batch)

    def loss(*args):
        return jnp.square(our_attention(*args)).sum()

    device_inputs = jax.tree.map(jnp.asarray, inputs)
    forward, memory = compiled(our_attention, *device_inputs)
    gradient, gradient_memory = compiled(jax.grad(loss, (0, 1, 2, 4)), *device_inputs)
    calls = {"forward": {"ours": forward}, "forward and gradient": {"ours": gradient}}
    if torch is not None:
        torch_forward, torch_gradient = torch_calls(inputs)
        error = np.abs(torch_forward().cpu().numpy() - np.asarray(forward())).max()
        print(f"largest difference from torch: {error:.1e}")
        calls["forward"]["torch"] = torch_forward
        calls["forward and gradient"]["torch"] = torch_gradient
    for (name, rivals), used in zip(
        calls.items(), (memory, gradient_memory), strict=True
    ):
        times = measure(rivals, repeats)
        yield row(f"deformable attention, {name}", batch, times, used)


# The model ---------------------------------------------------------------------------


def model_and_inputs(variant, dtype, batch):
    model = full_size_model(variant, dtype)
    rng = np.random.default_rng(0)
    projection = rng.random((batch, 256, 107, 101), np.float32)
    image = rng.integers(0, 256, (batch, 720, 1280, 3), np.uint8)
    reference = static_reference_points(CALIBRATION, model.axes, 256, 112)
    reference = jax.tree.map(jnp.asarray, reference)
    shapes = jax.eval_shape(
        model.init, jax.random.key(0), projection[:1], image[:1], reference
    )
    variables = jax.tree.map(  # positive, for the variances among them
        lambda x: jnp.asarray(
            np.abs(0.02 * rng.standard_normal(x.shape, np.float32)) + 1e-3
        ),
        shapes,
    )
    features = jnp.zeros((batch, *model.feature_shape))
    return model, variables, projection, image, features, reference


def torch_model(variant, dtype, projection, image, reference):
    """Calls of the torch model by name, without gradient, and one with."""
    points = torch.tensor(np.array(reference.points)).reshape(BINS, ELEVATION, 2)
    model = torch_dinorade.DinoRade(full_size_config(variant, dtype), points)
    model = model.to(torch_device()).eval()
    x = np.pad(projection, ((0, 0), (0, 0), (0, 5), (0, 0))).transpose(0, 3, 1, 2)
    x, image = (torch.tensor(a.copy(), device=torch_device()) for a in (x, image))
    features = model.embed(image)

    def cast():
        is_half = dtype == "bfloat16"
        return torch.autocast(torch_device(), torch.bfloat16, enabled=is_half)

    def no_gradient(call):
        with torch.inference_mode(), cast():
            call()
        finish()

    def gradient(embed):
        model.train()
        model.zero_grad(set_to_none=True)
        with cast():
            heatmap, boxes = model(x, embed())
        (heatmap.float().square().mean() + boxes.float().square().mean()).backward()
        model.eval()
        finish()

    forward = {
        "image backbone": lambda: model.embed(image),
        "radar alone": lambda: model(x),
        "radar and fusion, embedded image": lambda: model(x, features),
        "whole model": lambda: model(x, model.embed(image)),
    }
    calls = {k: functools.partial(no_gradient, v) for k, v in forward.items()}
    calls["gradient from images"] = lambda: gradient(lambda: model.embed(image))
    calls["gradient from embedded images"] = lambda: gradient(lambda: features)
    return model, calls


def rivals_of(variant, dtype, projection, image, reference, variables):
    """The torch calls, empty without torch or for another model than its own."""
    if torch is None or variant != "rcw":
        print("no torch column:", "not installed" if torch is None else "rcw only")
        return {}
    model, calls = torch_model(variant, dtype, projection, image, reference)
    numbers = [sum(x.numel() for x in model.parameters())]
    numbers.append(sum(x.size for x in jax.tree.leaves(variables["params"])))
    print("parameters, torch and ours: {:,} and {:,}".format(*numbers))
    return calls


def model_rows(variant, dtype, batch, repeats):
    model, variables, projection, image, features, reference = model_and_inputs(
        variant, dtype, batch
    )
    rivals = rivals_of(variant, dtype, projection, image, reference, variables)

    def embed(variables, image):
        return model.apply(variables, image, method="embed")

    parts = {
        "image backbone": compiled(embed, variables, image),
        "radar alone": compiled(model.apply, variables, projection),
        "radar and fusion, embedded image": compiled(
            model.apply, variables, projection, features, reference
        ),
        "whole model": compiled(model.apply, variables, projection, image, reference),
    }
    for name, (call, memory) in parts.items():
        calls = {"ours": call} | ({"torch": rivals[name]} if rivals else {})
        yield row(name, batch, measure(calls, repeats), memory)


def training_rows(variant, dtype, batch, repeats):
    """Gradient of all that is trained, from images and from embedded images."""
    model, variables, projection, image, features, reference = model_and_inputs(
        variant, dtype, batch
    )
    params, frozen = split_parameters(variables["params"], model.is_frozen)
    stats = {k: v for k, v in variables.items() if k != "params"}

    def loss(params, frozen, image):
        maps, _ = model.apply(
            {"params": merge_parameters(params, frozen), **stats},
            projection,
            image,
            reference,
            train=True,
            rngs={"dropout": jax.random.key(0)},
            mutable=list(stats),
        )
        return (
            jnp.square(maps.heatmap_logits).mean() + jnp.square(maps.box_params).mean()
        )

    rivals = rivals_of(variant, dtype, projection, image, reference, variables)
    for name, given in (("images", image), ("embedded images", features)):
        call, memory = compiled(jax.grad(loss), params, frozen, given)
        name = f"gradient from {name}"
        calls = {"ours": call} | ({"torch": rivals[name]} if rivals else {})
        yield row(name, batch, measure(calls, repeats), memory)


def row(name, batch, times, memory):
    wall, processor = times["ours"]
    cells = [name, batch, 1e3 * wall / batch, processor, memory]
    if "torch" in times:
        torch_wall, torch_processor = times["torch"]
        cells += [1e3 * torch_wall / batch, torch_processor, torch_wall / wall]
        cells.append(torch_processor / processor)
    print(*(x if isinstance(x, str | int) else f"{x:.2f}" for x in cells), flush=True)
    return cells


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--parts", nargs="+", default=["attention", "model"], help="and training"
    )
    parser.add_argument("--variant", default="rcw", help="of configs/dinorade.py")
    parser.add_argument("--dtype", default="float32")
    parser.add_argument("--batch", nargs="+", type=int, default=[1])
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    rows = []
    for batch in args.batch:
        if "attention" in args.parts:
            rows += attention_rows(batch, args.repeats)
        if "model" in args.parts:
            rows += model_rows(args.variant, args.dtype, batch, args.repeats)
        if "training" in args.parts:
            rows += training_rows(args.variant, args.dtype, batch, args.repeats)
    names = ["part", "batch", "ms a frame", "CPU s", "MiB", "torch ms", "torch CPU s"]
    names += ["times faster", "in CPU s"]
    print(f"{jax.devices()[0].device_kind}, {args.variant}, {args.dtype}")
    print(tabulate(rows, names, floatfmt=".2f"))
    print(f"a plain matrix product here: {matrix_rate():.0f} GFLOP/s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory of this process: {peak:.2f} GiB")


if __name__ == "__main__":
    main()
