"""The blocks of docs/jax_for_pytorch.md run in order and print what the page says."""

import pathlib
import re

import pytest

PAGE = pathlib.Path(__file__).resolve().parents[1] / "docs" / "jax_for_pytorch.md"


@pytest.mark.slow
def test_the_blocks_run(capsys):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    assert len(blocks) >= 6
    exec("\n".join(blocks), {})
    shape, found, is_deleted, highest = capsys.readouterr().out.splitlines()
    assert shape == "(1, 64, 56, 8)"
    assert found == "(1, 100, 7) 0"  # no peaks in an empty frame, and as many rows
    assert is_deleted == "True"
    assert highest == "0.0"
