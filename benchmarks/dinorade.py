"""Times of DinoRADE and its parts at full size, beside plain torch where it is at hand.

    python benchmarks/dinorade.py                      # everything, float32, batch 1
    python benchmarks/dinorade.py --parts attention    # deformable attention alone
    python benchmarks/dinorade.py --parts training     # gradient, embedded images too
    python benchmarks/dinorade.py --dtype bfloat16 --batch 1 6

256 x 112 x 10 queries, 720 x 1280 images, 180 x 320 x 128 camera map. Weights and inputs
are random. Rivals of one row run in turns within one process, and the fastest of the
repetitions counts, so that a busy machine hurts both alike; "CPU s" is the processor
time of all threads, which it hurts least. The torch column is the sampling in its
pure-torch form (`grid_sample`), as the released code runs where its CUDA operator was
not built. Memory is what the compiled program needs beside inputs and outputs.
"""

import argparse
import importlib.util
import pathlib
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np
from tabulate import tabulate

from radejax.geometry.camera import CameraCalibration
from radejax.models import build
from radejax.models.deformable_attention import DeformableAttention
from radejax.models.lifting import static_reference_points
from radejax.training.state import merge_parameters, split_parameters

try:
    import torch
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


def full_size_model(variant, dtype):
    path = pathlib.Path(__file__).parents[1] / "configs" / "dinorade.py"
    spec = importlib.util.spec_from_file_location("dinorade_config", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    config = module.get_config(variant)
    config.model.dtype = dtype
    return build(config.model)


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


def torch_attention(params, feature, scale, points, value):
    """All queries through the linear layers, `grid_sample`, projection, then the mean."""
    functional = torch.nn.functional
    batch = feature.shape[0]

    def linear(name, x):
        return x @ params[name]["kernel"] + params[name]["bias"]

    query = (scale[..., None] * feature[:, :, None]).reshape(batch, -1, WIDTH)
    values = linear("value_proj", value.reshape(batch, -1, WIDTH))
    values = values.reshape(batch, -1, HEADS, WIDTH // HEADS)
    shape = (batch, query.shape[1], HEADS, POINTS)
    offsets = linear("sampling_offsets", query).reshape(*shape, 2)
    weights = linear("attention_weights", query).reshape(shape).softmax(-1)
    step = torch.tensor([MAP[1], MAP[0]], device=feature.device)
    centers = points.reshape(1, -1, 1, 1, 2)
    places = 2 * (centers + offsets / step) - 1
    grid = places.transpose(1, 2).reshape(batch * HEADS, -1, POINTS, 2)
    maps = values.permute(0, 2, 3, 1).reshape(batch * HEADS, -1, *MAP)
    samples = functional.grid_sample(
        maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False
    )  # [B heads, D, Q, P]
    weights = weights.transpose(1, 2).reshape(batch * HEADS, 1, -1, POINTS)
    out = (samples * weights).sum(-1).reshape(batch, WIDTH, -1).transpose(1, 2)
    return linear("output_proj", out).reshape(batch, BINS, ELEVATION, -1).mean(2)


def torch_calls(inputs):
    device = "cuda" if torch.cuda.is_available() else "cpu"
    leaves, tree = jax.tree.flatten(inputs)
    leaves = [torch.from_numpy(np.array(x)).to(device) for x in leaves]
    trained = [i for i, x in enumerate(leaves) if x.shape[-1] != 2]

    def finish():
        if device == "cuda":
            torch.cuda.synchronize()

    def forward():
        with torch.no_grad():
            out = torch_attention(*jax.tree.unflatten(tree, leaves))
        finish()
        return out

    def gradient():
        for i in trained:
            leaves[i].requires_grad_(True)
            leaves[i].grad = None
        torch_attention(*jax.tree.unflatten(tree, leaves)).square().sum().backward()
        for i in trained:
            leaves[i].requires_grad_(False)
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


def model_rows(variant, dtype, batch, repeats):
    model, variables, projection, image, features, reference = model_and_inputs(
        variant, dtype, batch
    )

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
        yield row(name, batch, measure({"ours": call}, repeats), memory)


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

    calls, memories = {}, {}
    for name, given in (("images", image), ("embedded images", features)):
        calls[name], memories[name] = compiled(jax.grad(loss), params, frozen, given)
    times = measure(calls, repeats)
    for name, time_of in times.items():
        yield row(f"gradient from {name}", batch, {"ours": time_of}, memories[name])


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
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory of this process: {peak:.2f} GiB")


if __name__ == "__main__":
    main()
