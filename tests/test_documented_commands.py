"""Every command in README and docs is understood, and run somewhere by a test."""

import ast
import contextlib
import functools
import io
import json
import pathlib
import re
import runpy
import shlex
import sys
import tomllib

import click
import click.testing
import pytest

from radejax.cli import main
from radejax.cli.evaluate import evaluate
from radejax.cli.train import train
from radejax.core.config import load_config, override

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PROGRAMS = ("python", "python3", "radejax", "pip", "pytest", "git", ".", "cd")

HELP = "tests/test_documented_commands.py::test_a_script_explains_itself"

# The test, or the line of .ci/run, that runs each kind of command for real.
RUN_IN = {
    "train.py": "tests/test_quickstart.py::test_from_nothing_to_metrics_and_pictures",
    "radejax train": "tests/cli/test_train.py::test_train_takes_a_part_of_the_data",
    "evaluate.py": "tests/test_quickstart.py"
    "::test_evaluate_reproduces_the_table_and_detect_writes_boxes",
    "radejax simulate": "tests/test_documented_commands.py"
    "::test_data_check_finds_simulated_folders_whole",
    "radejax data": "tests/test_documented_commands.py"
    "::test_data_check_finds_simulated_folders_whole",
    "radejax preprocess": "tests/test_documented_commands.py"
    "::test_preprocess_then_nothing_is_left_to_do",
    "radejax overlay": "tests/cli/test_figures.py"
    "::test_the_first_frame_of_a_sequence_is_drawn",
    "radejax view": "tests/test_documented_commands.py::test_view_writes_a_recording",
    "radejax demo": ".ci/run: radejax demo",
    "radejax detect": ".ci/run: radejax detect --workdir",
    "radejax evaluate": "tests/test_quickstart.py"
    "::test_evaluate_reproduces_the_table_and_detect_writes_boxes",
    "radejax score": "tests/cli/test_main.py"
    "::test_score_evaluates_predictions_in_files",
    "radejax compare": "tests/evaluation/test_compare.py::test_command_line",
    "radejax export": "tests/cli/test_main.py::test_export_takes_an_exported_folder",
    "radejax embed": "tests/test_fusion_run.py::test_embed_command",
    "examples/cfar_baseline.py": "tests/examples/test_cfar_baseline.py"
    "::test_cfar_baseline_fits_detects_and_reports",
    "examples/fusion_by_lens.py": "tests/test_fusion_run.py"
    "::test_example_compares_fusion_and_radar_by_the_lens",
    "examples/echo_accuracy.py": "tests/examples/test_echo_accuracy.py"
    "::test_scenes_are_measured",
    "examples/center_distance.py": "tests/examples/test_center_distance.py"
    "::test_a_report_is_told_in_two_tables",
    "examples/silhouettes.py": "tests/examples/test_silhouettes.py"
    "::test_both_runs_see_the_same_scenes_and_the_bar_decides",
    "examples/ablation.py": "tests/examples/test_ablation.py"
    "::test_what_is_missing_is_run_and_judged",
    "examples/pretrain_backbone.py": "tests/examples/test_pretrain_backbone.py"
    "::test_it_learns_and_what_it_writes_is_a_frozen_backbone",
    "examples/online_training.py": "tests/examples/test_online_training.py"
    "::test_fresh_frames_train_a_model_and_a_stop_changes_nothing",
    "examples/reference_points.py": "tests/test_fusion_run.py"
    "::test_example_draws_reference_points",
    # Measured by hand on quiet machines: that they start is tested.
    **{
        f"benchmarks/{path.name}": HELP
        for path in (ROOT / "benchmarks").glob("*.py")
        if "__main__" in path.read_text(encoding="utf-8")  # not modules of the others
    },
    "docs/images/networks.py": HELP,
    "docs/images/simulator_pictures.py": HELP,
}


def _commands() -> list[tuple[str, str]]:
    """(page, command): lines of fenced blocks, and inline code with arguments."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for language, block in re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL):
            lines = block.replace("\\\n", " ").splitlines()
            for line in lines if language in ("", "bash", "sh") else []:
                for part in line.split(" && "):
                    if part.split(" ")[0] in PROGRAMS:
                        found.append((page.name, part))
        prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        for code in re.findall(r"`([^`]+)`", prose):
            if code.split()[:1] and code.split()[0] in PROGRAMS[:5] and " " in code:
                found.append((page.name, " ".join(code.split())))
        for line in re.findall(r"^    (python .*)$", prose, re.MULTILINE):
            found.append((page.name, line))
    return found


COMMANDS = _commands()
by_command = pytest.mark.parametrize(
    ("page", "command"), COMMANDS, ids=[f"{p}:{c[:60]}" for p, c in COMMANDS]
)


def test_there_are_commands_on_the_pages() -> None:
    pages = {page for page, _ in COMMANDS}
    assert {"README.md", "install.md", "data.md", "training.md"} <= pages
    programs = {command.split()[0] for _, command in COMMANDS}
    assert {"python", "radejax", "pip", "pytest"} <= programs


@by_command
def test_a_documented_command_is_understood(page: str, command: str) -> None:
    words = shlex.split(command, comments=True)
    program, arguments = words[0], words[1:]
    if program == "radejax" and arguments[0] == "train":
        _check_train(_without_placeholders(arguments[1:]))
    elif program == "radejax":
        _check_radejax(arguments)
    elif program in ("python", "python3") and arguments[0].endswith(".py"):
        _check_script(arguments[0], _without_placeholders(arguments[1:]))
    elif program == "pip":
        _check_pip(arguments)
    elif program == "pytest":
        for argument in arguments:
            assert (
                argument.startswith("-")
                or (ROOT / argument).exists()
                or (argument == "slow")
            )
    else:  # of the system
        assert words[:2] in (
            ["git", "clone"],
            ["cd", "radejax"],
            ["python3", "-m"],
        ) or (program == ".")


def _without_placeholders(arguments: list[str]) -> list[str]:
    """Drops the brackets of optional arguments: `[--records DIR]`."""
    return [word.strip("[]") for word in arguments]


def _check_radejax(arguments: list[str], command: click.Command = main.main) -> None:
    """Options exist and no required parameter is missing, as click would say it."""
    while isinstance(command, click.Group):
        name = arguments[0]
        assert name in command.commands, f"no command {name!r}"
        command, arguments = command.commands[name], arguments[1:]
    if not arguments:  # mentioned by name alone
        return
    context = click.Context(command, **command.context_settings)
    given, rest, _ = command.make_parser(context).parse_args(list(arguments))
    assert not rest
    for parameter in command.params:
        assert given.get(parameter.name) or not parameter.required, parameter.name


def _check_script(script: str, arguments: list[str]) -> None:
    path = ROOT / script
    assert path.is_file(), f"no such script: {script}"
    flags = [word for word in arguments if word.startswith("--")]
    if "/" in script:
        for flag in flags:
            assert flag.partition("=")[0] in _help(script)
        return
    if script == "evaluate.py":
        _check_radejax([word for word in arguments if word != "..."], evaluate)
        return
    _check_train(arguments)


def _check_train(arguments: list[str]) -> None:
    """Config, words, fields and their values are understood."""
    if not arguments:  # mentioned by name alone
        return
    pairs = zip(["", *arguments], arguments, strict=False)
    arguments = [word for old, word in pairs if word != "..." or old == "--config"]
    names = ["radenet" if word == "..." else word for word in arguments]
    context = click.Context(train, **train.context_settings)
    train.parse_args(context, names)
    settings = load_config(context.params["config"])
    values = {"S": "0", "LABELS.zip": "labels.zip"}
    texts = context.meta["fields"].items()
    override(settings, {name: values.get(text, text) for name, text in texts})


def _check_pip(arguments: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    assert arguments[0] == "install"
    for extra in re.findall(r"\[([\w,]+)\]", " ".join(arguments)):
        assert set(extra.split(",")) <= set(extras)


@functools.cache
def _help(script: str) -> str:
    """What `python script --help` prints, from this process: imports are shared."""
    path = ROOT / script
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.setattr(sys, "argv", [script, "--help"])
        patch.syspath_prepend(path.parent)
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(str(path), run_name="__main__")
    assert stop.value.code == 0
    return output.getvalue()


SCRIPTS = sorted(name for name in RUN_IN if "/" in name)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_explains_itself(script: str) -> None:
    assert _help(script).lower().startswith("usage: ")


def _kind(command: str) -> str | None:
    """Key of `RUN_IN`; None where nothing of ours is run."""
    words = shlex.split(command, comments=True)
    if words[0] == "radejax" and not words[1].startswith("-"):
        return " ".join(words[:2])
    if words[0] in ("python", "python3") and words[1].endswith(".py"):
        return words[1]
    return None


def test_every_kind_of_command_is_run_by_a_test() -> None:
    kinds = {_kind(command) for _, command in COMMANDS} - {None}
    kinds |= {f"radejax {name}" for name in main.main.commands}
    assert kinds - set(RUN_IN) == set()
    assert {kind for kind in RUN_IN if "/" in kind} >= {
        str(path.relative_to(ROOT))
        for path in (ROOT / "examples").glob("*.py")
        if "__main__" in path.read_text()  # the rest are modules of the others
    }


@pytest.mark.parametrize("place", sorted(set(RUN_IN.values())))
def test_the_place_that_runs_a_command_is_there(place: str) -> None:
    if place.startswith(".ci/run: "):
        lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
        assert any(line.strip().startswith(place[len(".ci/run: ") :]) for line in lines)
        return
    path, _, name = place.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    assert name in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}


# Run for real, on two frames --------------------------------------------------------


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Two frames of one sequence, made by `radejax simulate`."""
    folder = tmp_path_factory.mktemp("commands")
    config = folder / "tiny.py"
    quickstart = ROOT / "configs" / "quickstart.py"
    config.write_text(
        "from radejax.core.config import load_config\n"
        "def get_config():\n"
        f"    config = load_config({str(quickstart)!r})\n"
        "    config.simulation.update(train_sequences=1, test_sequences=0)\n"
        "    return config\n"
    )
    out = folder / "data"
    _run("simulate", "--config", config, "--frames", 2, "--out", out)
    return out


def _run(*arguments: object) -> click.testing.Result:
    words = [str(argument) for argument in arguments]
    result = click.testing.CliRunner().invoke(main.main, words)
    assert result.exit_code == 0, result.output
    return result


def test_data_check_finds_simulated_folders_whole(root: pathlib.Path) -> None:
    assert json.loads(_run("data", "check", root, "--json").stdout)


def test_preprocess_then_nothing_is_left_to_do(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "records"
    assert (
        "0 were done, 2 preprocessed" in _run("preprocess", root, "--out", out).stdout
    )
    assert (
        "2 were done, 0 preprocessed" in _run("preprocess", root, "--out", out).stdout
    )


def test_view_writes_a_recording(root: pathlib.Path, tmp_path: pathlib.Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "one.rrd"
    result = _run("view", root, "--sequences", 1, "--out", out)
    assert result.stdout == f"2 frames written to {out}\n"
    assert out.stat().st_size > 10_000
