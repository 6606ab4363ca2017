"""`readout`: formulas read off the measurements, against NumPy's least squares."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._discovery.readout import _select

TERMS = {
    "p**2": lambda x: x[1] ** 2,
    "cos(q)": lambda x: jnp.cos(x[0]),
    "q": lambda x: x[0],
    "q**2": lambda x: x[0] ** 2,
    "q*p": lambda x: x[0] * x[1],
    "q**2*p**2": lambda x: x[0] ** 2 * x[1] ** 2,
}
NOISE = 0.02


def pendulum(friction=0.0, count=30, noise=NOISE, seed=0):
    """States and velocities of H = p²/2 − cos q."""
    rng = np.random.default_rng(seed)
    q, p = rng.uniform(-2, 2, (2, count))
    Y = np.stack([p, -np.sin(q) - friction * p], axis=1)
    return np.stack([q, p], axis=1), Y + noise * rng.normal(size=Y.shape)


def gradients(X):
    """∇φ of the terms, by hand: (N, 2, D)."""
    q, p = X.T
    zero = 0 * q
    return np.stack(
        [
            [zero, 2 * p],
            [-np.sin(q), zero],
            [zero + 1, zero],
            [2 * q, zero],
            [p, q],
            [2 * q * p**2, 2 * q**2 * p],
        ]
    ).transpose(2, 1, 0)


J = np.array([[0.0, 1.0], [-1.0, 0.0]])
KERNEL = hk.Symplectic(2.0 * hk.Gaussian(1.5))
X, Y = pendulum()
LAMBDA = NOISE**2 / len(X)


@pytest.fixture(scope="module")
def posterior():
    return hk.condition(KERNEL, X, Y, LAMBDA)


@pytest.fixture(scope="module")
def formula(posterior):
    return hk.readout(posterior, TERMS)


def test_the_hamiltonian_of_a_pendulum_is_read_off_noisy_velocities(formula):
    assert formula.terms == ("p**2", "cos(q)")
    np.testing.assert_allclose(formula.coefficients, [0.5, -1.0], rtol=0.02)
    off = (np.asarray(formula.coefficients) - [0.5, -1.0]) / np.asarray(formula.deviations)
    assert np.abs(off).max() < 3
    assert 0.7 < formula.misfit < 1.3
    assert 0 < formula.probability <= 1


def test_coefficients_are_the_least_squares_of_numpy(formula):
    Phi = np.einsum("ab,ibk->iak", J, gradients(X))[..., :2].reshape(-1, 2)
    theta, square, *_ = np.linalg.lstsq(Phi, Y.reshape(-1))
    np.testing.assert_allclose(formula.coefficients, theta, rtol=1e-10)
    rows = Y.size
    np.testing.assert_allclose(formula.misfit, np.sqrt(square[0] / (rows - 2)) / NOISE, rtol=1e-10)
    # At least the deviations of these terms alone; the selection adds to them.
    alone = np.sqrt(square[0] / (rows - 2) * np.diag(np.linalg.inv(Phi.T @ Phi)))
    assert (np.asarray(formula.deviations) > 0.9 * alone).all()


@pytest.mark.slow
def test_masked_components_noise_energies_and_functionals_are_weighted_as_measured():
    relative = np.linspace(0.5, 2.0, len(X))
    masked = Y.copy()
    masked[::3, 1] = np.nan
    E = X[:8, 1] ** 2 / 2 - np.cos(X[:8, 0]) + 5.0
    points, weights = X[:12].reshape(4, 3, 2), np.ones((4, 3, 2)) / 3
    means = (weights * Y[:12].reshape(4, 3, 2)).sum(axis=(1, 2))
    data = (
        hk.Velocities(X, masked, noise=relative[:, None] * np.ones(2))
        + hk.Energies(X[:8], E, noise=0.1)
        + hk.Functionals(points, weights, means)
    )
    found = hk.readout(hk.condition(KERNEL, data, regularization=1e-5), TERMS, most=2)
    # The same rows by hand, with the constant of the energies as a column of its own.
    B = np.einsum("ab,ibk->iak", J, gradients(X))[..., :2]
    seen = ~np.isnan(masked)
    rows = [(B / relative[:, None, None])[seen], (masked / relative[:, None])[seen]]
    values = np.stack([X[:8, 1] ** 2, np.cos(X[:8, 0])], axis=1)
    sums = np.einsum("rqa,rqak->rk", weights, B[:12].reshape(4, 3, 2, 2))
    Phi = np.concatenate([rows[0], values / 0.1, sums])
    ones = np.zeros((len(Phi), 1))
    ones[len(rows[0]) : len(rows[0]) + 8] = 1 / 0.1
    y = np.concatenate([rows[1], E / 0.1, means])
    theta = np.linalg.lstsq(np.hstack([Phi, ones]), y)[0]
    assert found.terms == ("p**2", "cos(q)")
    np.testing.assert_allclose(found.coefficients, theta[:2], rtol=1e-8)


def test_the_best_subset_is_that_of_a_loop_over_numpy_least_squares():
    rng = np.random.default_rng(3)
    Phi = rng.normal(size=(25, 6)) * 10.0 ** np.arange(-3, 3)
    y = Phi[:, [1, 4]] @ [30.0, 0.2] + 0.5 * rng.normal(size=25)

    def score(subset):
        left = y - Phi[:, subset] @ np.linalg.lstsq(Phi[:, subset], y)[0]
        k = len(subset)
        return 25 * math.log(left @ left) + k * math.log(25) + 2 * math.log(math.comb(6, k))

    every = [list(s) for k in (1, 2, 3) for s in itertools.combinations(range(6), k)]
    scores = np.array([score(s) for s in every])
    found = _select(Phi, y, 3)
    assert list(found.subset) == every[int(scores.argmin())]
    weights = np.exp(-0.5 * (scores - scores.min()))
    np.testing.assert_allclose(found.probability, 1 / weights.sum(), rtol=1e-8)
    # The deviation is that of the mixture of all subsets.
    w, total = weights / weights.sum(), 0.0
    theta = dict(zip(found.subset, found.coefficients, strict=True))
    for share, s in zip(w, every, strict=True):
        value, variance = 0.0, 0.0
        if found.subset[0] in s:
            A = Phi[:, s]
            fit = np.linalg.lstsq(A, y)[0]
            i = s.index(found.subset[0])
            value = fit[i]
            variance = ((y - A @ fit) ** 2).sum() / (25 - len(s)) * np.linalg.inv(A.T @ A)[i, i]
        total += share * (variance + (value - theta[found.subset[0]]) ** 2)
    np.testing.assert_allclose(found.deviations[0], math.sqrt(total), rtol=1e-6)


@pytest.mark.parametrize("apart", [1e-3, 1e-6, 1e-9])
def test_nearly_dependent_terms_cost_no_more_digits_than_their_condition(apart):
    rng = np.random.default_rng(0)
    Phi = rng.normal(size=(40, 3))
    Phi[:, 1] = Phi[:, 0] + apart * Phi[:, 1]
    y = Phi @ [1.0, 2.0, 3.0]
    found = _select(Phi, y, 3)
    assert found.subset == (0, 1, 2)
    # The normal equations would lose twice as many digits: all of them at 1e-9.
    np.testing.assert_allclose(found.coefficients, [1.0, 2.0, 3.0], rtol=1e-14 / apart)


def test_data_without_noise_gives_the_formula_to_rounding_and_no_term_more():
    X, Y = pendulum(noise=0.0)
    found = hk.readout(hk.condition(KERNEL, X, Y, 1e-10), TERMS)
    assert found.terms == ("p**2", "cos(q)")
    np.testing.assert_allclose(found.coefficients, [0.5, -1.0], rtol=1e-12)
    assert (np.asarray(found.deviations) < 1e-12).all()


@pytest.mark.slow
def test_friction_is_that_of_the_kernel():
    X, Y = pendulum(friction=0.3)
    damped = hk.PortHamiltonian(2.0 * hk.Gaussian(1.5), friction=0.3)
    found = hk.readout(hk.condition(damped, X, Y, LAMBDA), TERMS)
    assert found.terms == ("p**2", "cos(q)")
    np.testing.assert_allclose(found.coefficients, [0.5, -1.0], rtol=0.03)
    # Negative control: with J in place of J − R no formula explains the data.
    with pytest.warns(UserWarning, match="a term is missing"):
        hk.readout(hk.condition(KERNEL, X, Y, LAMBDA), TERMS)


@pytest.mark.slow
def test_a_mean_is_taken_off_and_inputs_do_not_enter_the_drift():
    kinetic = hk.systems.HarmonicOscillator(mass=1.0, stiffness=1e-12)
    posterior = hk.condition(KERNEL, X, Y, LAMBDA, mean=kinetic)
    found = hk.readout(posterior, TERMS)
    assert found.terms == ("cos(q)",)
    x = jnp.array([0.3, 0.4])
    np.testing.assert_allclose(found(x), [0.4, -math.sin(0.3)], atol=0.01)
    np.testing.assert_allclose(
        found.hamiltonian(x) - found.hamiltonian(0 * x),
        0.08 + 1 - math.cos(0.3),
        atol=0.01,
    )
    U = np.random.default_rng(1).normal(size=(len(X), 1))
    driven = Y + U @ [[0.0, 1.5]]
    for G in (hk.InputMatrix(4.0, acts_on=(1,)), np.array([[0.0], [1.5]])):
        K = hk.Controlled(KERNEL, inputs=G)
        found = hk.readout(hk.condition(K, X, driven, LAMBDA, inputs=U), TERMS)
        assert found.terms == ("p**2", "cos(q)")
        np.testing.assert_allclose(found.coefficients, [0.5, -1.0], rtol=0.03)
        np.testing.assert_allclose(found(x), [0.4, -math.sin(0.3)], atol=0.02)


@pytest.mark.slow
def test_masses_and_poisson_tensors_bring_their_own_operator():
    rng = np.random.default_rng(2)
    Z = rng.uniform(-1, 1, (40, 4))
    masses = np.array([1.0, 3.0])
    slopes = np.stack([2 * Z[:, 0] - Z[:, 1], 2 * Z[:, 1] - Z[:, 0]], axis=1)
    V = np.concatenate([Z[:, 2:], -slopes / masses], axis=1)
    terms = {
        "v1**2": lambda x: x[2] ** 2,
        "v2**2": lambda x: x[3] ** 2,
        "q1**2": lambda x: x[0] ** 2,
        "q2**2": lambda x: x[1] ** 2,
        "q1*q2": lambda x: x[0] * x[1],
    }
    K = hk.UnknownMasses(hk.Symplectic(2.0 * hk.Gaussian(2.0)), masses)
    found = hk.readout(hk.condition(K, Z, V, 1e-8), terms, most=5)
    np.testing.assert_allclose(found.coefficients, [0.5, 1.5, 1.0, 1.0, -1.0], rtol=1e-9)
    body = hk.systems.RigidBody()
    Z = jnp.asarray(Z[:, :3])
    V = jax.vmap(body)(Z)
    squares = {f"x{i + 1}**2": lambda x, i=i: x[i] ** 2 for i in range(3)}
    K = hk.Poisson(2.0 * hk.Gaussian(2.0), hk.poisson.rigid_body)
    # Σ xᵢ² is a Casimir, so the three squares are dependent; two of them are not.
    with pytest.raises(ValueError, match="linearly dependent on the data"):
        hk.readout(hk.condition(K, Z, V, 1e-8), squares)
    two = {name: squares[name] for name in ("x1**2", "x2**2")}
    found = hk.readout(hk.condition(K, Z, V, 1e-8), two)
    np.testing.assert_allclose(jax.vmap(found)(Z), V, atol=1e-12)
    casimir = {"x1**2": squares["x1**2"], "C": lambda x: x @ x}
    with pytest.raises(ValueError, match="has no effect on the data"):
        hk.readout(hk.condition(K, Z, V, 1e-8), casimir)


def test_a_formula_is_a_field_that_simulates_and_conserves_its_energy(formula):
    path = hk.simulate(formula, jnp.array([1.0, 0.0]), jnp.linspace(0.0, 5.0, 11)).ys
    energies = jax.jit(jax.vmap(formula.hamiltonian))(path)
    np.testing.assert_allclose(energies, energies[0], atol=1e-5)


def test_a_formula_prints_as_one(formula):
    assert repr(formula).startswith("H = 0.")
    assert " p**2 - " in repr(formula)
    assert " cos(q)    [misfit " in repr(formula)
    assert formula.latex().startswith("H = 0.")
    assert r"\,p^{2} - " in formula.latex()
    assert formula.latex().endswith(r"\,\cos(q)")


def test_a_symmetric_kernel_takes_terms_with_its_symmetry():
    odd = hk.condition(hk.Odd(KERNEL), X, Y, LAMBDA)
    with pytest.raises(ValueError, match="a symmetry of the potential that 'q' does not have"):
        hk.readout(odd, TERMS)
    even = {name: fn for name, fn in TERMS.items() if name != "q"}
    assert hk.readout(odd, even).terms == ("p**2", "cos(q)")


@pytest.mark.parametrize(
    ("terms", "error", "says"),
    [
        ({}, TypeError, "at least one"),
        ([jnp.sin], TypeError, "must be a dictionary of functions"),
        ({"q": 3.0}, TypeError, "the term 'q' is a float"),
        (
            {"q": lambda x: x},
            ValueError,
            r"maps a state of shape \(2,\) to float64 of shape \(2,\)",
        ),
        ({"q": lambda x: math.sin(x[0])}, TypeError, "jax.numpy in place of numpy and math"),
        ({"log": lambda x: jnp.log(x[0])}, ValueError, "'log' is not finite at some"),
        (TERMS | {"one": lambda x: 0 * x[0] + 1}, ValueError, "'one' has no effect"),
        (
            TERMS | {"sin2": lambda x: jnp.sin(x[0]) ** 2, "cos2": lambda x: jnp.cos(x[0]) ** 2},
            ValueError,
            "'sin2' and 'cos2' are linearly dependent",
        ),
        (
            {f"{a}": lambda x, a=a: jnp.sin(a * x[0]) for a in range(1, 62)},
            ValueError,
            "61 terms and 60 rows",
        ),
    ],
)
def test_a_dictionary_that_cannot_be_read_off_is_refused(posterior, terms, error, says):
    with pytest.raises(error, match=says):
        hk.readout(posterior, terms)


def test_what_has_no_measurements_no_potential_or_too_many_subsets_is_refused():
    with pytest.raises(TypeError, match="which contains the measurements"):
        hk.readout(hk.fit(KERNEL, X, Y, LAMBDA), TERMS)  # type: ignore[arg-type]
    free = hk.condition(hk.Separable(2.0 * hk.Gaussian(1.0)), X, Y, LAMBDA)
    with pytest.raises(AttributeError, match="there is no potential to read a formula of"):
        hk.readout(free, TERMS)
    theta = np.linspace(0.5, 1.0, len(X))[:, None]
    family = hk.condition(hk.Family(KERNEL), X, Y, LAMBDA, parameters=theta)
    with pytest.raises(TypeError, match="takes one system and this is a family"):
        hk.readout(family, TERMS)
    with pytest.raises(ValueError, match="all are compared: give fewer terms"):
        _select(np.random.default_rng(0).normal(size=(90, 57)), np.ones(90), 6)


@pytest.mark.slow
def test_the_hamiltonian_of_a_pendulum_is_read_off_noisy_runs():
    system = hk.systems.Pendulum(mass=1.0, length=1.0, gravity=1.0)
    times = np.linspace(0.0, 9.0, 61)
    paths = np.asarray(hk.systems.sample(system, np.array([[2.2, 0.0], [0.0, 1.2]]), times)[0])
    states = paths + 0.01 * np.random.default_rng(0).normal(size=paths.shape)
    learned = hk.learn(hk.Symplectic(hk.Gaussian(1.0)), hk.Runs([times] * 2, list(states)))
    found = hk.readout(learned, TERMS)
    assert found.terms[:2] == ("p**2", "cos(q)")
    # One log in four has a term more, here q² with a coefficient of -.0026 ± .0018.
    true = np.append([0.5, -1.0], np.zeros(len(found.terms) - 2))
    assert (np.abs(found.coefficients - true) < 2 * np.asarray(found.deviations)).all()
    np.testing.assert_allclose(found.coefficients, true, atol=0.01)
