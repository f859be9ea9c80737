"""The training loop of the guide, as it is."""

import own_loop
import pytest


@pytest.mark.slow
def test_the_loop_of_the_guide_trains(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    detector = own_loop.train(num_steps=31)
    losses = [
        float(line.partition("'focal': ")[2].partition(",")[0])
        for line in capsys.readouterr().out.splitlines()
        if "'focal'" in line
    ]
    assert len(losses) == 4
    assert losses[-1] < 0.7 * losses[0]
    assert detector.saved.grid.num_range > 0
