"""The messages of docs/errors.md are those of the code."""

import ast
import dataclasses
import errno
import functools
import json
import pathlib
import re
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from radejax import config as configs
from radejax.cli import entry
from radejax.config import Config
from radejax.core import devices, files
from radejax.core.errors import DataError, UserError
from radejax.core.manifest import Manifest
from radejax.core.options import find_function
from radejax.data import cameras, pipeline
from radejax.data.kradar import KRadar, reduced, tesseract, write
from radejax.data.options import CameraOptions
from radejax.evaluation import files as tables
from radejax.evaluation import results
from radejax.inference import exported_loader, inputs, saved
from radejax.models import build
from radejax.models.vit import ViT
from radejax.runs import data as run_data
from radejax.runs import experiment
from radejax.training.hooks import STEPS_IN_FLIGHT, CheckSkipped
from radejax.weights import dinov3_hf, image_backbone

from . import small_models as small
from .data.conftest import GRID, write_kradar

ROOT = pathlib.Path(__file__).resolve().parents[1]
HOLE = re.compile(r"<[^>]*>")
LEAST = 4
"""Length from which a fixed part of a message must be in the source."""


def _messages() -> list[str]:
    """Messages of the page, each on one line."""
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```text\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    return [" ".join(block.split()) for block in blocks]


MESSAGES = _messages()


# The source ---------------------------------------------------------------------------


def _fixed_parts(node: ast.expr) -> list[str] | None:
    """Fixed parts of a text between its values: of "a{x}b" and "a%sb" ["a", "b"]."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.split(r"%(?:\.\d+)?[dfgrs]", node.value.replace("%%", "%"))
    if not isinstance(node, ast.JoinedStr):
        return None
    parts = [""]
    for value in node.values:
        if isinstance(value, ast.Constant):
            parts[-1] += value.value
        else:
            parts.append("")
    return parts


def _texts(tree: ast.AST) -> Iterator[list[str]]:
    """Fixed parts of every text of a module, and of what `require` composes of some."""
    for node in ast.walk(tree):
        if isinstance(node, ast.expr) and (parts := _fixed_parts(node)):
            yield parts
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "require":
            name = _fixed_parts(node.args[1]) or ["", ""]
            yield [*name[:-1], name[-1] + " is ", ", expected ", ""]


TEXTS = {
    tuple(parts)
    for path in sorted((ROOT / "radejax").rglob("*.py"))
    for parts in _texts(ast.parse(path.read_text(encoding="utf-8")))
    if sum(map(len, parts)) >= LEAST
}


def _is_in_source(message: str) -> bool:
    """Whether texts of the source compose the message; a value may be another text."""
    if all(len(word) < LEAST for word in HOLE.split(message)):
        return True
    if message[0] in " ;:" and _is_in_source(message.lstrip(" ;:")):
        return True
    for parts in TEXTS:
        if all(part in message for part in parts):
            match = re.fullmatch("(.*?)".join(map(re.escape, parts)), message)
            values = match.groups() if match else (message,)
            if message not in values and all(map(_is_in_source, values)):
                return True
    return False


def test_every_message_is_in_the_source() -> None:
    assert len(MESSAGES) > 30
    assert len(set(MESSAGES)) == len(MESSAGES)
    assert [message for message in MESSAGES if not _is_in_source(message)] == []


@pytest.mark.parametrize("message", MESSAGES)
def test_a_changed_message_is_not_in_the_source(message: str) -> None:
    word = max(re.findall(r"\w+", HOLE.sub("", message)), key=len)
    assert not _is_in_source(message.replace(word, f"{word}ness"))


# Provoked errors ----------------------------------------------------------------------


def _is_described(text: str) -> bool:
    patterns = [".+".join(map(re.escape, HOLE.split(message))) for message in MESSAGES]
    return any(re.fullmatch(f"(.+: )?{pattern}", text) for pattern in patterns)


@functools.cache
def _dinorade() -> object:
    return build(configs.load_config("dinorade").model)


def _config_of_another_kind(folder: pathlib.Path) -> None:
    saved.save_model(small.saved(), folder)
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": "radejax-1"}))


def _exported(folder: pathlib.Path) -> None:
    _config_of_another_kind(folder)
    saved.load_model(folder)


def _program(folder: pathlib.Path) -> None:
    _config_of_another_kind(folder)
    exported_loader.read_folder(folder)


def _another_job(folder: pathlib.Path) -> None:
    Manifest.claim(folder, "records", {"dtype": "float16"})
    Manifest.claim(folder, "records", {"dtype": "uint8"})


def _another_run(folder: pathlib.Path) -> None:
    (folder / "checkpoints" / "1").mkdir(parents=True)
    for seed in (0, 1):
        with experiment.claimed(folder, Config(seed=seed)):
            pass


def _two_runs(folder: pathlib.Path) -> None:
    with experiment.claimed(folder, Config()), experiment.claimed(folder, Config()):
        pass


def _another_model(folder: pathlib.Path) -> None:
    saved.save_model(small.saved(model__heatmap_prior=0.25), folder)
    saved.starting_weights(small.radar_config().model, folder)


def _other_labels(folder: pathlib.Path) -> None:
    write_kradar(folder, sequences=(1,), num_frames=2)
    KRadar(folder, version="v1.0").summary()


def _other_sequences(folder: pathlib.Path) -> None:
    write_kradar(folder, sequences=(1,), num_frames=2)
    KRadar(folder, sequence_numbers=(1, 9))


def _no_labels(folder: pathlib.Path) -> None:
    write.write_description(folder / "1" / "description.txt", "urban", "day", "fog")
    KRadar(folder)


def _no_images(folder: pathlib.Path) -> None:
    write_kradar(folder, sequences=(1,), num_frames=2)
    frames = KRadar(folder)
    found = cameras.camera_inputs(frames, small.IMAGE_SIZE, CameraOptions())
    cameras.require_images(frames, found)


def _tensor(folder: pathlib.Path, power: float) -> None:
    path = folder / "tesseract_00001.mat"
    shape = GRID.shape_drea if power < 0 else (1, 2, 3, 4)
    write.write_tesseract(path, np.full(shape, power, np.float32))
    tesseract.read_frame(path, GRID)


def _predictions_only(folder: pathlib.Path) -> None:
    tables.load(folder / "found.json", tables.Source(), ("Sedan",))


def _not_finite(_: pathlib.Path) -> None:
    throughput = SimpleNamespace(frame=np.array([3]))
    hook = CheckSkipped(0, 100, throughput, [], 0, 0)
    metrics = {"skipped": np.array(1), "loss": np.array(np.nan)}
    for step in range(STEPS_IN_FLIGHT + 1):
        hook(step, None, metrics)


def _full_disk(folder: pathlib.Path) -> None:
    with files.disk_full(folder / "file"):
        raise OSError(errno.ENOSPC, "No space left on device")


PROVOKED: list[Callable[[pathlib.Path], object]] = [
    lambda _: configs.load_config("radnet"),
    lambda _: configs.load_config("radenet:papr"),
    lambda _: configs.with_texts(Config(), {"train.batchsize": "4"}),
    lambda _: Config(train={"batch_size": 0}),
    lambda _: find_function("gone:Reader", "config.data.format"),
    lambda _: configs.check_bins(Config().model, GRID, "the data"),
    lambda _: run_data.located(Config()),
    lambda _: run_data.located(Config(data={"roots": ("gone",)})),
    KRadar,
    _other_sequences,
    _no_labels,
    _other_labels,
    lambda folder: _tensor(folder, 1.0),
    lambda folder: _tensor(folder, -1.0),
    lambda _: reduced.check_release("polar3d", None, "ROOT"),
    _another_job,
    _no_images,
    lambda _: devices.check_batch_size(3, devices.make_mesh(2)),
    lambda _: pipeline.check_enough(3, 8),
    _another_run,
    _two_runs,
    lambda _: image_backbone.load_image_backbone(None, _dinorade()),
    lambda folder: image_backbone.load_image_backbone(folder, _dinorade()),
    _another_model,
    _not_finite,
    saved.load_model,
    lambda _: inputs.check_backbone(small.images(1), {"params": {}}),
    lambda _: small.detector()(np.zeros((2, 3))),
    _exported,
    _program,
    lambda _: results.sequence_weights(np.zeros(3), resamples=9),
    _predictions_only,
    _full_disk,
]


@pytest.mark.wrong_types
@pytest.mark.parametrize("provoke", PROVOKED)
def test_the_page_has_the_text_of_the_error(
    provoke: Callable[[pathlib.Path], object], tmp_path: pathlib.Path
) -> None:
    with pytest.raises((UserError, DataError, FileNotFoundError, ValueError)) as caught:
        provoke(tmp_path)
    assert _is_described(str(caught.value)), str(caught.value)


@pytest.mark.wrong_types
def test_the_page_has_the_text_of_another_backbone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = _dinorade()
    found = ViT(model.options.image.replace(num_registers=3))
    monkeypatch.setattr(dinov3_hf, "load", lambda path: (found, {"params": {}}))
    with pytest.raises(UserError) as caught:
        image_backbone.load_image_backbone("folder", model)
    assert _is_described(str(caught.value))


def test_the_page_has_the_text_of_an_absent_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def none() -> list[jax.Device]:
        raise RuntimeError("Unable to initialize backend 'cuda'")

    monkeypatch.setattr(jax, "devices", none)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(UserError) as caught:
        entry.set_up_jax()
    assert _is_described(str(caught.value))


def test_the_page_has_the_text_of_another_input(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model = dataclasses.replace(small.saved(), usual_input=(0.5, 0.1))
    assert not model.check_input(3.0, 0.2)
    assert _is_described(caplog.messages[-1])
