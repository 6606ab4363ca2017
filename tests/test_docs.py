"""The site builds without a warning, and its links lead somewhere."""

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import hamkernel as hk

ROOT = Path(__file__).parents[1]


class Links(HTMLParser):
    """Where a page points to, and what it can be pointed at."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.anchors = set(), set()
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        names = dict(attrs)
        self.anchors |= {names[key] for key in ("id", "name") if names.get(key)}
        self.targets |= {names[key] for key in ("href", "src") if names.get(key)}


def broken(site):
    """Relative links of the pages of a site that lead nowhere."""
    pages = {path: Links(path.read_text()) for path in site.rglob("*.html")}
    for path, page in pages.items():
        for target in page.targets:
            if re.match(r"[a-z+]+:|//", target):
                continue
            file, _, anchor = target.partition("#")
            there = (path.parent / unquote(file)).resolve() if file else path
            if not there.exists():
                yield path.name, target
            elif there in pages and not {anchor, unquote(anchor)} & {"", *pages[there].anchors}:
                yield path.name, target


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site that the variable SITE names, or one built here.

    CI builds it in an environment with [docs] alone, since other packages hide what is missing.
    """
    if "SITE" in os.environ:
        return ROOT / os.environ["SITE"]
    for package in ("pdoc", "nbconvert", "latex2mathml"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("docs") / "site"
    subprocess.run([sys.executable, ROOT / "docs" / "build.py", folder], check=True)
    return folder


@pytest.mark.slow
@pytest.mark.ci
def test_the_site_has_every_page_and_no_broken_link(site):
    assert list(broken(site)) == []
    reference = (site / "hamkernel.html").read_text()
    missing = [name for name in hk.__all__ if f'id="{name}"' not in reference]
    # Modules have pages of their own.
    assert all((site / "hamkernel" / f"{name}.html").exists() for name in missing)
    assert (site / "search.js").exists()
    assert "_jax.Array" not in re.sub("<[^>]+>", "", reference)  # types as in the source
    pages = {path: path.read_text() for path in site.rglob("*.html")}
    # What a page needs is in the site: no script, style or picture from a network.
    outside = r'<(?:script|img)[^>]* src="https?:|<link[^>]* href="https?:'
    assert [path.name for path, page in pages.items() if re.search(outside, page)] == []
    assert "<math" in pages[site / "notebooks" / "quickstart.html"]
    notebooks = {path.stem: page for path, page in pages.items() if path.parent.name == "notebooks"}
    assert all('href="../reading.html"' in page for page in notebooks.values())
    assert all(
        f'href="notebooks/{name}.html"' in pages[site / "reading.html"] for name in notebooks
    )


@pytest.fixture
def build():
    spec = importlib.util.spec_from_file_location("build", ROOT / "docs" / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_build_that_fails_leaves_the_site_as_it_was(build, tmp_path, monkeypatch):
    site = tmp_path / "site"

    def written(folder):
        (folder / "index.html").write_text("new")

    def failing(folder):
        written(folder)
        raise RuntimeError("no pages")

    site.mkdir()
    (site / "index.html").write_text("old")
    monkeypatch.setattr(build, "write_reference", lambda folder: None)
    monkeypatch.setattr(build, "write_pages", failing)
    with pytest.raises(RuntimeError, match="no pages"):
        build.build(site)
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
    assert (site / "index.html").read_text() == "old"
    monkeypatch.setattr(build, "write_pages", written)
    build.build(site)
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
    assert (site / "index.html").read_text() == "new"
    assert (site / "LICENSE").exists()


def test_the_reading_list_has_every_notebook(build):
    assert len(build.notebooks_in_order()) == len(list((ROOT / "notebooks").glob("*.ipynb")))


def test_a_broken_link_is_found(tmp_path):
    (tmp_path / "a.html").write_text('<a href="b.html#here">x</a><a href="c.html">y</a>')
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    assert sorted(broken(tmp_path)) == [("a.html", "b.html#here"), ("a.html", "c.html")]


def test_the_version_is_one():
    assert hk.__version__ == importlib.metadata.version("hamkernel")
    assert f"version: {hk.__version__}" in (ROOT / "CITATION.cff").read_text()
    assert f"## {hk.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_citation_names_software_and_paper():
    text = (ROOT / "CITATION.cff").read_text()
    assert "cff-version: 1.2.0" in text
    assert "type: software" in text
    assert "arXiv:2312.09734" in text
