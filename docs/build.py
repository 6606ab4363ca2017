"""Builds the site: README, guides and reference.

    pip install -e ".[docs]" && python docs/build.py [folder]

The reference comes from the docstrings by pdoc, with search; README and notebooks, with the outputs
that they hold, by nbconvert. Formulas become MathML, which browsers render without a network.
Warnings are errors.
"""

import inspect
import re
import shutil
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEMPLATES = ROOT / "docs" / "templates"
COPIED = ["CHANGELOG.md", "CITATION.cff", "LICENSE"]
# At the top of every page, from the root of the site.
LINKS = {
    "hamkernel": "index.html",
    "Quickstart": "notebooks/quickstart.html",
    "Your data": "notebooks/guide_data.html",
    "How to choose": "notebooks/guide_choose.html",
    "Sharp bits": "notebooks/guide_sharp_bits.html",
    "Large data": "notebooks/guide_large.html",
    "Deploy": "notebooks/guide_deploy.html",
    "Reference and search": "hamkernel.html",
}


def build(site: Path) -> None:
    """Write the site to the folder `site`, replacing what is there."""
    shutil.rmtree(site, ignore_errors=True)
    (site / "notebooks").mkdir(parents=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_reference(site)
        write_notebooks(site)
    shutil.copytree(
        ROOT / "notebooks" / "figures",
        site / "notebooks" / "figures",
        ignore=shutil.ignore_patterns("*.py", "__pycache__"),
    )
    for name in COPIED:
        shutil.copy(ROOT / name, site / name)


def write_reference(site: Path) -> None:
    """Write a page for each public module, from its docstrings."""
    import pdoc.doc
    import pdoc.render

    import hamkernel

    for name in hamkernel.__all__:  # pdoc does not see what is loaded when first asked for
        setattr(hamkernel, name, getattr(hamkernel, name))
    pdoc.render.configure(docformat="google", template_directory=TEMPLATES / "pdoc")
    pdoc.doc.formatannotation = short_annotation  # for pages and search alike
    pdoc.pdoc("hamkernel", output_directory=site)
    for path in site.rglob("*.html"):
        path.write_text(without_dead_anchors(path.read_text()))


def write_notebooks(site: Path) -> None:
    """Write a page for each notebook, and the README as index.html."""
    import nbformat

    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        page = rendered(nbformat.read(path, as_version=4), path.stem, "../")
        (site / "notebooks" / f"{path.stem}.html").write_text(page)
    readme = nbformat.v4.new_markdown_cell((ROOT / "README.md").read_text())
    page = rendered(nbformat.v4.new_notebook(cells=[readme]), "hamkernel", "")
    (site / "index.html").write_text(page)


def rendered(notebook, title: str, root: str) -> str:
    """The page of a notebook; `root` leads from its folder to that of the site."""
    from nbconvert import HTMLExporter

    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = with_mathml(cell.source)
    exporter = HTMLExporter(
        template_name="site", extra_template_basedirs=[str(TEMPLATES / "nbconvert")]
    )
    links = [(text, root + target) for text, target in LINKS.items()]
    resources = {"metadata": {"name": title}, "site_links": links}
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


def short_annotation(annotation, *arguments) -> str:
    """A type as it stands in the source, without the modules in which Python finds its parts."""
    text = inspect.formatannotation(annotation)
    text = re.sub(r"Union\[[^\[\]]*numpy\.ndarray[^\[\]]*\]", "ArrayLike", text)
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z])", "", text)


def linked(page: str) -> str:
    """The page with links to files of the repository made links to pages of the site."""
    page = re.sub(r'href="((?:notebooks/)?\w+)\.ipynb', r'href="\1.html', page)
    page = page.replace('href="hamkernel/__init__.py"', 'href="hamkernel.html"')
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
