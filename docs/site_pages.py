"""Pages of the site that are not files of docs/, made while mkdocs builds it.

    pip install -e '.[docs]' && mkdocs build --strict
    python docs/site_pages.py site

README, CHANGELOG, CONTRIBUTING and the notebooks keep their places in the repository. The
reference is generated: a page per package of `radejax/` from its docstrings, a page of all
commands from their options, and a page of all config fields from `radejax/core/config.py`.
The second command lists the public names that a built site lacks, and fails if there are any.
"""

import ast
import pathlib
import re
import sys
from collections.abc import Iterator

import click
from ml_collections.config_flags import config_path

from radejax.cli.main import main
from radejax.core.config import fields_of, load_config

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
    """All fields of the bundled configs: type, values of the presets, meaning."""
    parts = [
        "# Config fields",
        "Every field can be set on the command line, for example "
        "`--config.train.batch_size=4`. [Differences](../deviations.md) explains where the "
        "paper and the released code disagree.",
    ]
    comments: dict[str, str] = {}
    for path in ("radejax/core/config.py", "configs/dinorade.py"):
        comments |= field_comments((ROOT / path).read_text(encoding="utf-8"))
    known: dict[str, str] = {}
    for name, title in (
        ("radenet", "RADE-Net"),
        ("dinorade", "DinoRADE: further fields, and those with other values"),
    ):
        path = str(ROOT / "configs" / f"{name}.py")
        configs = [load_config(path + end) for end in ("", ":paper", ":official")]
        rows = ["| field | type | default | paper | official | meaning |"]
        rows.append("|---|---|---|---|---|---|")
        for field, kind in fields_of(configs[0]):
            values = [config_path.get_value(field, config) for config in configs]
            cells = [f"`{field}`", kind.__name__, *(f"`{value!r}`" for value in values)]
            cells.append(comments[re.sub(r"weights\..*", "weights", field)])
            row = f"| {' | '.join(cells)} |"
            if known.get(field) != row:
                rows.append(row)
            known[field] = row
        parts += [f"## {title}", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def field_comments(source: str) -> dict[str, str]:
    """The comment above every field of a config module, by the field's dotted name."""
    found, above, section = {}, [], ""
    for line in source.splitlines():
        if match := re.match(r"def _(\w+)\(", line):
            sections = {"camera": "data.camera", "axes": "model.query_grid"}
            section = f"{sections.get(match[1], match[1])}."
        if match := re.match(r"    (model\.\w+) = ConfigDict", line):
            section = f"{match[1]}."
        if match := re.match(r'    "(\w+)": \{$', line):
            section = f"{match[1]}."
            continue
        if line.lstrip().startswith("# "):
            above.append(line.strip("# "))
            continue
        if match := re.match(r'\s+"(\w+)":', line):
            found[f"{section}{match[1]}"] = " ".join(above).replace("|", "\\|")
        above = []
    return found


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
    for page, text in reference().items():
        with mkdocs_gen_files.open(page, "w", encoding="utf-8") as file:
            file.write(text)


if __name__ == "__main__":
    lacking = missing(pathlib.Path(sys.argv[1]))
    sys.exit("\n".join(["not in the reference:", *lacking]) if lacking else 0)
elif __name__ == "<run_path>":
    write()
