"""The tracker, its scores and the example as a whole."""

import pytest
import tracking


@pytest.mark.slow
def test_the_bundled_model_is_tracked(tmp_path):
    pytest.importorskip("trackeval")
    options = ["--out", str(tmp_path), "--num-sequences", "2", "--num-frames", "40"]
    tracking.main(options, standalone_mode=False)
    table = (tmp_path / "tracks.md").read_text().splitlines()
    name, *values = (x.strip() for x in table[-1].strip("|").split("|"))
    assert table[0].startswith("**Simulated data: ")
    assert name == "all"
    assert float(values[2]) > 30.0  # MOTA
    assert (tmp_path / "tracks.png").is_file()
