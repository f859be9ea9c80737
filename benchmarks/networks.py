"""Benchmarks of the networks, compared with the same networks in PyTorch with the same weights.

Weights and inputs are random and have full size: projections of 256 x 107 x 101, images of
720 x 1280 pixels.
"""

import functools
import pathlib
import time

import inputs
import jax
import jax.numpy as jnp
import numpy as np
import stages
from case import Case, compiled, difference, first_call, timed, waiting
from rival import ATTENTION

from radejax import models
from radejax.config import load_config
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.deformable_attention import DeformableAttention
from radejax.models.lifting import ReferencePoints, reference_points
from radejax.models.vit import rotary_angles
from radejax.training.step import create_state, make_optimizer, make_train_step
from radejax.weights import convert, radenet_torch

CONFIGS = pathlib.Path(__file__).parents[1] / "configs"
GRID = RadarGrid.kradar()

TOLERANCES = {"float32": 1e-3, "tf32": 0.05, "bfloat16": 0.2}

FORWARD = [("bfloat16", 8), ("tf32", 8), ("bfloat16", 1), ("float32", 8)]
TRAINING = [("bfloat16", 8), ("tf32", 8), ("float32", 8)]
DETECTOR = [("bfloat16", 1), ("bfloat16", 8), ("tf32", 1), ("tf32", 8)]
COMPILED = {("bfloat16", 8), ("tf32", 8)}
"""Cases of RADE-Net's forward pass that are also measured with `torch.compile` on a GPU.

The others are measured without it, as compilation takes most of the time on a GPU.
"""


def settings(machine, name, those):
    """Returns the pairs of dtype and batch size of a row that are to be measured.

    On a CPU, this is float32 and one frame. `machine["batch"]` replaces the batch sizes, unless it
    is None. Pairs in `machine["measured"]` are left out, as compiling takes most of the time.
    """
    pairs = [("float32", 1)] if machine["platform"] == "cpu" else those
    if machine["batch"]:
        pairs = list(dict.fromkeys((dtype, machine["batch"]) for dtype, _ in pairs))
    return [pair for pair in pairs if (name, *pair) not in machine["measured"]]


# Weights and models ------------------------------------------------------------------


def random_variables(model, *arguments):
    shapes = jax.eval_shape(model.init, jax.random.key(0), *arguments)
    rng = np.random.default_rng(0)

    def draw(path, x):
        drawn = 0.05 * rng.standard_normal(x.shape, np.float32)
        return np.abs(drawn) + 0.1 if path[-1].key in ("var", "scale") else drawn

    return jax.tree_util.tree_map_with_path(draw, shapes)


def network(path, dtype, **fields):
    """Returns config, model and the precision of its matrix products; None is the default."""
    fields["dtype"] = "bfloat16" if dtype == "bfloat16" else "float32"
    config = load_config(str(CONFIGS / path)).replace(model=fields)
    precision = "highest" if dtype == "float32" else None
    return config, models.build(config.model), precision


def torch_state(model, variables):
    """Returns the variables as a state dict of `torch_dinorade.DinoRade`."""
    params = dict(variables["params"])
    rules = (
        *radenet_torch.neck_rules("image_fusion/radar_neck", "radar_neck.neck"),
        *radenet_torch.neck_rules("image_fusion/camera_neck", "camera_neck.neck"),
        *radenet_torch.rules(model.options.heads),
        (r"^image_backbone/layers/", "image_backbone.layers.{}."),
        (r"^image_fusion/", ""),
        (r"/", "."),
    )
    backbone, vit = params["image_backbone"], model.options.image
    size = vit.patch_size
    patches = dict(backbone["patch_embed"])
    patches["kernel"] = patches["kernel"].reshape(size, size, 3, -1)
    params["image_backbone"] = {**backbone, "patch_embed": patches}
    state = convert.to_torch(rules, {**variables, "params": params})
    for name in [n for n in state if n.endswith(".running_var")]:
        state[name.replace("running_var", "num_batches_tracked")] = np.array(0)
    rows, columns, channels = model.options.image.feature_shape
    angles = rotary_angles(rows, columns, channels // vit.num_heads)
    names = ("image_backbone.cos", "image_backbone.sin")
    return state | dict(zip(names, map(np.asarray, angles), strict=True))


# Parts of cases ----------------------------------------------------------------------


def rivals(machine, *arguments):
    return machine["rival"].columns(*arguments) if machine["rival"] else {}


def same_maps(machine, maps):
    """Returns the difference between the maps of radejax and torch, or None without torch."""
    if not machine["rival"]:
        return None
    ours = [np.moveaxis(np.asarray(x), -1, 1) for x in jax.tree.leaves(maps)]
    # The maps of torch include the padded azimuth bins.
    theirs = [x[..., : ours[0].shape[-1]] for x in machine["rival"].outputs()]
    return difference(ours, theirs)


def step_of(config, model, variables, batch, precision):
    """Returns a training step of radejax and the fields of a `Case` with its cost.

    The step keeps its state between calls. It takes a batch, by default the one given here, and
    returns its metrics.
    """
    optimizer = make_optimizer(config.train, lambda _: 1e-4)
    state = create_state(
        jax.tree.map(jnp.array, variables),
        optimizer,
        use_ema=False,
        model=model,
    )
    map_grid = models.map_grid(GRID, model, "true")
    step = make_train_step(model, optimizer, map_grid, loss=config.loss)
    given, rng = jax.device_put(batch), jax.random.key(0)
    program, cost = compiled(
        step, state, given, rng, precision=precision, donate_argnums=0
    )
    held = [state]

    def run(batch=given):
        held[0], metrics = program(held[0], batch, rng)
        return jax.block_until_ready(metrics)

    return run, cost


def torch_losses(config, model, batch):
    """Returns the arguments of `torch_losses.Losses` for the losses of `step_of`."""
    map_grid = models.map_grid(GRID, model, "true")
    bins = map_grid.nearest_bin(batch.boxes[..., 0], batch.boxes[..., 1])
    centers = map_grid.boxes_at(jnp.zeros(batch.boxes.shape), bins)[..., :2]
    targets = {"boxes": batch.boxes, "classes": batch.classes}
    targets |= {"bins": np.asarray(bins), "centers": np.asarray(centers)}
    return config.loss.to_dict(), targets, map_grid.num_azimuth


# Cases -------------------------------------------------------------------------------


def radenet(machine):
    """Forward pass of RADE-Net."""
    name = "RADE-Net, forward"
    for dtype, size in settings(machine, name, FORWARD):
        config, model, precision = network("radenet.py", dtype)
        x = inputs.frames_of(size).projection
        variables = random_variables(model, x)
        on_device = jax.device_put((variables, x))
        forward, cost = compiled(model.apply, *on_device, precision=precision)
        state = radenet_torch.save(model, variables)
        how = dtype, None, (dtype, size) in COMPILED
        columns = {"radejax": waiting(forward, *on_device)}
        columns |= rivals(machine, "radenet", config.model.to_dict(), state, x, *how)
        yield Case(
            name=name,
            columns=columns,
            frames=size,
            dtype=dtype,
            error=same_maps(machine, forward(*on_device)),
            tolerance=TOLERANCES[dtype],
            **cost,
        )


def radenet_training(machine):
    """Training step of RADE-Net, on an accelerator also with rematerialization."""
    name = "RADE-Net, training step"
    chosen = [(name, "none", *x) for x in settings(machine, name, TRAINING)]
    if machine["platform"] != "cpu":
        for remat in ("blocks", "full"):
            row = f"{name}, rematerialization: {remat}"
            chosen += [(row, remat, *x) for x in settings(machine, row, TRAINING[:1])]
    for row, remat, dtype, size in chosen:
        config, model, precision = network("radenet.py", dtype, remat=remat)
        batch = inputs.frames_of(size)
        variables = random_variables(model, batch.projection)
        step, cost = step_of(config, model, variables, batch, precision)
        columns, error = {"radejax": functools.partial(timed, step)}, None
        if machine["rival"] and remat == "none":
            state = radenet_torch.save(model, variables)
            how = dtype, torch_losses(config, model, batch), False
            given = config.model.to_dict(), state, batch.projection
            columns |= rivals(machine, "radenet", *given, *how)
            ours = [np.asarray(step()["weighted_sum"])]
            error = difference(ours, machine["rival"].outputs())
        yield Case(
            name=row,
            columns=columns,
            frames=size,
            dtype=dtype,
            error=error,
            tolerance=TOLERANCES[dtype],
            **cost,
        )


def feeding(machine):
    """Training steps of RADE-Net with batches from the loader, by number of threads."""
    dtype, size = ("float32", 1) if machine["platform"] == "cpu" else ("bfloat16", 8)
    config, model, precision = network("radenet.py", dtype)
    with inputs.folder_of_records(32, GRID, "float16") as records:
        table = make_table(records, inputs.labeled(records), max_objects=8)
        first = next(make_loader(table, LoaderOptions(size)))
        variables = random_variables(model, np.asarray(first.projection))
        step, cost = step_of(config, model, variables, first, precision)
        # On a CPU, steps take so long that one thread is enough.
        counts = inputs.thread_counts()
        for num_threads in counts[:1] if machine["platform"] == "cpu" else counts:
            batches = make_loader(table, LoaderOptions(size, num_threads=num_threads))
            column, note = fed(step, batches)
            yield Case(
                name=f"RADE-Net, training step fed by the loader, threads: {num_threads}",
                columns={"radejax": column},
                frames=size,
                dtype=dtype,
                note=note,
                **cost,
            )


def fed(step, batches):
    """Returns a column that trains on a batch, and a note with the share of waiting."""
    spent = []

    def run():
        began = time.perf_counter()
        batch = next(batches)
        spent.append((time.perf_counter() - began, began))
        step(jax.device_put(batch))
        spent[-1] = spent[-1][0], time.perf_counter() - began

    def note():
        waits, walls = zip(*spent[1:], strict=True)  # the first fills the queue
        return f"waits for data: {sum(waits) / sum(walls):.2%}"

    return functools.partial(timed, run), note


def dinorade(machine, task="forward"):
    """DinoRADE from image and projection: forward pass or training step."""
    name, those = f"DinoRADE, {task}", FORWARD if task == "forward" else TRAINING
    for dtype, size in settings(machine, name, those):
        config, model, precision = network("dinorade.py", dtype)
        places, camera = camera_of(model, size)
        rng = np.random.default_rng(0)
        image = rng.integers(0, 256, (size, *model.options.image.size, 3), np.uint8)
        batch = inputs.frames_of(size, image=image, camera=camera)
        arguments = batch.projection, image, camera
        variables = random_variables(model, *arguments)
        losses = None
        if task == "forward":
            on_device = jax.device_put((variables, *arguments))
            program, cost = compiled(model.apply, *on_device, precision=precision)
            run = waiting(program, *on_device)
        else:
            step, cost = step_of(config, model, variables, batch, precision)
            run = functools.partial(timed, step)
            losses = torch_losses(config, model, batch)
        others = rivals(
            machine,
            "dinorade",
            config.model.to_dict(),
            torch_state(model, variables),
            places,
            batch.projection,
            image,
            dtype,
            losses,
            False,
        )
        # Training steps are not compared, as dropout is random.
        is_same = task == "forward"
        yield Case(
            name=name,
            columns={"radejax": run} | others,
            frames=size,
            dtype=dtype,
            error=same_maps(machine, program(*on_device)) if is_same else None,
            tolerance=TOLERANCES[dtype],
            **cost,
        )


def camera_of(model, size):
    """Returns K-Radar's reference points `[R * A, E, 2]`, and the same for every frame of a batch.

    All queries count as in view, as in the PyTorch network.
    """
    places = reference_points_of(model)
    every = np.broadcast_to(places, (size, *places.shape[1:]))
    camera = ReferencePoints(every, np.ones(every.shape[:-1], bool))
    return places.reshape(256 * 112, -1, 2), camera


def reference_points_of(model):
    """Returns the reference points `[R, A, E, 2]` of K-Radar's sensors on the padded bins."""
    options, camera = model.options, inputs.CALIBRATION.camera()
    places = reference_points(
        camera, options.query_grid, 256, 112, options.fusion.num_elevation
    )
    return np.asarray(places.points, np.float32)


def attention(machine):
    """Deformable attention of 286,720 queries on a camera map of 180 x 320."""
    width, heads, points = ATTENTION
    bins, elevation = 256 * 112, 10
    rng = np.random.default_rng(0)
    sizes = {
        "sampling_offsets": 2 * heads * points,
        "attention_weights": heads * points,
        "value_proj": width,
        "output_proj": width,
    }
    normal = functools.partial(rng.standard_normal, dtype=np.float32)
    params = {
        name: {"kernel": 0.1 * normal((width, n)), "bias": normal(n)}
        for name, n in sizes.items()
    }
    state = {f"{k}.weight": v["kernel"].T for k, v in params.items()}
    state |= {f"{k}.bias": v["bias"] for k, v in params.items()}
    _, model, _ = network("dinorade.py", "float32")
    places = reference_points_of(model).reshape(1, bins, elevation, 2)
    scale = np.exp(normal((1, bins, elevation)))
    given = (
        normal((1, bins, width)),
        scale / scale.sum(-1, keepdims=True),
        places,
        normal((1, 180, 320, width)),
    )

    def ours(params, feature, scale, places, value):
        module = DeformableAttention(*ATTENTION)
        mean = jnp.full(places.shape[:-1], 1 / elevation)
        return module.apply({"params": params}, feature, scale, places, mean, value)

    arrays = jax.device_put((params, *given))
    program, cost = compiled(ours, *arrays, precision="highest")
    others = rivals(machine, "attention", state, *given)
    error = None
    if others:
        error = difference([np.asarray(program(*arrays))], machine["rival"].outputs())
    yield Case(
        name="deformable attention, forward",
        columns={"radejax": waiting(program, *arrays)} | others,
        error=error,
        **cost,
    )


def detector(machine):
    """Tesseracts in host memory to boxes, compared with the steps of the authors' code."""
    name = "radar tensor to boxes"
    for dtype, size in settings(machine, name, DETECTOR):
        config, model, _ = network("radenet.py", dtype)
        found = stages.untrained(config, dtype=config.model.dtype)
        sized = found.replace(batch_sizes=(size,))
        rng = np.random.default_rng(0)
        frames = rng.standard_exponential((size, *GRID.shape_drea), np.float32)
        frames *= 1e9
        columns = {"radejax": waiting(sized, frames)}
        cost = first_call(columns["radejax"])
        if machine["rival"]:
            variables = jax.tree.map(np.asarray, found.variables)
            state = radenet_torch.save(model, variables)
            x = inputs.frames_of(size).projection
            how = dtype, None, False
            (theirs,) = rivals(
                machine, "radenet", config.model.to_dict(), state, x, *how
            ).values()
            columns["authors' chain"] = functools.partial(
                released_chain, frames, theirs, inputs.peaks_on_host(40)
            )
        yield Case(
            name=name,
            columns=columns,
            frames=size,
            dtype=dtype,
            note="authors' chain: formula of all bins, torch, loops over 40 peaks",
            **cost,
        )


def released_chain(frames, network, maps):
    """Returns total wall and CPU seconds of projection, network and loops over peaks."""
    parts = [
        timed(lambda: [inputs.project_released(frame) for frame in frames]),
        network(),
        timed(lambda: [inputs.loop_decode(*maps) for _ in frames]),
    ]
    return tuple(map(sum, zip(*parts, strict=True)))
