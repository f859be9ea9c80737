"""The messages of docs/errors.md are those of the code."""

import ast
import functools
import pathlib
import re

import pytest

from radejax import config as configs
from radejax.config import Config
from radejax.core.errors import DataError, UserError
from radejax.data import cameras
from radejax.data.kradar import KRadar
from radejax.data.options import CameraOptions
from radejax.models import build
from radejax.weights import image_backbone

from . import small_models as small
from .data.conftest import GRID, write_kradar

ROOT = pathlib.Path(__file__).resolve().parents[1]
HOLE = re.compile(r"<[^>]*>")
LEAST = 4
"""Length from which a fixed part of a message must be in the source."""


def _messages():
    """Messages of the page, each on one line."""
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```text\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    return [" ".join(block.split()) for block in blocks]


MESSAGES = _messages()


# The source ---------------------------------------------------------------------------


def _fixed_parts(node):
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


def _texts(tree):
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


def _is_in_source(message):
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


def test_every_message_is_in_the_source():
    assert len(MESSAGES) > 30
    assert len(set(MESSAGES)) == len(MESSAGES)
    assert [message for message in MESSAGES if not _is_in_source(message)] == []


def test_a_changed_message_is_not_in_the_source():
    for message in MESSAGES:
        word = max(re.findall(r"\w+", HOLE.sub("", message)), key=len)
        assert not _is_in_source(message.replace(word, f"{word}ness")), message


# Provoked errors ----------------------------------------------------------------------


def _is_described(text):
    patterns = [".+".join(map(re.escape, HOLE.split(message))) for message in MESSAGES]
    return any(re.fullmatch(f"(.+: )?{pattern}", text) for pattern in patterns)


@functools.cache
def _dinorade():
    return build(configs.load_config("dinorade").model)


def _other_labels(folder):
    write_kradar(folder, sequences=(1,), num_frames=2)
    KRadar(folder, version="v1.0").summary()


def _other_sequences(folder):
    write_kradar(folder, sequences=(1,), num_frames=2)
    KRadar(folder, sequences=(1, 9))


def _no_images(folder):
    write_kradar(folder, sequences=(1,), num_frames=2)
    frames = KRadar(folder)
    found = cameras.camera_inputs(frames, small.IMAGE_SIZE, CameraOptions())
    cameras.require_images(frames, found)


PROVOKED = [
    lambda _: configs.check_bins(Config().model, GRID, "the data"),
    _other_sequences,
    _other_labels,
    _no_images,
    lambda _: image_backbone.load_image_backbone(None, _dinorade()),
]
"""Errors that no other test provokes."""


@pytest.mark.parametrize("provoke", PROVOKED)
def test_the_page_has_the_text_of_the_error(provoke, tmp_path):
    with pytest.raises((UserError, DataError)) as caught:
        provoke(tmp_path)
    assert _is_described(str(caught.value)), str(caught.value)
