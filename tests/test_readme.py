"""The code of the README runs and does what it says."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

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
        exec(python_blocks()[1], names)  # without the velocities
        exec(python_blocks()[2], names)  # with a known kinetic energy
        exec(python_blocks()[3], names)  # with friction
        exec(python_blocks()[4], names)  # and with deviations
    plt.close("all")
    force, opposite = names["friction"](jnp.array([1.0, 2.0])), names["friction"](-jnp.ones(2) * 2)
    among, far = names["deviation"]
    assert (among < far).all()
    assert force[0] == 0
    angles = jnp.linspace(1.3, 2.4, 12)  # of the data
    pull = names["rest"].evaluate(jnp.stack([angles, 9.0 * jnp.ones(12)], axis=1))
    np.testing.assert_array_equal(pull[:, 0], 0)
    assert float(abs(pull[:, 1] + 9.81 * jnp.sin(angles)).max()) < 0.5
    np.testing.assert_allclose(opposite, -force)
    states = np.random.default_rng(0).uniform([-2, -4], [2, 4], size=(200, 2))
    velocities = jax.vmap(names["pendulum"])(jnp.asarray(states))
    off = names["tuned"].field.evaluate(states) - velocities
    assert len(names["labels"]) == len(names["X"]) == 18
    assert np.linalg.norm(off) < 0.2 * np.linalg.norm(velocities)  # differences over 0.2 s
    assert float(abs(energy - energy[0]).max()) < 1e-6 * float(abs(energy[0]))
    assert float(abs(energy[0] - true)) < 0.1 * float(true)


@pytest.mark.slow
def test_the_deviations_of_fields_drawn_from_the_prior_are_the_ones_that_are_said():
    scores = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        X = rng.uniform(-2, 2, size=(30, 2))
        names = {"hk": hk, "jnp": jnp, "k": hk.Gaussian(1.0), "X": X}
        states = np.concatenate([X, [[1.0, 0.0], [3.0, 8.0]]])
        G = hk.gram(hk.Odd(hk.Symplectic(4.0 * hk.Gaussian(1.5))), states).reshape(64, 64)
        drawn = np.linalg.cholesky(G + 1e-9 * np.eye(64)) @ rng.normal(size=64)
        names["Y"] = drawn.reshape(-1, 2)[:30] + 0.1 * rng.normal(size=X.shape)
        with jax.numpy_dtype_promotion("standard"):
            exec(python_blocks()[4], names)
        np.testing.assert_array_equal(names["there"], states[30:])
        away = names["sure"].field.evaluate(states[30:]) - drawn.reshape(-1, 2)[30:]
        scores.append(abs(away / names["deviation"]))
    inside = np.mean(np.array(scores) < 1)
    assert abs(inside - 0.68) < 0.1  # nearly three standard errors of 160 independent numbers
    assert np.mean(np.array(scores) < 2) > 0.9


@pytest.mark.slow
def test_the_error_of_differences_is_the_one_that_is_said():
    pendulum, starts = hk.systems.Pendulum(mass=1.0), [[1.26, 0.0], [2.51, 0.0], [2.98, -4.0]]
    ts, still = jnp.linspace(0.0, 0.7, 8), jax.random.key(0)
    X, Y = hk.systems.sample(pendulum, jnp.array(starts), ts, 0.0, 0.0, key=still)
    errors = np.gradient(X, 0.1, axis=1)[:, 1:-1] - Y[:, 1:-1]
    assert f"{np.sqrt(np.mean(errors[..., 1] ** 2)):.2f} in ṗ" in README.read_text()


def test_the_readme_has_the_two_commands_that_ci_runs():
    text = README.read_text()
    assert text.count("-m pytest") >= 1
    assert ".venv/bin/python -m hamkernel" in text


def test_the_lines_for_large_data_give_the_field_of_the_exact_fit():
    rng = np.random.default_rng(0)
    X = rng.uniform(-2, 2, size=(400, 2))
    Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1)
    K = hk.Symplectic(hk.Gaussian(1.5))
    data = {"X": X, "Y": Y, "X_new": X[:40], "Y_new": Y[:40]}
    exact = hk.fit(K, X, Y, 1e-5).evaluate(X)
    chunks = ((X[i : i + 100], Y[i : i + 100]) for i in range(0, 400, 100))
    for block in python_blocks()[5:]:
        names = {"jax": jax, "hk": hk, "K": K, "chunks": chunks, **data}
        exec(block, names)
        # Landmarks to a tolerance of a tenth of the ridge; the last field has some points twice.
        assert abs(names["field"].evaluate(X) - exact).max() < 1e-2
    assert len(python_blocks()) == 7  # all blocks of the README are run
