"""Pages of the site that are not files of docs/, made while mkdocs builds it.

    pip install -e '.[docs]' && mkdocs build --strict
    python docs/site_pages.py site

README, CHANGELOG, CONTRIBUTING and the notebooks keep their places in the repository, and
the reference has a page for every room of `radejax/`, written from its docstrings. The
second command says which public names a built site lacks, and fails if there are any.
"""

import ast
import pathlib
import re
import sys
from collections.abc import Iterator

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
    """Pages of the reference: a room each, with all modules of the room."""
    pages: dict[str, str] = {}
    for name in modules():
        room = [*name.split("."), "radejax"][1]
        page = f"reference/{room}.md"
        title = "radejax" if room == "radejax" else f"radejax.{room}"
        pages.setdefault(page, f"# {title}\n")
        pages[page] += f"\n::: {name}\n"
    return pages


def root_page(name: str) -> str:
    """A Markdown file of the root, its links and pictures turned to the site's places.

    What the site does not have, such as LICENSE, becomes plain text.
    """
    text = (ROOT / name).read_text(encoding="utf-8")

    def turn(match: re.Match[str]) -> str:
        bang, label, target = match.groups()
        if target.startswith(("http://", "https://", "#")):
            return match[0]
        path = target.removeprefix("docs/").split("#")[0]
        if target.startswith("docs/") or (path.endswith(".md") and "/" not in path):
            return f"{bang}[{label}]({HOME.get(path, target.removeprefix('docs/'))})"
        if path.rstrip("/") == "notebooks":
            return f"[{label}](notebooks/01_batch_inference.ipynb)"
        return label

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", turn, text)


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
