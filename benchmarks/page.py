"""Writes tables into `docs/reports/benchmarks.md` from JSON in `docs/reports/benchmarks/`."""

import json
import pathlib
import re

ROOT = pathlib.Path(__file__).resolve().parents[1]
RESULTS, PAGE = (
    ROOT / "docs" / "reports" / "benchmarks",
    ROOT / "docs" / "reports" / "benchmarks.md",
)
FURTHER = "further cases of "
BEGIN, END = "<!-- tables: benchmarks/run.py -->", "<!-- end of tables -->"


def path_of(device, folder):
    """Returns the JSON file of a device."""
    name = re.sub(r"[^a-z0-9]+", "_", device.lower()).strip("_")
    return folder / f"{name}.json"


def stored(device, folder):
    """Returns the runs in the file of a device."""
    path = path_of(device, folder)
    return json.loads(path.read_text())["runs"] if path.is_file() else []


def key(row):
    """Name, dtype and frames of a row, as in `Case.key`."""
    return row["name"], row.get("dtype"), row.get("frames")


def measured(facts, folder):
    """Returns the keys of rows, and the complete benchmarks, of earlier runs like this one.

    They are on the same device, with the same versions of radejax and the other packages.
    """
    runs = stored(facts["device"], folder)
    same = [run for run in runs if run["versions"] == facts["versions"]]
    rows = [row for run in same for row in run["rows"]]
    begun = {name for run in same for name in run["not_run"]}
    begun |= {FURTHER + row["benchmark"] for row in rows if "refused" in row}
    names = {row["benchmark"] for row in rows}
    complete = {name for name in names if FURTHER + name not in begun}
    return {key(row) for row in rows if "refused" not in row}, complete


def store(run, folder):
    """Writes a run into the file of its device.

    It replaces earlier rows of its benchmarks, except those of the same versions that it did not
    repeat.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs = stored(run["device"], folder)
    new = {row["benchmark"] for row in run["rows"]}
    repeated = {key(row) for row in run["rows"]}
    finished = {*run["complete"], *(FURTHER + name for name in run["complete"])}
    for old in runs:
        is_same = old["versions"] == run["versions"]
        old["rows"] = [
            row
            for row in old["rows"]
            if row["benchmark"] not in new
            or (is_same and key(row) not in repeated and "refused" not in row)
        ]
        old["not_run"] = [name for name in old["not_run"] if name not in finished]
    runs = [kept for kept in (*runs, run) if kept["rows"]]
    path = path_of(run["device"], folder)
    path.write_text(json.dumps({"runs": runs}, indent=1) + "\n")


def write_page():
    """Writes the tables of all JSON files between the two markers of the page."""
    results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    before, rest = PAGE.read_text().split(BEGIN)
    _, after = rest.split(END)
    tables = "".join(f"{table(result)}\n\n" for result in results)
    PAGE.write_text(f"{before}{BEGIN}\n\n{tables}{END}{after}")


def table(result):
    """Returns the Markdown of the tables of one JSON file."""
    if "tables" in result:
        return "\n\n".join(map(plain_table, result["tables"]))
    return devices_table(result["runs"]) if "runs" in result else programs_table(result)


def plain_table(content):
    """Returns the Markdown of a manually written table with title and text."""
    lines = [f"### {content['title']}", "", content["text"], ""]
    head, rows = content["columns"], content["rows"]
    lines += [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines)


def devices_table(runs):
    """Returns the Markdown of the measurements of one or several runs on one device."""
    lines = [
        f"### {runs[-1]['device']}",
        "",
        "| stage | dtype | frames | radejax, per frame | compared with, per frame | speedup | "
        "greatest difference | calls | memory | compilation | |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    rows = [(row, run["platform"]) for run in runs for row in run["rows"]]
    lines += [row_text(*row) for row in rows if "refused" not in row[0]]
    for row, _ in rows:
        if "refused" in row:
            lines += ["", f"Not measured: {row['name']}: {row['refused']}."]
    for run in runs:
        versions = ", ".join(f"{k} {v}" for k, v in run["versions"].items())
        names = dict.fromkeys(row["benchmark"] for row in run["rows"])
        lines += [
            "",
            f"`{run['command']}`, {run['date']}, Python {run['python']}, {versions}, "
            f"{run['minutes']} minutes, load at the end {run['load']:.1f}: "
            f"{', '.join(names)}.",
        ]
        if run["not_run"]:
            lines.append(f"Not run: {', '.join(run['not_run'])}.")
    return "\n".join(lines)


def row_text(row, where):
    """Returns a row of a device's table; on a CPU, it lists CPU times too and compares these."""
    is_cpu = where == "cpu"
    clock = row["processor_s" if is_cpu else "wall_s"]
    others = [name for name in clock if name != "radejax"]

    def cell(name):
        wall, processor = (
            duration(row[kind][name] / row["frames"])
            for kind in ("wall_s", "processor_s")
        )
        return f"{wall} ({processor})" if is_cpu else wall

    ratios = [
        f"{clock[name] / clock['radejax']:.2f}" if clock["radejax"] else "-"
        for name in others
    ]
    cells = [
        row["name"],
        row["dtype"],
        str(row["frames"]),
        cell("radejax"),
        "; ".join(f"{name} {cell(name)}" for name in others) or "-",
        "; ".join(ratios) or "-",
        "-" if row["error"] is None else f"{row['error']:.0e}",
        str(row["repeats"]),
        "-" if row["mib"] is None else f"{row['mib']:.0f} MiB",
        "-" if row.get("compile_s") is None else duration(row["compile_s"]),
        row["note"],
    ]
    return f"| {' | '.join(cells)} |"


def duration(seconds):
    """Formats a duration with three significant digits and a unit."""
    if seconds >= 1:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"


def programs_table(result):
    """Returns the Markdown of the results of `programs.py`."""
    devices = list(result["programs"][0]["least_ms_a_frame"])
    lines = [
        "### Programs, lowered for CUDA and not run",
        "",
        f"`{result['command']}`, {result['date']}, jax {result['jax']}, bfloat16. Bytes are "
        "only those of matrix products, convolutions, gathers and scatters. The least time "
        "is by published dense peaks.",
        "",
        "| program | batch | GFLOP per frame | MiB per frame | convolutions | products | loops | "
        f"other ops | {' | '.join(f'{d}, ms per frame at least' for d in devices)} |",
        f"|{'---|' * (8 + len(devices))}",
    ]
    for row in result["programs"]:
        cells = [row["program"], row["batch"]]
        cells += [f"{row[key]:.4g}" for key in ("gflop_a_frame", "mib_a_frame")]
        cells += [row[key] for key in ("convolutions", "products", "loops", "fusable")]
        cells += [f"{row['least_ms_a_frame'][d]:.3g}" for d in devices]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)
