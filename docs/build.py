"""Builds the site: README, guides and reference.

    pip install -e ".[docs]" && python docs/build.py [folder]

The reference comes from the docstrings by pdoc, with search; README and notebooks, with the outputs
that they hold, by nbconvert. Both render formulas. Warnings are errors.
"""

import re
import shutil
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[1]
COPIED = ["CHANGELOG.md", "CITATION.cff", "LICENSE"]


def build(site: Path) -> None:
    """Write the site to the folder `site`, which is made or filled anew."""
    import nbformat
    import pdoc.render
    from nbconvert import HTMLExporter

    import hamkernel

    for name in hamkernel.__all__:  # pdoc does not see what is loaded when first asked for
        setattr(hamkernel, name, getattr(hamkernel, name))

    shutil.rmtree(site, ignore_errors=True)
    (site / "notebooks").mkdir(parents=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pdoc.render.configure(docformat="google", math=True, search=True)
        pdoc.pdoc("hamkernel", output_directory=site)
    for path in site.rglob("*.html"):
        path.write_text(without_dead_anchors(path.read_text()))

    def write(notebook, path: Path) -> None:
        page, _ = HTMLExporter().from_notebook_node(
            notebook, resources={"metadata": {"name": path.stem}}
        )
        path.write_text(linked(page))

    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        write(nbformat.read(path, as_version=4), site / "notebooks" / f"{path.stem}.html")
    for picture in (ROOT / "notebooks" / "figures").glob("*.png"):
        target = site / "notebooks" / "figures" / picture.name
        target.parent.mkdir(exist_ok=True)
        shutil.copy(picture, target)
    for name in COPIED:
        shutil.copy(ROOT / name, site / name)
    front = nbformat.v4.new_notebook(
        cells=[
            nbformat.v4.new_markdown_cell("[Reference and search](hamkernel.html)"),
            nbformat.v4.new_markdown_cell((ROOT / "README.md").read_text()),
        ]
    )
    write(front, site / "index.html")


def linked(page: str) -> str:
    """Links to files of the repository, as links to pages of the site."""
    page = re.sub(r'href="((?:notebooks/)?\w+)\.ipynb', r'href="\1.html', page)
    # nbconvert makes the ids of headings with their capitals, and GitHub those of README without.
    page = page.replace('href="hamkernel/__init__.py"', 'href="hamkernel.html"')
    ids = re.findall(r'<h\d id="([^"]+)"', page)
    for heading in ids:
        page = page.replace(f'href="#{heading.lower()}"', f'href="#{heading}"')
    return page


def without_dead_anchors(page: str) -> str:
    """The text alone of links to anchors that the page lacks: pdoc links what it does not show."""
    ids = set(re.findall(r'id="([^"]+)"', page))

    def kept(link: re.Match) -> str:
        return link[0] if link[1] in ids else link[2]

    return re.sub(r'<a href="#([^"]+)">([^<]*)</a>', kept, page)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "site"
    build(folder)
    print(f"open {folder / 'index.html'}")
