"""Every command in README and docs is understood, and run somewhere by a test."""

import functools
import json
import pathlib
import re
import shlex
import subprocess
import sys
import tomllib

import click
import click.testing
import numpy as np
import pytest

from radejax import cli
from radejax.config import load_config

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = ("python", "python3", "radejax", "pip", "pytest", "git", ".", "cd")

# Where each kind of command is run for real; the text must name it.
RUN_IN = {
    "train.py": "tests/test_quickstart.py",
    "evaluate.py": "tests/test_quickstart.py",
    "radejax simulate": "tests/test_documented_commands.py",
    "radejax data check": "tests/test_documented_commands.py",
    "radejax project": "tests/test_documented_commands.py",
    "radejax overlay": "tests/test_documented_commands.py",
    "radejax view": "tests/test_documented_commands.py",
    "radejax detect": "tests/test_quickstart.py",
    "radejax evaluate": "tests/test_cli.py",
    "radejax export": "tests/test_cli.py",
    "radejax benchmark": "tests/test_cli.py",
    "radejax embed": "tests/test_fusion_run.py",
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
    if program == "radejax":
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


def _check_radejax(arguments: list[str]) -> None:
    """Options exist and no required parameter is missing, as click would say it."""
    command = cli.main
    while isinstance(command, click.Group):
        name = arguments[0]
        assert name in command.commands, f"no command {name!r}"
        command, arguments = command.commands[name], arguments[1:]
    if not arguments:  # mentioned by name alone
        return
    parser = command.make_parser(click.Context(command))
    given, rest, _ = parser.parse_args(list(arguments))
    assert not rest
    for parameter in command.params:
        assert given.get(parameter.name) or not parameter.required, parameter.name


@functools.cache
def _absl_flags(script: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, script, "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert f"{script}:" in done.stdout, done.stderr[-2000:]
    names = re.findall(r"^\s+--(?:\[no\])?(\w+)", done.stdout, re.MULTILINE)
    return set(names)


def _check_script(script: str, arguments: list[str]) -> None:
    path = ROOT / script
    assert path.is_file(), f"no such script: {script}"
    flags = [word for word in arguments if word.startswith("--")]
    if path.parent.name in ("benchmarks", "examples"):
        text = path.read_text(encoding="utf-8")
        for flag in flags:
            assert f'"{flag.partition("=")[0]}"' in text
        return
    config = None
    for i, flag in enumerate(arguments):
        if flag in ("--config",) or flag.startswith("--config="):
            name = flag.partition("=")[2] or arguments[i + 1]
            config = None if name == "..." else load_config(str(ROOT / name))
    for flag in flags:
        name = flag[2:].partition("=")[0]
        if name.startswith("config."):
            assert config is not None
            *sections, field = name.split(".")[1:]
            assert field in functools.reduce(lambda c, key: c[key], sections, config)
        else:
            assert name == "config" or name in _absl_flags(script)


def _check_pip(arguments: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    assert arguments[0] == "install"
    for extra in re.findall(r"\[([\w,]+)\]", " ".join(arguments)):
        assert set(extra.split(",")) <= set(extras)


def test_every_kind_of_command_is_run_by_a_test() -> None:
    for name, place in RUN_IN.items():
        text = (ROOT / place).read_text(encoding="utf-8")
        word = name.split()[-1]
        assert any(w in text for w in (f'"{word}"', f"test_{word}", f"{word}_dataset"))
    for _, command in COMMANDS:
        words = shlex.split(command, comments=True)
        if words[0] == "radejax":
            known = (" ".join(words[:2]), " ".join(words[:3]))
        elif words[0].startswith("python") and "/" not in words[1]:
            known = (words[1],)
        else:
            continue
        assert set(known) & set(RUN_IN) or words[1].startswith("-"), command


# Run for real, on two frames --------------------------------------------------------


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Two frames of one sequence, made by `radejax simulate`."""
    folder = tmp_path_factory.mktemp("commands")
    config = folder / "tiny.py"
    quickstart = ROOT / "configs" / "quickstart.py"
    config.write_text(
        "from radejax.config import load_config\n"
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
    result = click.testing.CliRunner().invoke(cli.main, words)
    assert result.exit_code == 0, result.output
    return result


def test_data_check_finds_simulated_folders_whole(root: pathlib.Path) -> None:
    assert json.loads(_run("data", "check", root, "--json").stdout)


def test_project_then_nothing_is_left_to_project(
    root: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "records"
    first = json.loads(_run("project", root, "--out", out, "--json").stdout)
    again = json.loads(_run("project", root, "--out", out, "--json").stdout)
    assert 2 in first.values()
    assert first != again


def test_overlay_draws_a_frame(root: pathlib.Path, tmp_path: pathlib.Path) -> None:
    from PIL import Image

    out = tmp_path / "overlay.png"
    (label, *_) = sorted((root / "1" / "info_label_v2_1").glob("*.txt"))
    _run("overlay", f"1/{label.stem}", "--data", root, "--out", out)
    assert np.asarray(Image.open(out)).std() > 10


def test_view_writes_a_recording(root: pathlib.Path, tmp_path: pathlib.Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "one.rrd"
    _run("view", root, "--sequence", 1, "--out", out)
    assert out.stat().st_size > 10_000
