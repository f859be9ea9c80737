import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.visualize import animate
from radejax.visualize.style import PREDICTION, new_figure


def color_figure(color: str):
    figure = new_figure(0.5, 0.4, dpi=100)
    figure.set_facecolor(color)
    return figure


def test_gif_has_every_frame_in_order(tmp_path):
    colors = ["white", PREDICTION.color, "black"]
    path = animate.animate(
        (color_figure(c) for c in colors), tmp_path / "a.gif", frames_per_second=5
    )
    with Image.open(path) as gif:
        assert gif.n_frames == 3
        assert gif.info["duration"] == 200
        assert gif.info["loop"] == 0
        assert gif.size == (50, 40)
        seen = []
        for i in range(3):
            gif.seek(i)
            seen.append(gif.convert("RGB").getpixel((25, 20)))
    assert seen == [(255, 255, 255), (255, 77, 64), (0, 0, 0)]
    assert [p.name for p in tmp_path.iterdir()] == ["a.gif"]


def test_render_is_the_picture():
    pixels = animate.render(color_figure(PREDICTION.color))
    assert pixels.shape == (40, 50, 3)
    assert (pixels == [255, 77, 64]).all()


@pytest.mark.parametrize(
    ("frames", "name", "message"),
    [([], "a.gif", "no frames"), (["white"], "a.avi", r"\.gif or \.mp4")],
)
def test_wrong_use_is_named(tmp_path, frames, name, message):
    with pytest.raises(UserError, match=message):
        animate.animate(map(color_figure, frames), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_mp4_without_ffmpeg_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="ffmpeg"):
        animate.animate([color_figure("white")], tmp_path / "a.mp4")


def fake_ffmpeg(folder, script):
    program = folder / "ffmpeg"
    program.write_text("#!/bin/sh\n" + script)
    program.chmod(0o755)


def test_mp4_pipes_every_frame(tmp_path, monkeypatch):
    """A stand-in for ffmpeg keeps what it is given: arguments and raw frames."""
    (tmp_path / "bin").mkdir()
    fake_ffmpeg(
        tmp_path / "bin",
        f'echo "$@" > {tmp_path}/args; for last; do :; done; cat > "$last"\n',
    )
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:/usr/bin:/bin")
    colors = ["white", PREDICTION.color, "black"]
    frames = [color_figure(c) for c in colors]
    path = animate.animate(frames, tmp_path / "a.mp4", frames_per_second=12.5)
    raw = np.frombuffer(path.read_bytes(), np.uint8).reshape(3, 40, 50, 4)
    expected = [[255, 255, 255], [255, 77, 64], [0, 0, 0]]
    np.testing.assert_array_equal(raw[:, 20, 25, :3], expected)
    arguments = (tmp_path / "args").read_text()
    assert "-s 50x40" in arguments
    assert "-framerate 12.5" in arguments
    assert "yuv420p" in arguments


def test_failing_ffmpeg_is_quoted(tmp_path, monkeypatch):
    fake_ffmpeg(tmp_path, "echo Unknown encoder >&2; exit 1\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with pytest.raises(UserError, match="Unknown encoder"):
        animate.animate([color_figure("white")], tmp_path / "out" / "a.mp4")
    assert not list((tmp_path / "out").iterdir())
