"""docs/reproduce.md agrees with published.csv, the configs and benchmarks/programs.py."""

import pathlib
import re
import types

import jax
import numpy as np
import pytest

from radejax.config import load_config, load_module
from radejax.evaluation.report import PUBLISHED, PublishedRow
from radejax.geometry.radar_grid import RadarGrid

from . import small_models

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reproduce.md").read_text(encoding="utf-8")
NUM_FRAMES = 34_994


def _table(title: str) -> list[list[str]]:
    """Cells of the table after a heading, without its own head."""
    part = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    return [line.strip("|").split("|") for line in lines[2:]]


ROWS = [[cell.strip() for cell in row] for row in _table("Rows")]
TRAINABLE = [row for row in PUBLISHED if row.config != "not trainable here"]


def _aps(row: PublishedRow) -> str:
    """The row's AP 3D and BEV as the page has them: the mean, or else Sedan."""
    is_mean = ("all", "mean", "3d", 0.3) in row.values
    cls = "mean" if is_mean else "Sedan"
    pair = [row.values.get(("all", cls, space, 0.3), "-") for space in ("3d", "bev")]
    return " / ".join(pair) + " (mean)" * is_mean


def test_the_page_has_every_trainable_row_with_its_config_and_aps() -> None:
    assert len(ROWS) == len(TRAINABLE) == 18
    for published, row in zip(TRAINABLE, ROWS, strict=True):
        assert row[0] == published.source.replace(", Table", "")
        # Of a longer list of components, the page has the last one.
        assert published.method.endswith(row[1].removeprefix("... "))
        assert row[2] == f"`{published.config}`"
        assert row[3] == _aps(published)


def test_labels_come_from_where_the_page_says() -> None:
    for version in ("v1_1", "v2_1"):
        name = f"kradar_revised_label_{version}.zip"
        assert f"`labels/revise_label/{name}`" in PAGE
        trained = re.findall(rf"--config (\S+) .*--labels {name}", PAGE)
        assert trained
        for config in trained:
            label_version = load_config(config).data.label_version
            assert label_version == version.replace("_", ".")


def test_the_page_is_short_and_in_the_navigation() -> None:
    text = re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL)
    prose = [line for line in text.splitlines() if not line.startswith("|")]
    assert len(" ".join(prose).split()) <= 450
    assert "reproduce.md" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "(reproduce.md)" in (ROOT / "docs" / "training.md").read_text("utf-8")


@pytest.mark.parametrize("name", ["radenet", "dinorade"])
def test_the_page_names_what_the_configs_change(name: str) -> None:
    paper, default, official = (
        dict(load_config(config).fields())
        for config in (f"{name}:paper", name, f"{name}:official")
    )
    changed = {field for field, value in default.items() if paper[field] != value}
    changed.discard("data.camera.radar_from_lidar_z_m")  # by default that of the data
    assert changed == {"model.cbam", "loss.assignment", "decode.raw_yaw"}
    assert (
        "attention\n  block, the bins of the regression losses and the yaw in NMS"
        in PAGE
    )
    changed = {field for field in paper if official[field] != paper[field]}
    assert {"train.schedule", "data.azimuth_mapping"} <= changed
    assert ("train.num_epochs" in changed) == (name == "radenet")
    assert "in the schedule, epochs and azimuth axis" in PAGE


def test_disk_sizes() -> None:
    grid, image = RadarGrid.kradar(), load_config("dinorade").model.image
    records = NUM_FRAMES * np.prod(grid.projection_shape)
    tokens = np.prod([side // image.patch_size for side in image.size])
    embeddings = NUM_FRAMES * tokens * image.hidden_size
    assert f"{2 * records / 1e9:.0f} GB of `float16` records" in PAGE
    assert f"({records / 1e9:.0f} GB as `uint8`)" in PAGE
    assert f"{2 * embeddings / 1e9:.0f} GB of\n" in PAGE
    for row in ROWS:
        config = row[2].strip("`")
        needs_images = config.startswith("dinorade") and config != "dinorade:r"
        assert (load_config(config).model.name == "dinorade") == needs_images


@pytest.fixture(scope="module")
def programs() -> types.ModuleType:
    return load_module(ROOT / "benchmarks" / "programs.py")


@pytest.mark.slow
@pytest.mark.parametrize("name", dict.fromkeys(row[2].strip("`") for row in ROWS))
def test_lower_bounds_are_those_that_the_program_computes(
    programs: types.ModuleType, name: str
) -> None:
    computed = programs.bounds_text(load_config(name))
    assert {row[5] for row in ROWS if row[2] == f"`{name}`"} == {computed}


def test_lower_bounds_of_a_small_training(programs: types.ModuleType) -> None:
    grid, config = small_models.small_grid(), small_models.radar_config()
    config = config.replace(train={"batch_size": 2, "num_epochs": 1})
    hours, size = programs.least_training(config, grid)
    config = config.replace(train={"num_epochs": 3})
    assert programs.least_training(config, grid) == (pytest.approx(3 * hours), size)
    config = config.replace(train={"batch_size": 4})
    _, larger = programs.least_training(config, grid)
    _, (state, *_) = programs.train_step(config, grid, 2)
    count = sum(x.size for x in jax.tree.leaves(state.params))
    # Parameters, gradient and two moments, and twice the maps of two frames.
    assert size - (larger - size) == pytest.approx(4 * 4 * count / 1e9, rel=1e-3)
