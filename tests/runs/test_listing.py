"""The table of runs: what differs, APs and minutes."""

import json

from radejax.config import Config

from ..commands import run


def _write(folder, config, minutes):
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config.without_data_paths()))
    start = {"init_from": None, "init_partial": f"/runs/{folder.name}"}
    (folder / "run.json").write_text(json.dumps(start))
    rows = [{"step": 10 * i, "minutes": x} for i, x in enumerate(minutes, 1)]
    (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(x)}\n" for x in rows))
    return folder


def _report(folder, ap):
    names = [f"mean/all/ap_{space}_iou30/p/roi=narrow" for space in ("bev", "3d")]
    rows = [{"name": name, "ap": x} for name, x in zip(names, (99.0, ap), strict=True)]
    content = {"ap": rows, "options": {"protocols": ["p"]}, "split": "test"}
    (folder / "evaluation").mkdir()
    (folder / "evaluation" / "metrics.json").write_text(json.dumps(content))


def test_runs_are_listed_with_what_differs(tmp_path):
    config = Config()
    _report(_write(tmp_path / "a", config, [0.5, 1.0]), 41.5)
    changed = config.replace(seed=1, loss={"weights": {"focal": 4.0, "gwd": 1.0}})
    # It was continued: the second start took 2 minutes.
    _write(tmp_path / "seeds" / "b", changed, [0.5, 1.5, 0.5, 2.0])
    first, second = json.loads(run("runs", tmp_path, "--json").output)
    names = {"seed", "loss.weights.focal", "init_partial"}
    assert first == {
        "run": "a",
        "step": 20,
        "minutes": 1.0,
        "ap": 41.5,
        "metric": "map_3d_iou30/p/roi=narrow",
        "split": "test",
        "fields": {"seed": 0, "loss.weights.focal": 2.0, "init_partial": "/runs/a"},
    }
    assert (second["run"], second["minutes"], second["ap"]) == ("seeds/b", 3.5, None)
    assert second["fields"].items() >= {"seed": 1, "loss.weights.focal": 4.0}.items()
    assert set(second["fields"]) == names
    table = run("runs", tmp_path).output
    assert "AP: map_3d_iou30/p/roi=narrow, test split" in table
    assert "seed=1, loss.weights.focal=4.0" in table


def test_a_folder_without_runs_is_wrong_use(tmp_path):
    assert "no run in" in run("runs", tmp_path, code=2).stderr
