"""What works under jit, vmap and grad: the two tables of the sharp bits, executed."""

import functools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hamkernel as hk

GUIDE = Path(__file__).parents[1] / "notebooks" / "guide_sharp_bits.ipynb"

pendulum = hk.systems.Pendulum(mass=1.0, gravity=1.0)
K = hk.Symplectic(1.0 * hk.Gaussian(2.0))
corners = np.array([[-2.0, -2.0], [2.0, 2.0]])
start, ts = jnp.array([0.5, 0.3]), jnp.linspace(0.0, 1.0, 11)
X = jax.random.uniform(jax.random.key(0), (12, 2), minval=-2.0, maxval=2.0)
Y = jax.vmap(pendulum)(X)
ones = jnp.ones((12, 1, 2))
runs = hk.Runs([ts], [hk.simulate(pendulum, start, ts).ys])
features = hk.RandomFeatures(20, jax.random.key(1))


@functools.cache
def learned():
    with jax.ensure_compile_time_eval():  # the first call may be under jit
        return hk.condition(K, X, Y, 1e-4)


def fitted(s, **options):
    return hk.fit(K, s * X, Y, 1e-4, **options)(start)


# The amplitude of 1 is the subject of no test here.
pytestmark = pytest.mark.filterwarnings("ignore:the amplitude of")


def at_start(posterior):
    return posterior.deviation(start)


# Each of these is a function of one number s, which JAX traces.
WORKS = {
    "`k(x, z)` and `K(x, z)`": lambda s: K(s * start, start),
    "`hk.gram`": lambda s: hk.gram(K, s * X),
    "`hk.gram_operator`": lambda s: hk.gram_operator(K, s * X).mv(Y),
    "`hk.fit`": fitted,
    "`hk.fit` with `ConjugateGradient`": lambda s: fitted(s, solver=hk.ConjugateGradient()),
    "`hk.fit` with `Nystrom`": lambda s: fitted(s, solver=hk.Nystrom()),
    "`hk.fit` with `RandomFeatures`": lambda s: fitted(s, solver=features),
    "`Velocities`, `Energies`, `Equilibria`, `Functionals` and their sums": lambda s: hk.fit(
        K,
        hk.Velocities(X, s * Y, noise=2.0)
        + hk.Energies(X, s * Y[:, 0])
        + hk.Equilibria(jnp.zeros((1, 2)))
        + hk.Functionals(X[:, None], s * ones, Y.sum(axis=1)),
        regularization=1e-4,
    )(start),
    "a field, its `.hamiltonian`, `.part`, `.evaluate`, `.anchored`": lambda s: (
        learned().field.anchored(s * start).hamiltonian(s * start)
    ),
    "`hk.condition`": lambda s: at_start(hk.condition(K, X, s * Y, 1e-4)),
    "a posterior, its `.deviation`, `.covariance`, `.energy_deviation`": lambda s: (
        learned().energy_deviation(s * start, 0 * start)
    ),
    "`posterior.updated`": lambda s: at_start(learned().updated(s * X[:2], Y[:2])),
    "`posterior.sample`, its count static": lambda s: jax.vmap(lambda f: f(start))(
        learned().sample(jax.random.key(0), 3, s * jnp.asarray(corners))
    ),
    "`hk.cross_validation_loss`, its folds static": lambda s: hk.cross_validation_loss(
        K, s * X, Y, 1e-4
    ),
    "`hk.cross_validation_residuals`, its folds static": lambda s: hk.cross_validation_residuals(
        K, s * X, Y, 1e-4
    ),
    "`hk.generalized_cross_validation`": lambda s: hk.generalized_cross_validation(
        K, s * X, Y, 1e-4
    ),
    "`hk.log_marginal_likelihood`": lambda s: hk.log_marginal_likelihood(K, s * X, Y, 1e-4),
    "`hk.simulate`": lambda s: hk.simulate(learned().field, s * start, ts).ys,
    "`hk.simulate` with a step": lambda s: (
        hk.simulate(learned().field, s * start, ts, hk.ImplicitMidpoint(), dt=0.1).ys
    ),
    "`hk.systems`, `hk.systems.sample`": lambda s: hk.systems.sample(
        hk.systems.Pendulum(mass=s), X[:2], ts, 0.01, 0.01, key=jax.random.key(0)
    )[0],
    "streams: `.start`, `.add`, `.field`, `.fit_chunks`": lambda s: (
        hk.Nystrom().start(K, s * X, 1e-4).add(X, Y).field()(start)
    ),
}

REFUSED = {
    "`hk.Runs`": lambda s: hk.Runs([ts], [s * Y[:11]]),
    "`hk.learn`": lambda s: hk.learn(hk.Symplectic(hk.Gaussian(s)), runs),
    "`hk.tune`": lambda s: hk.tune(K, X, s * Y),
    "`hk.readout`": lambda s: hk.readout(hk.condition(K, X, s * Y, 1e-4), {"q": lambda x: x[0]}),
    "`hk.compare`": lambda s: hk.compare(X, s * Y),
    "`hk.check_kernel`": lambda s: hk.check_kernel(hk.Gaussian(s), X),
    "`hk.save`": lambda s: hk.save("no file", hk.fit(K, X, s * Y, 1e-4)),
    "`hk.plot`": lambda s: hk.plot.trajectories({"a": s * Y}),
    "`folds=labels`": lambda s: hk.cross_validation_loss(
        K, X, Y, 1e-4, folds=(s * jnp.arange(12.0)).astype(int)
    ),
}


def rows(heading):
    """The rows of the first table under a heading of the guide, without its head."""
    cells = json.loads(GUIDE.read_text())["cells"]
    text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    table = re.findall(r"^\|.*\|$", text.partition(heading)[2].partition("\n## ")[0], re.MULTILINE)
    return [[entry.strip() for entry in row.strip("|").split(" | ")] for row in table]


def both_tables():
    every = rows("## What works under jit, vmap and grad")
    (second,) = (i for i, row in enumerate(every) if row[0] == "refused")
    return every[2:second], every[second + 2 :]


def test_the_tables_have_each_case_that_is_tested_and_no_other():
    works, refused = both_tables()
    assert [row[0] for row in works] == list(WORKS)
    assert all(row[1:] == ["yes", "yes", "yes"] for row in works)
    assert [row[0] for row in refused] == list(REFUSED)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", WORKS)
def test_works_under_jit_vmap_and_grad(name):
    def number(s):
        return jnp.sum(WORKS[name](s))

    jax.eval_shape(number, 1.0)  # as jit does
    jax.eval_shape(jax.vmap(number), jnp.ones(2))
    jax.eval_shape(jax.grad(number), 1.0)
    jax.eval_shape(jax.vmap(jax.grad(number)), jnp.ones(2))


# Under jit `posterior.sample` chooses its landmarks without looking at how many are needed, so that
# its draws are others of the same distribution.
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in WORKS if "sample`, its count" not in name])
def test_the_numbers_under_jit_and_grad_are_those_without(name):
    def number(s):
        return jnp.sum(WORKS[name](s))

    np.testing.assert_allclose(jax.jit(number)(1.1), number(jnp.asarray(1.1)), rtol=1e-6)
    step = 1e-4
    central = (number(1.1 + step) - number(1.1 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(number)(1.1), central, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", REFUSED)
def test_the_others_are_refused_with_the_sentence_of_the_table(name):
    (sentence,) = (row[1] for row in both_tables()[1] if row[0] == name)
    for transformed in (
        REFUSED[name],
        lambda s: jax.vmap(REFUSED[name])(jnp.stack([s, s])),
        jax.grad(REFUSED[name]),
    ):
        with pytest.raises((TypeError, ValueError)) as refusal:
            jax.jit(transformed)(1.0)
        assert str(refusal.value) == sentence.strip("*")


def test_a_field_is_loaded_under_jit(tmp_path):
    path = tmp_path / "field"
    hk.save(path, learned().field)
    found = jax.jit(lambda x: hk.load(path)(x))(start)
    np.testing.assert_allclose(found, learned().field(start), rtol=1e-12)


def test_a_picture_is_refused_where_one_array_of_a_field_is_traced():
    with pytest.raises(TypeError, match=r"hk.plot.phase_portrait cannot run under jax.jit"):
        jax.jit(lambda s: hk.plot.phase_portrait(fitted_field(s), (-1, 1), (-1, 1)))(1.0)
    plt.close("all")


def fitted_field(s):
    return hk.fit(K, X, s * Y, 1e-4)
