"""Logs that agree with the step a run starts from."""

import json
import pathlib

from radejax.training.watch import Watch


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


def test_other_processes_write_nothing(tmp_path: pathlib.Path) -> None:
    with Watch(
        tmp_path, start_step=0, num_steps=1, frames_per_step=1, is_main=False
    ) as watch:
        watch.log(1, {"focal": 1.0}, epoch=1.0)
    assert not list(tmp_path.iterdir())
