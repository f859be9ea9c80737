"""The site has every page and every public name; `.ci/run docs` builds it."""

import pathlib
import re
import runpy
from types import SimpleNamespace

import yaml

from radejax.config import load_config

ROOT = pathlib.Path(__file__).resolve().parents[1]
pages = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "site_pages.py"), {}, "p"))


def _pages(node: object) -> list[str]:
    """All files in a navigation."""
    if isinstance(node, str):
        return [node]
    values = node.values() if isinstance(node, dict) else node
    return [page for value in values for page in _pages(value)]


def test_the_navigation_names_every_page_once() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    named = _pages(config["nav"])
    notebooks = [f"notebooks/{p.name}" for p in (ROOT / "notebooks").glob("*.ipynb")]
    guides = [path.name for path in (ROOT / "docs").glob("*.md")]
    made = ["index.md", "CHANGELOG.md", "CONTRIBUTING.md", *notebooks]
    assert sorted(named) == sorted([*guides, *made, *pages.reference()])


def test_every_public_module_is_in_the_reference() -> None:
    text = "".join(pages.reference().values())
    named = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    files = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "radejax").rglob("[!_]*.py")
    ]
    assert len(named) == len(set(named))
    assert set(files) <= set(named)


def test_a_site_without_a_public_name_is_rejected(tmp_path: pathlib.Path) -> None:
    names = list(pages.public_names())
    assert "radejax.geometry.rotated_iou.bev_iou" in names
    assert "radejax.inference.detector.Detector.from_workdir" in names
    page = tmp_path / "reference" / "all" / "index.html"
    page.parent.mkdir(parents=True)
    page.write_text("".join(f'<h2 id="{name}">' for name in names))
    assert pages.missing(tmp_path) == []
    page.write_text("".join(f'<h2 id="{name}">' for name in names[1:]))
    assert pages.missing(tmp_path) == names[:1]


def test_every_config_field_is_in_the_reference() -> None:
    text = pages.config_page()
    for config in ("dinorade", "quickstart_fusion"):
        names = {name for name, _ in load_config(config).fields()}
        free = r"(loss\.weights|simulation\.grid|simulation\.radar)\..*"
        for name in {re.sub(free, r"\1", name) for name in names}:
            assert f"\n| `{name}` | " in text, name
    assert "| `decode.nms_iou` | float from 0 to 1 | `0.3` | NMS removes" in text
    assert "| `model.widths` | tuple of 1 or more int from 1 to 65536 |" in text
    assert "| `loss.assignment` | `center` | `center` | `nms` |" in text  # presets
