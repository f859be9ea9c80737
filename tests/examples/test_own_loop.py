"""The training loop of the guide, as it is."""

import re

import own_loop
import pytest


@pytest.mark.slow
def test_the_loop_of_the_guide_trains(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    detector = own_loop.train(num_steps=31)
    numbers = re.findall(r"'focal': ([^,]*)", capsys.readouterr().out)
    losses = [*map(float, numbers)]
    assert len(losses) == 4
    assert losses[-1] < 0.7 * losses[0]
    assert detector.saved.grid.num_range > 0
