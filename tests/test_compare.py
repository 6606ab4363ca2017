"""`hk.compare`: what candidates claim, the score, the answers and their guards."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalIterable=false
# Wrong types are refused here.

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._discovery.compare import Candidate, Comparison, _answer, _is_seen, claims
from hamkernel._discovery.ladder import ladder

RNG = np.random.default_rng(0)
X = RNG.uniform(-1, 1, size=(24, 2)) * [2.5, 2.0]
PENDULUM = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1)
Y = PENDULUM + 0.02 * PENDULUM.std(axis=0) * RNG.normal(size=X.shape)
K = hk.Gaussian(2.0)
TWO = {"any": hk.Separable(1.0 * K), "energy": hk.Symplectic(1.0 * K)}


def kernels(n):
    """Each step of the ladder, as searched and as shown."""
    rng = np.random.default_rng(n)
    for step in ladder(n).values():
        rung = step.rung(rng.uniform(0.5, 2.0, n), 1.3)
        numbers = eqx.filter(rung, eqx.is_inexact_array)
        moved = jax.tree.map(lambda h: h + rng.normal(size=h.shape), numbers)
        rung = eqx.combine(moved, rung)
        yield rung, step.kernel(rung)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.few(1)
def test_a_rung_of_the_ladder_is_the_kernel_that_is_shown_for_it(n):
    x, z = RNG.normal(size=(2, n))
    for rung, K in kernels(n):
        np.testing.assert_allclose(rung(x, z), K(x, z), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rung(x, x), K(x, x), rtol=1e-12, atol=1e-12)


def test_rungs_of_one_shape_share_one_compiled_search():
    shapes = {jax.tree.structure(rung) for rung, _ in kernels(2)}
    arrays = {tuple((a.shape, a.dtype) for a in jax.tree.leaves(rung)) for rung, _ in kernels(2)}
    assert len(shapes) == 1
    assert len(arrays) == 3  # one part; T and U; the four images of a reversible H
    assert not any(a.weak_type for rung, _ in kernels(2) for a in jax.tree.leaves(rung))


def test_the_ladder_has_the_products_of_its_steps():
    scale, steps = np.ones(2), ladder(2).values()
    for step in steps:
        assert step.claims == claims(step.kernel(step.rung(scale, 1.0)), scale)
    found = {step.claims for step in steps}
    free = [{"mirror"} & set(c) for c in found if "energy" not in c]
    assert len(free) == 2
    for has in ({"T + U"}, {"mirror"}, {"friction"}, {"T + U", "mirror"}, {"T + U", "friction"}):
        assert (
            frozenset({"energy"} | has | ({"reversible"} if {"T + U", "mirror"} == has else set()))
            in found
        )
    for has in ({"T + U"}, {"mirror"}, set()):
        assert frozenset({"energy", "reversible"} | has) in found
    assert frozenset({"energy", "friction", "mirror", "T + U"}) in found
    # Three coordinates have no (q, p); in two, divergence-free fields are those of an energy.
    assert set().union(*(step.claims for step in ladder(3).values())) == {"mirror"}
    assert "divergence-free" in ladder(3)
    assert "divergence-free" not in ladder(2)


@pytest.mark.parametrize(
    ("kernel", "claimed"),
    [
        (hk.Separable(K), set()),
        (hk.Even(hk.Symplectic(K)), {"energy"}),
        (hk.Odd(hk.Separable(K)), {"mirror"}),
        (hk.Symplectic(hk.Select(K, 0) * hk.Select(K, 1)), {"energy"}),
        (hk.Symplectic(hk.Select(K, 0) + hk.Select(K, 1)), {"energy", "T + U"}),
        (hk.Symplectic(K) + hk.PortHamiltonian(K, 0.1), set()),  # no one energy
        (hk.PortHamiltonian(hk.Invariant(K, [-np.eye(2)]), 0.1), {"energy", "friction", "mirror"}),
        (hk.Symplectic(hk.Invariant(K, [np.diag([1.0, -1.0])])), {"energy", "reversible"}),
    ],
)
def test_a_candidate_claims_what_its_structure_says(kernel, claimed):
    assert claims(kernel, np.array([1.0, 3.0])) == claimed


@pytest.mark.slow
def test_the_score_is_the_likelihood_less_the_price_of_the_numbers():
    found = hk.compare(X, Y, TWO)
    for row in found.table:
        likelihood = hk.log_marginal_likelihood(row.kernel, X, Y, row.regularization)
        assert row.log_likelihood == pytest.approx(float(likelihood), rel=1e-9)
        assert row.parameters == 3  # a lengthscale, an amplitude, λ
        assert row.score == pytest.approx(float(likelihood) - 1.5 * np.log(48), rel=1e-9)
    assert found.best.name == "energy"
    assert found.best.difference == 0.0
    assert found.answers["energy"] == "yes"
    assert found.differences["energy"] == pytest.approx(-found.table[1].difference)
    assert [found.answers[key] for key in ("friction", "mirror", "T + U")] == ["not tested"] * 3
    report = repr(found)
    assert "an energy?" in report
    assert report.count("\n") > 8
    hk.plot.comparison(found)
    plt.close("all")


def rows(*scores):
    """A table of these (claims, score, log likelihood)."""
    made = [
        Candidate(str(i), frozenset(c), s, 0.0, ll, 3, TWO["any"], jnp.ones(()), {})
        for i, (c, s, ll) in enumerate(scores)
    ]
    return tuple(sorted(made, key=lambda row: -row.score))


def answers(*scores, points=X):
    return _answer(rows(*scores), points, 48).answers


ENERGY, FRICTION, BACK = {"energy"}, {"energy", "friction"}, {"energy", "reversible"}


def test_answers_compare_the_best_yes_with_the_best_no():
    found = answers((ENERGY, 0, 0), (FRICTION, 8, 11), (set(), -20, 0), (BACK, -3, 0))
    assert found["energy"] == "yes"
    assert found["friction"] == "yes"
    assert found["reversible"] == "no"  # with friction nothing runs backwards
    found = answers((ENERGY, 0, 0), (FRICTION, -2, 0.1), (set(), -20, 0), (BACK, 6, 0))
    assert found["friction"] == "no"  # clearly less than without
    assert found["reversible"] == "yes"
    found = answers((ENERGY, 0, 0), (FRICTION, -2, 0.1), (set(), -20, 0))
    assert found["friction"] == "no"  # its best value is within a deviation of zero
    found = answers((ENERGY, 0, 0), (FRICTION, -2, 1.0), (set(), -20, 0))
    assert found["friction"] == "undecided"
    # An H that is even in p has no candidate with friction: it is judged beside its own like.
    found = answers((ENERGY, 0, 0), (FRICTION, 8, 11), (set(), -20, 0), (BACK, 20, 0))
    assert found["friction"] == "yes"
    found = answers((ENERGY, 0, 0), (set(), 4.9, 0))
    assert found["energy"] == "undecided"
    found = answers((ENERGY, 0, 0), (FRICTION, 8, 11), (set(), 20, 0))
    assert found["energy"] == "no"
    assert found["friction"] == "not tested"


def test_a_symmetry_is_not_tested_where_no_data_is_near_the_images():
    odd = ({"mirror"}, 50.0, 0.0)
    assert answers(odd, (set(), 0.0, 0.0))["mirror"] == "yes"
    quadrant = np.abs(X) + 0.3
    assert answers(odd, (set(), 0.0, 0.0), points=quadrant)["mirror"] == "not tested"
    # Around q = 5, but with p of both signs: backward motion can be tested, the mirror cannot.
    beside = X + np.array([12.0, 0.0])
    assert _is_seen(beside, np.array([1.0, -1.0]))
    assert not _is_seen(beside, -np.ones(2))
    assert _is_seen(X, -np.ones(2))


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.compare(X, Y, {"any": hk.Separable(K)}), ValueError, "at least two kernels"),
        (lambda: hk.compare(X, Y, [K, K]), ValueError, "at least two kernels by name"),
        (lambda: hk.compare(X, Y, {**TWO, "k": K}), TypeError, "the candidate 'k' must be"),
        (
            lambda: hk.compare(X, Y, {**TWO, "free": hk.DivergenceFree(K)}),
            ValueError,
            "in two dimensions every divergence-free field",
        ),
        (
            lambda: hk.compare(X[:, :1], Y[:, :1], TWO),
            ValueError,
            "the candidate 'energy' cannot hold",
        ),
        (
            lambda: hk.compare(X, Y, {**TWO, "family": hk.Family(hk.Symplectic(K), K)}),
            TypeError,
            "fields of the state alone",
        ),
        (lambda: hk.compare(X), TypeError, "Y is missing"),
        (lambda: hk.compare(X, Y[:3]), ValueError, "shape"),
    ],
)
def test_what_cannot_be_compared_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_a_comparison_is_a_plain_record():
    assert dataclasses.is_dataclass(Comparison)
    assert math.isnan(_answer(rows((ENERGY, 0, 0), (set(), 0, 0)), X, 48).differences["friction"])


@pytest.mark.slow
def test_a_pendulum_has_an_energy_and_a_mirror_and_friction_is_found():
    # Slow for the compilation of its searches.
    found = hk.compare(X, Y)
    assert found.answers["energy"] == "yes"
    assert found.answers["friction"] != "yes"
    assert "no" not in (found.answers["mirror"], found.answers["T + U"])
    damped = Y - 0.2 * X[:, 1:] * np.array([0.0, 1.0])
    found = hk.compare(X, damped)
    assert found.answers["friction"] == "yes"
    assert found.answers["reversible"] == "no"
    best = found.best
    assert float(best.kernel.friction) == pytest.approx(0.2, abs=0.05)
    assert float(best.hyperparameters["friction"]) == float(best.kernel.friction)
    for row in found.table:  # that of the kernel which is shown
        assert row.parameters == sum(np.size(value) for value in row.hyperparameters.values())
        likelihood = hk.log_marginal_likelihood(row.kernel, X, damped, row.regularization)
        assert row.log_likelihood == pytest.approx(float(likelihood), rel=1e-6)


@pytest.mark.slow
def test_runs_with_friction_have_an_energy():
    """With two starts half of the searches ended where all noise is taken for the field."""
    rng, ts = np.random.default_rng(0), np.linspace(0.0, 6.0, 20)

    def velocity(t, x):
        return [x[1], -np.sin(x[0]) - 0.1 * x[1]]

    firsts = [rng.uniform([-2.5, -2.0], [2.5, 2.0]) for _ in range(3)]
    states = [solve_ivp(velocity, (0, 6), x, t_eval=ts, rtol=1e-8).y.T for x in firsts]
    size = np.concatenate(states).std(axis=0)
    states = [x + 0.02 * size * rng.normal(size=x.shape) for x in states]
    k = hk.Gaussian(jnp.asarray(2 * size))
    found = hk.compare(hk.learn(hk.Separable(k), hk.Runs([ts] * 3, states)))
    assert found.answers == dict.fromkeys(found.answers, "yes") | {"reversible": "no"}


@pytest.mark.slow
def test_runs_are_compared_by_the_rows_of_one_learn():
    field = hk.systems.Pendulum()
    ts = jnp.linspace(0.0, 6.0, 31)
    starts = jnp.array([[1.0, 0.0], [2.0, 0.0], [0.5, 1.0]])
    paths = jax.vmap(lambda x0: hk.simulate(field, x0, ts).ys)(starts)
    noisy = [np.asarray(x) + 0.02 * RNG.normal(size=x.shape) for x in paths]
    runs = hk.Runs([np.asarray(ts)] * 3, noisy)
    found = hk.compare(hk.learn(hk.Separable(K), runs), candidates=TWO)
    assert found.answers["energy"] == "yes"
    with pytest.warns(UserWarning, match="Learn them with the weakest kernel"):
        hk.compare(hk.learn(hk.Symplectic(K), runs), candidates=TWO)
