"""The reference has every public name and field; `.ci/run docs` builds the site."""

import pathlib
import re
import runpy
from types import SimpleNamespace

import pytest

from radejax.config import load_config

ROOT = pathlib.Path(__file__).resolve().parents[1]
pages = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "site_pages.py"), {}, "p"))


def test_a_site_without_a_public_name_is_rejected(tmp_path):
    names = list(pages.public_names())
    assert "radejax.geometry.rotated_iou.bev_iou" in names
    assert "radejax.inference.detector.Detector.from_workdir" in names
    page = tmp_path / "reference" / "all" / "index.html"
    page.parent.mkdir(parents=True)
    page.write_text("".join(f'<h2 id="{name}">' for name in names))
    assert pages.missing(tmp_path) == []
    page.write_text("".join(f'<h2 id="{name}">' for name in names[1:]))
    assert pages.missing(tmp_path) == names[:1]


def test_linked_files_are_in_the_repository():
    """Some readers see the pages in the repository, and not on the site."""
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    lost = []
    for page in pages:
        links = re.findall(r"\]\(([^)\s#]+)[^)]*\)", page.read_text(encoding="utf-8"))
        paths = [link for link in links if not re.match(r"[a-z]+:", link)]
        lost += [f"{page}: {x}" for x in paths if not (page.parent / x).exists()]
    assert len(pages) > 20
    assert lost == []


def test_every_config_field_is_in_the_reference():
    text = pages.config_page()
    for config in ("dinorade", "quickstart_fusion"):
        names = {name for name, _ in load_config(config).fields()}
        free = r"(loss\.weights|simulation\.grid|simulation\.radar)\..*"
        for name in {re.sub(free, r"\1", name) for name in names}:
            assert f"\n| `{name}` | " in text, name
    assert "| `decode.nms_iou` | float from 0 to 1 | `0.3` | NMS removes" in text
    assert "| `model.widths` | tuple of 1 or more int from 1 to 65536 |" in text
    assert "| `loss.assignment` | `center` | `center` | `nms` |" in text  # presets


@pytest.mark.parametrize("folder", ["examples", "notebooks"])
def test_the_gallery_lists_every_example(folder):
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    index = text.partition("## By purpose")[2]
    listed = re.findall(rf"\]\(\.\./{folder}/([^)]+)\)", index)
    files = [x.name for x in (ROOT / folder).glob("*.*") if x.suffix != ".pyc"]
    assert sorted(listed) == sorted(files)


def test_links_outside_of_docs_lead_to_pages_of_the_site():
    page = SimpleNamespace(file=SimpleNamespace(src_uri="how_it_works.md"))
    links = {
        "../radejax/losses/gwd.py": "reference/losses.md#radejax.losses.gwd",
        "../radejax/models/__init__.py": "reference/models.md#radejax.models",
        "../examples/slurm.sh": "examples/slurm.md",
        "../notebooks/04_your_kradar.ipynb": "notebooks/04_your_kradar.ipynb",
        "../README.md": "index.md",
        "data.md#records": "data.md#records",
    }
    for link, expected in links.items():
        assert pages.on_page_markdown(f"[x]({link})", page) == f"[x]({expected})"
