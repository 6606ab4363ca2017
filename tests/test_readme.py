"""The code of the README runs and does what it says, and its links lead somewhere."""

import json
import re
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PAGES = {path: path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))}
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def python_blocks():
    return re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def markdown(notebook):
    cells = json.loads(notebook.read_text())["cells"]
    return "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")


def links(text):
    return re.findall(r"\]\(([^)\s]+)\)", text)


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg")
def test_the_ten_lines_learn_a_pendulum_from_noisy_states():
    import matplotlib.pyplot as plt

    (block,) = python_blocks()
    # As a reader runs it: without the strict promotion of the test suite.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        names: dict = {}
        exec(block, names)
    plt.close("all")
    pendulum = hk.systems.Pendulum(mass=1.0)
    np.testing.assert_allclose(names["learned"].noise, 0.02, atol=0.005)
    true = pendulum.hamiltonian(names["x0"]) - pendulum.hamiltonian(jnp.zeros(2))
    assert 0 < names["band"] < 0.5
    assert abs(names["energy"] - true) < 4 * names["band"]
    exact = hk.simulate(pendulum, names["x0"], names["ts"]).ys
    assert float(jnp.linalg.norm(names["orbit"] - exact, axis=1).max()) < 1.0  # of 10, in 10 s
    energies = jax.vmap(names["field"].hamiltonian)(names["orbit"])
    assert float(abs(energies - energies[0]).max()) < 1e-4


def test_it_fits_on_a_few_screens():
    assert len(README.splitlines()) <= 180


def test_the_readme_has_the_two_commands_that_ci_runs():
    assert README.count("-m pytest") >= 1
    assert ".venv/bin/python -m hamkernel" in README


def test_every_local_link_of_readme_and_notebooks_leads_to_a_file_and_a_heading():
    texts = {ROOT / "README.md": README, **{path: markdown(path) for path in NOTEBOOKS}}
    texts |= PAGES | {CONTRIBUTING: CONTRIBUTING.read_text()}
    headings = {
        path: {
            re.sub(r"\s+", "-", title.strip())
            for title in re.findall(r"^#+ +(.*)$", text, re.MULTILINE)
        }
        for path, text in texts.items()
    }
    lower = {title.lower() for title in headings[ROOT / "README.md"]}
    for source, text in texts.items():
        for link in links(text):
            if "://" in link:
                continue
            file, _, anchor = link.partition("#")
            target = (source.parent / file).resolve() if file else source
            assert target.exists(), f"{source.name}: {link}"
            there = lower if target.name == "README.md" else headings.get(target, {anchor})
            assert not anchor or anchor in there, f"{source.name}: {link}"


def test_contributing_names_what_exists():
    """Files, and the classes and methods that somebody who adds something needs."""
    text = CONTRIBUTING.read_text()
    paths = [*(ROOT / "hamkernel").rglob("*.py"), ROOT / "pyproject.toml"]
    sources = "".join(path.read_text() for path in paths)
    names = re.findall(r"`(\w+)(?:\(\w+(?:, \w+)*\))?`", text)
    assert [name for name in names if not re.search(rf"\b{name}\b", sources)] == []
    files = re.findall(r"`((?:hamkernel|tests|\.github)/[\w./]+)`", text)
    assert len(files) > 10
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_workflows_run_the_command_of_the_readme_on_the_pythons_that_are_supported():
    tests = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    (command,) = re.findall(r"run: eval \"\$\(grep -m1 -- '(.+)' README.md\)\"", tests)
    assert command in README
    assert f"grep -m1 -- '{command}' README.md" in (ROOT / ".ci" / "run").read_text()
    (pythons,) = re.findall(r"python: \[(.+)\]", tests)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == f">={json.loads(f'[{pythons}]')[0]}"
    assert {"Repository", "Issues"} <= set(project["urls"])


def test_the_times_of_the_readme_are_those_of_the_table():
    section = README.partition("## Speed")[2].partition("##")[0]
    times = re.findall(r"\b[\d.]+ (?:ms|µs|s)\b", section)
    assert len(times) >= 8
    assert [time for time in times if time not in PAGES[ROOT / "docs" / "speed.md"]] == []


def test_ten_questions_have_answers():
    table = README.partition("## Ten questions")[2].partition("##")[0]
    rows = [line for line in table.splitlines() if line.startswith("|") and "](" in line]
    assert len(rows) == 10


def test_every_notebook_is_linked_from_the_readme():
    assert [path.name for path in NOTEBOOKS if path.name not in README] == []


def test_plain_english():
    text = README + "".join(PAGES.values()) + "".join(markdown(path) for path in NOTEBOOKS)
    odd = ("tells", "leave away", "leaves away", "what is dense", "says nothing of", "finds out")
    odd += ("is told", "cannot tell its", "it is worth to", "as any other", "no matter of")
    assert [phrase for phrase in odd if phrase in text.lower()] == []


def test_the_structures_and_kernels_of_the_tables_exist():
    section = README.partition("## Structures")[2].partition("## Speed")[0]
    names = set(re.findall(r"\b([A-Z][A-Za-z]+)\(", section)) - {"K", "T", "U"}
    assert {"Symplectic", "Odd", "Warp"} <= names
    assert [name for name in sorted(names) if not hasattr(hk, name)] == []


@pytest.mark.slow
def test_the_error_of_differences_is_the_one_that_is_said():
    pendulum, starts = hk.systems.Pendulum(mass=1.0), [[1.26, 0.0], [2.51, 0.0], [2.98, -4.0]]
    ts, still = jnp.linspace(0.0, 0.7, 8), jax.random.key(0)
    X, Y = hk.systems.sample(pendulum, jnp.array(starts), ts, 0.0, 0.0, key=still)
    errors = np.gradient(X, 0.1, axis=1)[:, 1:-1] - Y[:, 1:-1]
    said = markdown(ROOT / "notebooks" / "guide_data.ipynb")
    assert f"{np.sqrt(np.mean(errors[..., 1] ** 2)):.2f} in ṗ" in said
