"""Pages of the site that are not files of docs/, made while mkdocs builds it.

    pip install -e '.[docs]' && mkdocs build --strict
    python docs/site_pages.py site

README, CHANGELOG, CONTRIBUTING, the notebooks and the examples keep their places in the
repository. The reference is generated: a page per package of `radejax/` from its docstrings, a page
of all commands from their options, and a page of all config fields from the classes of options.
The second command lists the public names that a built site lacks, and fails if there are any. The
file is also a hook of mkdocs, which replaces links to modules, notebooks and examples.
"""

import ast
import inspect
import itertools
import pathlib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import click

from radejax.cli.main import main
from radejax.config import Config, load_config
from radejax.core.options import Options
from radejax.data.cameras import CameraOptions
from radejax.data.options import DataOptions
from radejax.models.options import DinoRadeOptions, RadeNetOptions

ROOT = pathlib.Path(__file__).resolve().parents[1]
HOME = {"README.md": "index.md"}
"""Files of the root that have another name in the site."""


def modules() -> dict[str, pathlib.Path]:
    """Public modules of radejax by dotted name; packages that say nothing are left out."""
    found = {}
    for path in sorted((ROOT / "radejax").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        is_public = not any(part.startswith("_") for part in name.split("."))
        if is_public and path.read_text(encoding="utf-8").strip():
            found[name] = path
    return found


def reference() -> dict[str, str]:
    """Pages of the reference: commands, config fields, and one per package."""
    pages = {
        "reference/commands.md": commands_page(),
        "reference/config_fields.md": config_page(),
    }
    for name in modules():
        package = [*name.split("."), "radejax"][1]
        page = f"reference/{package}.md"
        title = "radejax" if package == "radejax" else f"radejax.{package}"
        pages.setdefault(page, f"# {title}\n")
        pages[page] += f"\n::: {name}\n"
    return pages


def commands_page() -> str:
    """All commands of `radejax` with their arguments and options."""
    parts = ["# Commands", ""]
    for name, command in commands(main, "radejax"):
        context = click.Context(command, info_name=name, **command.context_settings)
        parts += [f"## {name}", "", f"`{command.get_usage(context)[7:]}`", ""]
        parts += [re.sub(r"\x08\n", "", command.help or ""), ""]
        rows = [parameter.get_help_record(context) for parameter in command.params]
        parts += ["| option | meaning |", "|---|---|"]
        parts += [
            "| `{}` | {} |".format(
                *(" ".join(x.split()).replace("|", "\\|") for x in row)
            )
            for row in rows
            if row
        ]
        parts.append("")
    return "\n".join(parts)


def commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    """Every command below a group with its full name."""
    for name, command in sorted(group.commands.items()):
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def config_page() -> str:
    """All sections of the config: type, default and meaning of their fields, and presets."""
    parts = [
        "# Config fields",
        "Every field of a section that the config has can be set on the command line, for example "
        '`--config.train.batch_size=4`, or with `config.replace(train={"batch_size": 4})` in '
        "[Python](../training.md#write-a-config-file). A wrong type or value is an error.",
    ]
    for section, options in sections(Config()):
        rows = ["| field | type | default | meaning |", "|---|---|---|---|"]
        meanings = field_docstrings(type(options))
        for name, field in type(options).model_fields.items():
            value, kind = getattr(options, name), section_class(field.annotation)
            if kind is None:
                kind_text = type_text(field.annotation, field.metadata)
            else:  # the fields have a table of their own
                kind_text = "section" + " or None" * (value is None)
                value = value and (value.model_extra or "")
            cells = [f"`{section}{name}`", kind_text, code(value), meanings[name]]
            rows.append(table_row(cells))
        title = section.removesuffix(".") or "Top level"
        parts += [f"## {title}", inspect.getdoc(type(options)) or "", "\n".join(rows)]
    return "\n\n".join([*parts, presets_text()]) + "\n"


def sections(options: Options, prefix: str = "") -> Iterator[tuple[str, Options]]:
    """The sections of a config by the beginning of their fields' names.

    Those of DinoRADE and those that are None by default have their classes' defaults.
    """
    yield prefix, options
    if type(options) is RadeNetOptions:
        options = DinoRadeOptions()
    for name, field in type(options).model_fields.items():
        if kind := section_class(field.annotation):
            yield from sections(getattr(options, name) or kind(), f"{prefix}{name}.")


def section_class(annotation: Any) -> type[Options] | None:
    """The class of options that a field has, with or without None; otherwise None."""
    kinds = [x for x in get_args(annotation) or (annotation,) if x is not NoneType]
    is_one = len(kinds) == 1 and isinstance(kinds[0], type)
    return kinds[0] if is_one and issubclass(kinds[0], Options) else None


def field_docstrings(cls: type[Options]) -> dict[str, str]:
    """The docstring below every field of a class and of those that it is derived from."""
    found = {}
    for base in reversed(cls.__mro__):
        if not issubclass(base, Options):
            continue
        (node,) = ast.parse(inspect.getsource(base)).body
        for field, text in itertools.pairwise(node.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                meaning = " ".join(ast.literal_eval(text.value).split())
                found[field.target.id] = meaning
    return found


def type_text(annotation: Any, limits: Iterable[Any] = ()) -> str:
    """Type and range of an annotation, such as "float above 0 or None"."""
    arguments, origin = get_args(annotation), get_origin(annotation)
    if origin is Annotated:
        return type_text(arguments[0], (*annotation.__metadata__, *limits))
    if origin is Literal:
        return ", ".join(map(code, arguments))
    if origin in (Union, UnionType):
        return " or ".join(map(type_text, arguments))
    if annotation is NoneType:
        return "None"
    names = ("ge", "gt", "le", "lt", "min_length")
    bounds = {
        name: getattr(x, name) for x in limits for name in names if hasattr(x, name)
    }
    if origin is tuple:
        *first, last = arguments
        kinds = dict.fromkeys(map(type_text, first if last is ... else arguments))
        count = "" if last is ... else f"{len(arguments)} "
        if least := bounds.get("min_length"):
            count = f"{least} or more "
        return f"tuple of {count}{' and '.join(kinds)}"
    if origin is Mapping:
        return f"dictionary of {type_text(arguments[1])}"
    if issubclass(annotation, Options):
        return f"fields of `{annotation.__name__}`"
    if {"ge", "le"} <= bounds.keys():
        return f"{annotation.__name__} from {bounds['ge']} to {bounds['le']}"
    words = {"ge": "at least", "gt": "above", "lt": "below"}
    ranges = [f"{words[name]} {x}" for name, x in bounds.items() if name in words]
    return " ".join([annotation.__name__, " and ".join(ranges)]).strip()


def presets_text() -> str:
    """A table of the fields whose values in the presets are not the defaults."""
    names = [
        f"{name}{end}"
        for name in ("radenet", "dinorade")
        for end in ("", ":paper", ":official")
    ]
    presets = [dict(load_config(name).fields()) for name in names]
    default = Config(model=DinoRadeOptions(), data=DataOptions(camera=CameraOptions()))
    rows = [f"| field | default | {' | '.join(names)} |", "|---" * 8 + "|"]
    for field, value in default.fields():
        values = [preset.get(field, "") for preset in presets]
        if field != "model.name" and any(x not in ("", value) for x in values):
            rows.append(table_row([f"`{field}`", code(value), *map(code, values)]))
    text = (
        "Fields whose values in these configs are not the defaults. "
        "[Differences](../deviations.md) explains where the paper and the authors' code "
        "disagree."
    )
    return "\n\n".join(["## Presets", text, "\n".join(rows)])


def code(value: Any) -> str:
    """A value as code; nothing for an empty text."""
    if isinstance(value, Options):
        value = value.model_dump(exclude_none=True)
    if isinstance(value, Mapping):  # its own text may have several lines
        value = dict(value)
    return f"`{value}`" * (value != "")


def table_row(cells: Iterable[str]) -> str:
    """A row of a Markdown table."""
    escaped = (cell.replace("|", "\\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def root_page(name: str) -> str:
    """Text of a Markdown file of the root, with links and images as the site has them.

    A link to a file that is not on the site, such as LICENSE, becomes plain text.
    """
    text = (ROOT / name).read_text(encoding="utf-8")

    def convert(match: re.Match[str]) -> str:
        bang, label, target = match.groups()
        if target.startswith(("http://", "https://", "#")):
            return match[0]
        path = target.removeprefix("docs/").split("#")[0]
        if target.startswith("docs/") or (path.endswith(".md") and "/" not in path):
            return f"{bang}[{label}]({HOME.get(path, target.removeprefix('docs/'))})"
        if path.rstrip("/") == "notebooks":
            return f"[{label}](notebooks/01_batch_inference.ipynb)"
        return label

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", convert, text)


def place_on_site(path: str) -> str:
    """Page of the site for a file of the repository outside of docs/."""
    folder, _, name = path.partition("/")
    if folder == "radejax":
        module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        return f"reference/{module.split('.')[1]}.md#{module}"
    if folder == "examples":
        return example_page(name)
    return HOME.get(path, path)


def example_page(name: str) -> str:
    """Page of a file of examples/."""
    return f"examples/{name.partition('.')[0]}.md"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replaces links of a page of docs/ to files outside of docs/; called by mkdocs."""
    if "/" in page.file.src_uri:
        return markdown
    return re.sub(
        r"\]\(\.\./([^)\s]+)\)",
        lambda match: f"]({place_on_site(match[1])})",
        markdown,
    )


def public_names() -> Iterator[str]:
    """Every public function, class and method of the public modules, dotted."""
    for module, path in modules().items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                if node.name.startswith("_"):
                    continue
                yield f"{module}.{node.name}"
                for part in node.body if isinstance(node, ast.ClassDef) else ():
                    if isinstance(part, ast.FunctionDef) and part.name[0] != "_":
                        yield f"{module}.{node.name}.{part.name}"


def missing(site: pathlib.Path) -> list[str]:
    """Public names that have no place of their own in the pages of a built site."""
    text = "".join(
        path.read_text(encoding="utf-8") for path in site.glob("reference/*/index.html")
    )
    places = set(re.findall(r'\bid="([\w.]+)"', text))
    return [name for name in public_names() if name not in places]


def write() -> None:
    """Hands all pages to mkdocs; its plugin gen-files runs this file."""
    import mkdocs_gen_files

    for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md"):
        with mkdocs_gen_files.open(HOME.get(name, name), "w", encoding="utf-8") as file:
            file.write(root_page(name))
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        with mkdocs_gen_files.open(f"notebooks/{notebook.name}", "wb") as file:
            file.write(notebook.read_bytes())
    for path in sorted((ROOT / "examples").glob("*.*")):
        language = {".py": "python", ".sh": "bash"}[path.suffix]
        text = f"# {path.name}\n\n````{language}\n{path.read_text('utf-8')}````\n"
        with mkdocs_gen_files.open(
            example_page(path.name), "w", encoding="utf-8"
        ) as file:
            file.write(text)
    for page, text in reference().items():
        with mkdocs_gen_files.open(page, "w", encoding="utf-8") as file:
            file.write(text)


if __name__ == "__main__":
    lacking = missing(pathlib.Path(sys.argv[1]))
    sys.exit("\n".join(["not in the reference:", *lacking]) if lacking else 0)
elif __name__ == "<run_path>":
    write()
