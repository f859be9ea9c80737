"""Logs that agree with the step a run starts from."""

import json
import pathlib
import sys

import numpy as np
import pytest

from radejax.core.errors import DiskFullError, UserError
from radejax.training import processes
from radejax.training.watch import Scores, Watch


def _steps(folder: pathlib.Path) -> list[int]:
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["step"] for line in lines]


def _watch(folder: pathlib.Path, start: int) -> Watch:
    return Watch(folder, start_step=start, num_steps=10, frames_per_step=4)


def test_records_after_the_restored_step_are_written_anew(
    tmp_path: pathlib.Path,
) -> None:
    with _watch(tmp_path, 0) as watch:
        for step in (2, 4, 6):
            watch.log(step, {"focal": float(step)}, epoch=step / 10)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 8, "foc')  # killed while writing
    with _watch(tmp_path, 4) as watch:
        assert _steps(tmp_path) == [2, 4]
        watch.log(6, {"focal": 60.0}, epoch=0.6)
    assert _steps(tmp_path) == [2, 4, 6]
    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["focal"] == 60.0
    assert last["frames_per_s"] > 0
    assert 0 <= last["data_wait_share"] <= 1


def test_other_processes_write_nothing(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "is_main", lambda: False)
    with _watch(tmp_path, 0) as watch:
        watch.log(1, {"focal": 1.0}, epoch=1.0)
    assert not list(tmp_path.iterdir())


FULL = pathlib.Path("/dev/full")  # every write to it is "no space left"
needs_full = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")


@needs_full
def test_metrics_on_a_full_disk_are_one_clear_error(tmp_path: pathlib.Path) -> None:
    with _watch(tmp_path, 0) as watch:
        (tmp_path / "metrics.jsonl").symlink_to(FULL)
        with pytest.raises(DiskFullError, match=r"write .*metrics.jsonl; .*intact"):
            watch.log(1, {"focal": 1.0}, epoch=1.0)


@needs_full
@pytest.mark.timeout(60)  # tensorboardX's own thread and queue would wait for ever
def test_tensorboard_on_a_full_disk_is_an_error_and_blocks_nothing(
    tmp_path: pathlib.Path,
) -> None:
    with _watch(tmp_path, 0) as watch:
        records = watch._logs[-1]._records
        records._writer.close()
        records._writer = FULL.open("wb")
        # More than what a buffer holds.
        values = {f"value{i}": 1.0 for i in range(1000)}

        def log() -> None:
            for step in range(1000):
                watch.log(step, values, epoch=1.0)

        with pytest.raises(DiskFullError, match=r"write .*tensorboard; .*intact"):
            log()


class FakeWandb:
    """What `Watch` needs of the module wandb."""

    def __init__(self) -> None:
        self.init_arguments: dict = {}
        self.logged: list = []
        self.is_finished = False

    def init(self, **arguments: object) -> "FakeWandb":
        self.init_arguments = arguments
        return self

    def log(self, values: dict, step: int) -> None:
        self.logged.append((step, values))

    def finish(self) -> None:
        self.is_finished = True

    def Image(self, pixels: np.ndarray) -> tuple:
        return ("image", pixels.shape)


def test_weights_and_biases_gets_metrics_pictures_and_the_config(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    options = {"num_steps": 4, "frames_per_step": 2}
    options["wandb"] = {"project": "p", "config": {"seed": 3}}
    with Watch(tmp_path, start_step=0, **options) as watch:
        watch.log(1, {"focal": 2.5}, epoch=0.5)
        picture = np.zeros((4, 6, 3), np.uint8)
        watch.log_scores(2, Scores({"ap/exact": 7.0}, 7.0, {"frame": picture}))
    assert fake.init_arguments["project"] == "p"
    assert fake.init_arguments["config"] == {"seed": 3}
    assert fake.logged[0][0] == 1
    assert fake.logged[0][1]["focal"] == 2.5
    assert fake.logged[1:] == [
        (2, {"ap/exact": 7.0}),
        (2, {"frame": ("image", (4, 6, 3))}),
    ]
    assert fake.is_finished
    run_id = fake.init_arguments["id"]
    with Watch(tmp_path, start_step=2, **options):
        assert fake.init_arguments["id"] == run_id  # the same run goes on


def test_weights_and_biases_that_is_not_installed_is_named(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"wandb is not installed: pip install"):
        Watch(tmp_path, 0, 1, 1, wandb={"project": "p"})
