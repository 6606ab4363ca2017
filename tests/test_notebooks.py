"""The notebooks run from top to bottom, are short, and show what they print."""

import warnings
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# Each runs in a process of its own, compiled as for a user, and so is slow; CI runs this one.
IN_CI = {"quickstart"}
PACKAGES = {"planets": ["jplephem", "skyfield_data"], "guide_cluster": ["dask", "distributed"]}
# Without pictures: what they show is numbers and error messages.
NUMBERS = {"guide_cluster", "guide_deploy", "guide_sharp_bits", "guide_you_asked"}
# No claim about speed: only so that a kernel that hangs ends the test.
TIMEOUT = 1200

START = 'import jax; jax.config.update("jax_enable_x64", True); import hamkernel as hk'

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_is_a_quickstart():
    assert "quickstart" in {path.stem for path in NOTEBOOKS}


@every_notebook
def test_is_short_and_begins_in_float64(path):
    cells = code_cells(read(path))
    assert len(cells) <= 12
    assert cells[0].source.splitlines()[0] == START


@every_notebook
def test_no_line_of_code_is_cut_in_the_page(path):
    lines = [line for cell in code_cells(read(path)) for line in cell.source.splitlines()]
    assert [line for line in lines if len(line) > 88] == []


@every_notebook
def test_keeps_the_outputs_and_pictures_of_one_run_in_order(path):
    cells = code_cells(read(path))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    # A warning is a line that every reader would have to understand.
    assert not [output for output in outputs if output.get("name") == "stderr"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert pictures or path.stem in NUMBERS


@every_notebook
def test_ends_in_asserts_on_its_claims(path):
    assert "assert " in code_cells(read(path))[-1].source


def marked(path):
    marks = [pytest.mark.slow, *([pytest.mark.ci] if path.stem in IN_CI else [])]
    return pytest.param(path, marks=marks, id=path.stem)


def execute(notebook):
    client = nbclient.NotebookClient(
        notebook,
        timeout=TIMEOUT,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    )
    # The messaging library under the client warns of its own sockets and event loops.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        client.execute()  # raises with the traceback of the cell that failed


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("path", [marked(path) for path in NOTEBOOKS])
def test_runs_from_top_to_bottom(path, monkeypatch):
    for package in PACKAGES.get(path.stem, []):
        pytest.importorskip(package)
    monkeypatch.setenv("JAX_ENABLE_X64", "0")  # the first cell must ask for it itself
    execute(read(path))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_notebook_whose_claim_is_false_fails():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("assert 1 > 2")])
    with pytest.raises(nbclient.exceptions.CellExecutionError, match="AssertionError"):
        execute(notebook)
