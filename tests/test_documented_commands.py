"""Every command in README and docs is valid, and commands on data folders run."""

import contextlib
import functools
import io
import pathlib
import re
import runpy
import shlex
import sys

import click
import click.testing
import pytest

from radejax.cli import entry, main
from radejax.cli.evaluate import evaluate
from radejax.cli.train import train
from radejax.config import load_config, with_texts

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]
PROGRAMS = ("python", "python3", "radejax")

# Scripts; the other files are modules that they import.
SCRIPTS = sorted(
    str(path.relative_to(ROOT))
    for folder in ("benchmarks", "docs/images", "examples")
    for path in (ROOT / folder).glob("*.py")
    if "__main__" in path.read_text(encoding="utf-8")
)


def _commands():
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
            if code.split()[:1] and code.split()[0] in PROGRAMS and " " in code:
                found.append((page.name, " ".join(code.split())))
        for line in re.findall(r"^    (python .*)$", prose, re.MULTILINE):
            found.append((page.name, line))
    return found


COMMANDS = _commands()
by_command = pytest.mark.parametrize(
    ("page", "command"), COMMANDS, ids=[f"{p}:{c[:60]}" for p, c in COMMANDS]
)


@by_command
def test_a_documented_command_is_understood(page, command):
    words = shlex.split(command, comments=True)
    program, arguments = words[0], words[1:]
    if program == "radejax" and arguments[0] == "train":
        _check_train(_without_placeholders(arguments[1:]))
    elif program == "radejax":
        _check_radejax(arguments)
    elif program in ("python", "python3") and arguments[0].endswith(".py"):
        _check_script(arguments[0], _without_placeholders(arguments[1:]))
    else:
        assert words[:2] == ["python3", "-m"]


def _without_placeholders(arguments):
    """Remove the brackets of optional arguments: `[--records DIR]`."""
    return [word.strip("[]") for word in arguments]


def _check_radejax(arguments, command=main.main):
    """All options exist and no required parameter is missing."""
    while isinstance(command, click.Group):
        name = arguments[0]
        assert name in command.commands, f"no command {name!r}"
        command, arguments = command.commands[name], arguments[1:]
    if not arguments:  # only the name is mentioned
        return
    context = click.Context(command, **command.context_settings)
    given, rest, _ = command.make_parser(context).parse_args(list(arguments))
    assert not rest
    for parameter in command.params:
        assert given.get(parameter.name) or not parameter.required, parameter.name


def _check_script(script, arguments):
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


def _check_train(arguments):
    """Config, its options, fields and their values exist."""
    if not arguments:  # only the name is mentioned
        return
    pairs = zip(["", *arguments], arguments, strict=False)
    arguments = [word for old, word in pairs if word != "..." or old == "--config"]
    own = ("...", "own_radar.py")  # configs of the reader
    names = ["radenet" if word in own else word for word in arguments]
    context = click.Context(train, **train.context_settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(entry.EXISTING, "exists", False)  # the pages' folders
        train.parse_args(context, names)
    settings = load_config(context.params["config"])
    values = {"S": "0", "LABELS.zip": "labels.zip"}
    texts = context.params["fields"].items()
    with_texts(settings, {name: values.get(text, text) for name, text in texts})


@functools.cache
def _help(script):
    """Output of `python script --help`, run in this process to share imports."""
    path = ROOT / script
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.setattr(sys, "argv", [script, "--help"])
        patch.syspath_prepend(path.parent)
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(str(path), run_name="__main__")
    assert stop.value.code == 0
    return output.getvalue()


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_explains_itself(script):
    assert _help(script).lower().startswith("usage: ")
