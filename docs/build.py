"""Builds the site: README, guides and reference.

    pip install -e ".[docs]" && python docs/build.py [folder]

The reference comes from the docstrings by pdoc, with search; README, texts and notebooks,
with the outputs that they hold, by nbconvert. Formulas become MathML, which browsers render without
a network. Warnings are errors, and a build that fails leaves the site as it was.
"""

import inspect
import json
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEMPLATES = ROOT / "docs" / "templates"
PAGES = sorted((ROOT / "docs").glob("*.md"))
READING = ROOT / "docs" / "reading.md"  # what to read, and in which order
COPIED = ["CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "docs/distributed.py"]
# At the top of every page, from the root of the site.
LINKS = {
    "hamkernel": "index.html",
    "What to read": "reading.html",
    "Your data": "notebooks/guide_data.html",
    "How to choose": "notebooks/guide_choose.html",
    "Sharp bits": "notebooks/guide_sharp_bits.html",
    "Reference and search": "hamkernel.html",
}


def build(site: Path) -> None:
    """Write the site to the folder `site`, replacing what is there."""
    site.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, so that the finished site needs no more than a new name.
    with tempfile.TemporaryDirectory(dir=site.parent) as folder:
        new = Path(folder) / "new"
        (new / "notebooks").mkdir(parents=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            write_reference(new)
            write_pages(new)
        shutil.copytree(
            ROOT / "notebooks" / "figures",
            new / "notebooks" / "figures",
            ignore=shutil.ignore_patterns("*.py", "__pycache__"),
        )
        (new / "docs").mkdir()
        for name in COPIED:
            shutil.copy(ROOT / name, new / name)
        if site.exists():
            site.rename(Path(folder) / "old")
        new.rename(site)


def write_reference(site: Path) -> None:
    """Write a page for each public module, from its docstrings."""
    import pdoc.doc
    import pdoc.render

    import hamkernel

    for name in hamkernel.__all__:  # pdoc does not see what is loaded when first asked for
        setattr(hamkernel, name, getattr(hamkernel, name))
    pdoc.render.configure(docformat="google", template_directory=TEMPLATES / "pdoc")
    # Of parameters, and of what is returned; for pages and search alike.
    inspect.formatannotation = pdoc.doc.formatannotation = short_annotation
    pdoc.pdoc("hamkernel", output_directory=site)
    for path in site.rglob("*.html"):
        path.write_text(without_dead_anchors(path.read_text()))


def write_pages(site: Path) -> None:
    """Write a page for each notebook and each text beside this file; the README is index.html."""
    import nbformat

    texts = {"index": (ROOT / "README.md").read_text()}
    texts |= {path.stem: path.read_text().replace("](../", "](") for path in PAGES}
    for name, text in texts.items():
        cell = nbformat.v4.new_markdown_cell(text)
        title = text.splitlines()[0].lstrip("# ")
        page = rendered(nbformat.v4.new_notebook(cells=[cell]), title, "")
        (site / f"{name}.html").write_text(page)
    order = notebooks_in_order()
    turns: dict[str, list] = {name: [] for name in order}
    for one, other in pairwise(order):
        turns[one].append((f"Next: {heading(other)}", f"{other}.html"))
        turns[other].insert(0, (f"Before: {heading(one)}", f"{one}.html"))
    for name in order:
        notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
        page = rendered(notebook, heading(name), "../", turns[name])
        (site / "notebooks" / f"{name}.html").write_text(page)


def notebooks_in_order() -> list[str]:
    """The names of all notebooks, in the order of the reading list."""
    listed = re.findall(r"notebooks/(\w+)\.ipynb", READING.read_text())
    order = list(dict.fromkeys(listed))
    missing = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} ^ set(order)
    if missing:
        raise ValueError(f"{READING.name} and the folder of notebooks differ: {sorted(missing)}")
    return order


def heading(name: str) -> str:
    """The first heading of a notebook."""
    cells = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text())["cells"]
    return "".join(cells[0]["source"]).splitlines()[0].lstrip("# ")


def rendered(notebook, title: str, root: str, turns: Sequence = ()) -> str:
    """The page of a notebook; `root` leads from its folder to that of the site.

    `turns` are the links at its end, to the notebooks before and after it.
    """
    from nbconvert import HTMLExporter

    # Cells are plain Python; the lexer of IPython would need IPython.
    notebook.metadata["language_info"] = {"name": "python", "pygments_lexer": "python"}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = with_mathml(cell.source)
    exporter = HTMLExporter(
        template_name="site", extra_template_basedirs=[str(TEMPLATES / "nbconvert")]
    )
    links = [(text, root + target) for text, target in LINKS.items()]
    resources = {"metadata": {"name": title}, "site_links": links, "site_turns": list(turns)}
    page, _ = exporter.from_notebook_node(notebook, resources=resources)
    return linked(page)


def with_mathml(text: str) -> str:
    """Markdown with its formulas, $…$ and $$…$$, as MathML; code stays as it is."""
    from latex2mathml.converter import convert

    def converted(match: re.Match) -> str:
        if match["code"]:
            return match["code"]
        if match["display"]:
            return convert(match["display"].strip(), display="block").replace("\n", "")
        return convert(match["inline"])

    pattern = r"(?P<code>```.*?```|`[^`]*`)|\$\$(?P<display>.+?)\$\$|\$(?P<inline>[^$]+)\$"
    return re.sub(pattern, converted, text, flags=re.DOTALL)


def short_annotation(annotation, *arguments, format=inspect.formatannotation, **options) -> str:
    """A type as it stands in the source, without the modules in which Python finds its parts."""
    text = format(annotation)
    text = re.sub(r"Union\[[^\[\]]*numpy\.ndarray[^\[\]]*\]", "ArrayLike", text)
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z])", "", text)


def linked(page: str) -> str:
    """The page with links to files of the repository made links to pages of the site."""
    page = re.sub(r'href="((?:notebooks/)?\w+)\.ipynb', r'href="\1.html', page)
    page = page.replace('href="hamkernel/__init__.py"', 'href="hamkernel.html"')
    pages = "|".join(path.stem for path in PAGES)
    page = re.sub(rf'href="((?:\.\./)?)(?:docs/)?({pages})\.md', r'href="\1\2.html', page)
    page = page.replace('href="README.md', 'href="index.html')
    # nbconvert makes the ids of headings with their capitals, GitHub those of README without.
    ids = re.findall(r'<h\d id="([^"]+)"', page)
    for heading in ids:
        page = page.replace(f'href="#{heading.lower()}"', f'href="#{heading}"')
    return page


def without_dead_anchors(page: str) -> str:
    """The page with the text alone of links to members that it does not show."""
    ids = set(re.findall(r'id="([^"]+)"', page))

    def kept(link: re.Match) -> str:
        return link[0] if link[1] in ids else link[2]

    return re.sub(r'<a href="#([^"]+)">([^<]*)</a>', kept, page)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "site"
    build(folder)
    print(f"open {folder / 'index.html'}")
