"""Acceptance on an accelerator: what tests on CPUs cannot show.

    python benchmarks/accept.py                     # all parts
    python benchmarks/accept.py --only boxes        # some
    python benchmarks/accept.py --minutes 3         # no part begins later; again: the rest
    python benchmarks/accept.py --short             # small models and few steps, as a test

Each part is stored when it ends, in `docs/reports/benchmarks/accept_DEVICE.json` and the tables of
`docs/reports/benchmarks.md`. What is stored with the same versions is skipped, unless `--again` is
given. Data and runs are written to `runs/accept`.
"""

import argparse
import functools
import json
import os
import pathlib
import shutil
import sys
import time
import traceback
from importlib import metadata

import page
import run  # before jax: JAX shall not reserve memory that trainings in other processes need
import start

# isort: split
import jax
import numpy as np
import stages
from case import difference, timed, waiting

import radejax
from radejax.data.cameras import no_images
from radejax.inference.export import export
from radejax.inference.exported_loader import load
from radejax.models.vit import ViT
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.weights import dinov3_hf

CORES = len(os.sched_getaffinity(0))
DEMO = pathlib.Path(radejax.__file__).parent / "cli" / "demo_model"

# Parts: each takes an empty folder and whether models and steps are small, and returns the header
# and the rows of a table.


def environment(folder, is_short):
    """Device, memory and versions."""
    device = jax.devices()[0]
    limit = (device.memory_stats() or {}).get("bytes_limit")
    packages = ("jax", "jaxlib", "flax", "optax", "grain", "numpy")
    rows = [
        ["devices", f"{jax.device_count()} x {device.device_kind}"],
        ["memory of a device", f"{limit / 2**30:.0f} GiB" if limit else "-"],
        ["its runtime", device.client.platform_version.partition("\n")[0]],
        ["CPU cores", str(CORES)],
        ["XLA_FLAGS", os.environ.get("XLA_FLAGS") or "-"],
        ["packages", ", ".join(f"{p} {metadata.version(p)}" for p in packages)],
    ]
    return ["", ""], rows


def quickstart(folder, is_short):
    """The quickstart from nothing, and the AP of its seeds on CPUs (docs/results.md)."""
    config = "quickstart:short" if is_short else "quickstart"
    first, whole = train(folder, config, "--data", folder / "data")
    metrics = json.loads((folder / "run" / "evaluation" / "metrics.json").read_text())
    wanted = {"space": "bev", "iou": 0.3, "protocol": "all_point", "condition": "all"}
    found = {row["cls"]: row for row in metrics["ap"] if wanted.items() <= row.items()}
    aps = ["-" if row["ap"] is None else f"{row['ap']:.1f}" for row in found.values()]
    rows = [["here", f"{first:.0f} s", f"{whole:.0f} s", *aps]]
    for line in (page.ROOT / "docs" / "results.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if line.startswith("| quickstart") and cells[1] == "0, 1, 2":
            rows.append([f"{cells[0]}, seeds {cells[1]}", "-", "-", *cells[2:8]])
    return ["", "to the first step", "to the report", *found], rows


def steps(model, folder, is_short):
    """Training steps from records, and images for DinoRADE, through the loader."""
    if is_short:  # the training simulates its data
        small = {
            "radenet": "quickstart:short",
            "dinorade": "quickstart_fusion:pretrained,short",
        }
        config, size, count, dtype = small[model], 2, 6, "float32"
        data = folder / "data"
    else:
        config, size, count, dtype = model, 8, 90, "bfloat16"
        counts = {"train_sequences": 8, "test_sequences": 0, "frames_per_sequence": 4}
        scenes = SimulationOptions(**FULL_SIZE, output="projection", **counts)
        data = radejax.simulate(scenes, folder.parent / "data", num_workers=CORES)
    words = ["--data", data, f"--config.model.dtype={dtype}"]
    if model == "dinorade":  # random weights, as DINOv3's have to be downloaded
        detector = stages.untrained(radejax.load_config(config))
        weights = detector.variables["params"]["image_backbone"]
        vit = ViT(detector.model.options.image)
        dinov3_hf.save(vit, weights, folder / "backbone")
        words += ["--image-backbone", folder / "backbone"]
    fields = {"batch_size": size, "num_epochs": count, "max_steps": count}
    fields |= {"warmup_steps": 0, "log_every_steps": count // 3}
    words += [f"--config.train.{name}={value}" for name, value in fields.items()]
    first, _ = train(folder, config, *words)
    lines = (folder / "run" / "metrics.jsonl").read_text().splitlines()
    logged = [row for row in map(json.loads, lines) if "frames_per_s" in row]
    rows = [
        [
            f"to {row['step']}",
            f"{1000 / row['frames_per_s']:.2f} ms",
            f"{row['data_wait_share']:.1%}",
        ]
        for row in logged
    ]
    text = f"{config}, {dtype}, batches of {size}"
    rows.append([f"start of {text}, to the end of step 1", f"{first:.0f} s", "-"])
    return ["steps", "per frame", "waits for data"], rows


def boxes(folder, is_short):
    """Random radar tensors in host memory to boxes, by `Detector` with random weights."""
    dtype, rows = "float32" if is_short else "bfloat16", []
    small, full = ("quickstart", "quickstart_fusion"), ("radenet", "dinorade")
    for name in small if is_short else full:
        config = radejax.load_config(name)
        found = stages.untrained(config, dtype=dtype, batch_sizes=(1,))
        rng = np.random.default_rng(0)
        shape = (4, 1, *found.grid.shape_drea)
        tensors = rng.standard_exponential(shape, np.float32) * np.float32(1e9)
        model = found.model.options
        camera = no_images(1, model.image.size) if found.takes_camera else ()
        items = [(tensor, *camera) if camera else tensor for tensor in tensors]
        call = waiting(found, tensors[0], *camera)
        first, *later = [call()[0] for _ in range(6)]
        stream, _ = timed(lambda found=found, items=items: list(found.stream(items)))
        times = f"{1e3 * np.median(later):.1f} ms", f"{1e3 * stream / 4:.1f} ms"
        rows.append([f"{name}, {dtype}", f"{first:.1f} s", *times])
    return ["", "first call", "a call", "per frame of a stream"], rows


def exports(folder, is_short):
    """Boxes of the bundled model on simulated frames, and their differences from the first row."""
    scenes = SimulationOptions(
        seed=1000,
        train_sequences=0,
        test_sequences=8,
        frames_per_sequence=1,
        image_width=0,
        image_height=0,
    )
    frames = radejax.KRadar([radejax.simulate(scenes, folder / "data")])
    x = np.stack([frame.read_projection(frames.grid) for frame in frames])
    make = functools.partial(
        radejax.Detector, radejax.load_model(DEMO), batch_sizes=(8,)
    )
    found = {"Detector": vars(make()(x))}  # on a GPU, products are TF32
    export(make(), folder / "model")
    found["StableHLO, exported here"] = load(folder / "model")(x)
    with jax.default_matmul_precision("highest"):
        found["Detector, products in full float32"] = vars(make()(x))
    cpu = jax.sharding.SingleDeviceSharding(jax.devices("cpu")[0])
    found["Detector on the CPU"] = vars(make(cpu)(x))
    wanted, rows = jax.tree.map(np.asarray, found["Detector"]), []
    for name, other in found.items():
        is_valid = np.asarray(other["is_valid"])
        cells = ["other boxes"] * 2
        if np.array_equal(is_valid, wanted["is_valid"]):
            cells = [
                f"{difference([np.asarray(other[key])[is_valid]], [wanted[key][is_valid]]):.0e}"
                for key in ("boxes", "scores")
            ]
        rows.append([name, str(is_valid.sum()), *cells])
    return ["", "boxes", "difference of boxes", "of scores"], rows


PARTS = {
    "environment": environment,
    "quickstart": quickstart,
    "radenet": functools.partial(steps, "radenet"),
    "dinorade": functools.partial(steps, "dinorade"),
    "boxes": boxes,
    "exports": exports,
}
"""Function by name, which `--only` selects."""


def train(folder, config, *words):
    """Trains in a process; returns seconds to the end of its first step and to its last line."""
    arguments = [page.ROOT / "train.py", "--config", config, *words]
    arguments = [str(x) for x in (*arguments, "--workdir", folder / "run")]
    texts = *start.FIRST_STEP, "Done in"
    (_, first, whole), _ = start.until(texts, arguments, folder, folder / "programs")
    return first, whole


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--again", action="store_true", help="also what is stored")
    parser.add_argument("--short", action="store_true", help="small models, few steps")
    parser.add_argument("--out", type=pathlib.Path, default=page.RESULTS)
    parser.add_argument(
        "--work", type=pathlib.Path, default=page.ROOT / "runs" / "accept"
    )
    given = parser.parse_args()
    began = time.perf_counter()
    device = jax.devices()[0]
    facts = run.facts({"device": device, "platform": device.platform, "rival": None})
    path = page.path_of(f"accept {facts['device']}", given.out)
    tables = json.loads(path.read_text())["tables"] if path.is_file() else []
    tables = {x["part"]: x for x in tables if x["versions"] == facts["versions"]}
    failed = []
    for name in given.only:
        if name in tables and not given.again:
            continue
        if time.perf_counter() - began > 60 * given.minutes:
            sys.stderr.write(f"no time for {name}: call this again\n")
            continue
        sys.stderr.write(f"{name}\n")
        folder = given.work.absolute() / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            columns, rows = PARTS[name](folder, given.short)
        except Exception:  # the exit code says so; others still run
            traceback.print_exc()
            failed.append(name)
            continue
        tables[name] = table_of(name, facts, columns, rows)
        given.out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"tables": list(tables.values())}, indent=1) + "\n")
        print(page.plain_table(tables[name]) + "\n", flush=True)
    if given.out == page.RESULTS:
        page.write_page()
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


def table_of(name, facts, columns, rows):
    """Returns what is stored of a part, as `page.plain_table` shows it."""
    versions = ", ".join(f"{k} {v}" for k, v in facts["versions"].items())
    doc = getattr(PARTS[name], "func", PARTS[name]).__doc__
    return {
        "part": name,
        "versions": facts["versions"],
        "title": f"Acceptance, {name}, {facts['device']}",
        "text": f"{doc} `{facts['command']}`, {facts['date']}, {versions}.",
        "columns": columns,
        "rows": rows,
    }


if __name__ == "__main__":
    main()
