"""The site builds without a warning, and its links lead somewhere."""

import importlib.metadata
import re
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


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.filterwarnings("default")
def test_the_site_builds_without_a_warning_and_without_a_broken_link(tmp_path, monkeypatch):
    pytest.importorskip("pdoc")
    pytest.importorskip("nbconvert")
    pytest.importorskip("latex2mathml")
    monkeypatch.syspath_prepend(ROOT / "docs")
    import build  # pyright: ignore[reportMissingImports]

    site = tmp_path / "site"
    build.build(site)
    assert list(broken(site)) == []
    reference = (site / "hamkernel.html").read_text()
    missing = [name for name in hk.__all__ if f'id="{name}"' not in reference]
    # Modules have pages of their own.
    assert all((site / "hamkernel" / f"{name}.html").exists() for name in missing)
    assert (site / "search.js").exists()
    assert "_jax.Array" not in reference  # types as they stand in the source
    pages = {path: path.read_text() for path in site.rglob("*.html")}
    # What a page needs is in the site: no script, style or picture from a network.
    outside = r'<(?:script|img)[^>]* src="https?:|<link[^>]* href="https?:'
    assert [path.name for path, page in pages.items() if re.search(outside, page)] == []
    assert "<math" in pages[site / "notebooks" / "quickstart.html"]
    notebooks = [page for path, page in pages.items() if path.parent.name == "notebooks"]
    assert all('href="../index.html"' in page for page in notebooks)


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
