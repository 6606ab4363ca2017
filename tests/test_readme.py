"""The code of the README runs and does what it says."""

import re
from pathlib import Path

import jax
import pytest

README = Path(__file__).parents[1] / "README.md"


def python_blocks():
    return re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


@pytest.mark.filterwarnings("ignore:FigureCanvasAgg")
def test_the_ten_lines_learn_a_pendulum_that_keeps_its_energy():
    import matplotlib.pyplot as plt

    # As a reader runs it: without the strict promotion of the test suite.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        names: dict = {}
        exec(python_blocks()[0], names)
        energy = jax.vmap(names["field"].hamiltonian)(names["orbit"])
        true = names["pendulum"].hamiltonian(names["orbit"][0])
    plt.close("all")
    assert float(abs(energy - energy[0]).max()) < 1e-6 * float(abs(energy[0]))
    assert float(abs(energy[0] - true)) < 0.1 * float(true)


def test_the_readme_has_the_two_commands_that_ci_runs():
    text = README.read_text()
    assert text.count("-m pytest") >= 1
    assert ".venv/bin/python -m hamkernel" in text
