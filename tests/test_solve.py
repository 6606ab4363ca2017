"""Solvers that never form the Gram, against the same algebra done densely in NumPy."""

import os
import subprocess
import sys
import types
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data import swings

import hamkernel as hk
from hamkernel import ConjugateGradient, Nystrom
from hamkernel import _machine as _memory
from hamkernel._sizes import sizes
from hamkernel._solvers import fit as _fit
from hamkernel._solvers.landmarks import choose_landmarks

K = hk.Symplectic(hk.Gaussian(1.5))
RIDGE = 1e-4


def dense(K, X, Z=None):
    Z = X if Z is None else Z
    return np.asarray(hk.gram(K, X, Z)).reshape(np.size(X), np.size(Z))


def exact(K, X, Y, regularization):
    """Coefficients and fitted values of the dense system."""
    G = dense(K, X)
    a = np.linalg.solve(G + len(X) * regularization * np.eye(len(G)), Y.ravel())
    return a.reshape(X.shape), (G @ a).reshape(X.shape)


def info(field) -> Any:
    return field.info


def fitted(field, Y):
    return Y - np.asarray(field.residual)


def relative(a, b):
    return np.linalg.norm(np.asarray(a) - b) / np.linalg.norm(b)


# Nystrom.


def slow(*names):
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "name", ["odd", *slow("symplectic", "sum", "divergence_free", "separable")]
)
def test_nystrom_is_the_exact_fit_where_the_tolerance_is_small(name):
    K = {
        "symplectic": hk.Symplectic(hk.Gaussian(1.5)),
        "odd": hk.Odd(hk.Symplectic(hk.Gaussian(1.5))),
        "sum": hk.CurlFree(hk.Gaussian(2.0)) + hk.Symplectic(hk.Gaussian(1.5)),
        "divergence_free": hk.DivergenceFree(hk.Gaussian(1.5)),
        "separable": hk.Separable(hk.RationalQuadratic(1.0, 2.0)),
    }[name]
    X, Y = swings(150)
    field = hk.fit(K, X, Y, RIDGE, solver=Nystrom(tolerance=1e-5))
    _, values = exact(K, X, Y, RIDGE)
    assert relative(fitted(field, Y), values) < 1e-7  # tolerance × noise
    assert len(field.points) < len(X)
    np.testing.assert_allclose(fitted(field, Y), field.evaluate(X), atol=1e-9)
    kept = np.asarray(info(field).rank)
    assert kept <= field.points.size


@pytest.mark.few(1)
@pytest.mark.parametrize("tolerance", [10.0, 0.1, 1e-3])
def test_fitted_values_are_within_the_tolerance_times_the_residual(tolerance):
    X, Y = swings(150)
    field = hk.fit(K, X, Y, RIDGE, solver=Nystrom(tolerance=tolerance))
    _, values = exact(K, X, Y, RIDGE)
    off = np.linalg.norm(fitted(field, Y) - values) / np.linalg.norm(field.residual)
    assert info(field).truncation <= tolerance
    assert off <= info(field).truncation
    if tolerance == 10.0:  # the bound is about something: few landmarks are not the exact fit
        assert off > 1e-3


def of_every_kind(n=24):
    """Few velocities beside many other observations, of the swings' field and its energy."""
    X, Y = swings(n + 3)
    H = X[3:, 1] ** 2 / 2 - np.cos(X[3:, 0])
    paths = X[3:, None] + np.linspace(-0.2, 0.2, 3)[:, None]
    weights = np.ones((n, 3, 2))
    field = np.stack([paths[..., 1], -np.sin(paths[..., 0])], axis=2)
    masked = np.where([[True, False]], np.nan, Y[:3])
    return {
        "energies": hk.Velocities(X[:3], Y[:3]) + hk.Energies(X[3:], H),
        "noise": hk.Velocities(X[:3], masked, noise=2.0) + hk.Energies(X[3:], H, noise=0.01),
        "functionals": hk.Velocities(X[:3], Y[:3])
        + hk.Functionals(paths, weights, np.sum(weights * field, axis=(1, 2))),
    }


@pytest.mark.slow
@pytest.mark.parametrize("smoothness", [1.5, 2.5])
@pytest.mark.parametrize("kind", ["energies", "noise", "functionals"])
def test_landmarks_are_rows_of_whatever_was_observed(kind, smoothness):
    data = of_every_kind()[kind]
    rough = hk.Symplectic(100.0 * hk.Matern(smoothness, 1.0))
    exact, low_rank = (
        hk.condition(rough, data, regularization=1e-5, solver=solver)
        for solver in (hk.Cholesky(), Nystrom(tolerance=1e-8))
    )
    Z = swings(20, seed=9)[0]
    assert relative(low_rank.field.evaluate(Z), np.asarray(exact.field.evaluate(Z))) < 1e-7
    of_energy = [p.energy_deviation(Z[0], Z[1]) for p in (low_rank, exact)]
    np.testing.assert_allclose(*of_energy, rtol=1e-7)
    assert float(info(low_rank.field).truncation) < 1e-6


@pytest.mark.slow
def test_observations_are_cut_off_at_the_tolerance():
    data = of_every_kind()["energies"]
    rough = hk.Symplectic(100.0 * hk.Matern(1.5, 1.0))
    exact = hk.fit(rough, data, regularization=1e-1)
    field = hk.fit(rough, data, regularization=1e-1, solver=Nystrom(tolerance=3.0))
    assert 1e-3 < float(info(field).truncation) <= 3.0
    off = np.linalg.norm(np.asarray(field.residual) - np.asarray(exact.residual))
    assert 0 < off <= float(info(field).truncation) * np.linalg.norm(exact.residual)


@pytest.mark.slow
def test_too_few_rows_for_landmarks_are_said():
    data, rough = of_every_kind()["energies"], hk.Symplectic(100.0 * hk.Matern(1.5, 1.0))
    with pytest.warns(UserWarning, match=r"8 landmarks leave .* Raise max_points"):
        hk.fit(rough, data, regularization=1e-1, solver=Nystrom(max_points=4))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* landmarks leave")  # a part has not all that the rest has
def test_a_part_of_many_observations_has_the_landmarks_for_all():
    X, Y = swings(300)
    data = hk.Velocities(X[:50], Y[:50], noise=0.5) + hk.Energies(
        X[50:], X[50:, 1] ** 2 / 2 - np.cos(X[50:, 0])
    )
    exact = hk.fit(K, data, regularization=RIDGE)
    Z = swings(20, seed=9)[0]

    def fit(data):
        return hk.fit(K, data, regularization=RIDGE, solver=Nystrom(0.1, 200, 150)).evaluate(Z)

    for values in (fit(data), jax.jit(fit)(data)):
        assert relative(values, np.asarray(exact.evaluate(Z))) < 1e-2


@pytest.mark.slow
def test_a_low_rank_loss_of_observations_is_the_dense_one_where_landmarks_suffice():
    data = of_every_kind()["energies"]
    rough = hk.Symplectic(100.0 * hk.Matern(2.5, 1.0))
    options: Any = {"starts": 1, "max_steps": 1, "frozen": ("regularization", "lengthscale")}
    dense = hk.tune(rough, data, regularization=1e-4, **options)
    tuned = hk.tune(rough, data, regularization=1e-4, solver=Nystrom(1e-8), **options)
    np.testing.assert_allclose(tuned.loss, dense.loss, rtol=1e-5)


def test_the_truncation_and_the_norm_are_those_of_numpy():
    X, Y = swings(150)
    field = hk.fit(K, X, Y, RIDGE, solver=Nystrom())
    S, a = np.asarray(field.points), np.asarray(field.coefficients).ravel()
    used = np.abs(a) > 0
    C, G = dense(K, X, S)[:, used], dense(K, S)[np.ix_(used, used)]
    F = np.linalg.solve(np.linalg.cholesky(G), C.T).T
    ridge = len(X) * RIDGE
    left = (np.trace(dense(K, X)) - np.sum(F**2)) / ridge
    np.testing.assert_allclose(info(field).truncation, left, rtol=1e-6)
    np.testing.assert_allclose(field.norm, np.sqrt(a[used] @ G @ a[used]), rtol=1e-8)
    stacked = np.concatenate([F, np.sqrt(ridge) * np.eye(F.shape[1])])
    w = np.linalg.lstsq(stacked, np.append(Y, np.zeros(F.shape[1])), rcond=None)[0]
    np.testing.assert_allclose(fitted(field, Y).ravel(), F @ w, atol=1e-10)


@pytest.mark.slow
def test_a_larger_ridge_needs_fewer_landmarks():
    X, Y = swings(400)
    counts = [
        int(info(hk.fit(K, X, Y, regularization, solver=Nystrom())).landmarks)
        for regularization in (1e-2, 1e-4, 1e-6)
    ]
    assert counts[0] < counts[1] < counts[2] < 100


def test_the_number_of_landmarks_is_near_the_best_rank():
    X, _ = swings(400)
    left = 1e-5
    chosen = choose_landmarks(K, jnp.asarray(X), jnp.asarray(left), 200, 400, jax.random.key(1))
    eigenvalues = np.linalg.eigvalsh(dense(K, X))[::-1]
    best = np.argmax(eigenvalues.sum() - np.cumsum(eigenvalues) < left * len(X))
    assert best / 2 < int(chosen.kept.sum()) < 2 * best  # points have two columns each


@pytest.mark.slow
def test_repeated_and_mirrored_points_are_taken_once():
    X, Y = swings(40)
    X, Y = np.concatenate([X, X, -X]), np.concatenate([Y, Y, -Y])
    odd = hk.Odd(K)
    field = hk.fit(odd, X, Y, RIDGE, solver=Nystrom(tolerance=1e-4))
    assert int(info(field).rank) <= 2 * 40
    _, values = exact(odd, X, Y, RIDGE)
    assert relative(fitted(field, Y), values) < 1e-6


def test_no_digits_are_lost_to_normal_equations():
    """At λ = 1e-11 the sums alone keep five digits; with the refinement the fit is that of QR."""
    X, Y = swings(300)
    regularization = 1e-11
    field = hk.fit(K, X, Y, regularization, solver=Nystrom(tolerance=10.0))
    S = np.asarray(field.points)
    used = np.abs(np.asarray(field.coefficients).ravel()) > 0
    C, G = dense(K, X, S)[:, used], dense(K, S)[np.ix_(used, used)]
    F = np.linalg.solve(np.linalg.cholesky(G), C.T).T
    ridge, r = len(X) * regularization, F.shape[1]
    stacked = np.concatenate([F, np.sqrt(ridge) * np.eye(r)])
    w = np.linalg.lstsq(stacked, np.append(Y, np.zeros(r)), rcond=None)[0]
    assert relative(fitted(field, Y).ravel(), F @ w) < 1e-6
    alpha = np.linalg.solve(C.T @ C + ridge * G, C.T @ Y.ravel())
    assert relative(C @ alpha, F @ w) > 1e-5  # the normal equations in the coefficients


@pytest.mark.slow
def test_candidates_that_are_a_part_of_the_data_give_the_same_field():
    X, Y = swings(600)
    field = hk.fit(K, X, Y, RIDGE, solver=Nystrom(candidates=200, key=jax.random.key(5)))
    _, values = exact(K, X, Y, RIDGE)
    off = np.linalg.norm(fitted(field, Y) - values) / np.linalg.norm(field.residual)
    assert off < info(field).truncation < 0.2
    again = hk.fit(K, X, Y, RIDGE, solver=Nystrom(candidates=200, key=jax.random.key(5)))
    np.testing.assert_array_equal(field.coefficients, again.coefficients)
    other = hk.fit(K, X, Y, RIDGE, solver=Nystrom(candidates=200, key=jax.random.key(6)))
    assert field.points.shape != other.points.shape or np.any(field.points != other.points)


def test_nystrom_has_a_hamiltonian_and_a_field_that_is_its_flow():
    X, Y = swings(150)
    field = hk.fit(K, X, Y, RIDGE, solver=Nystrom())
    x = jnp.array([0.3, -0.4])
    q_slope, p_slope = jax.grad(field.hamiltonian)(x)
    np.testing.assert_allclose(field(x), [p_slope, -q_slope], atol=1e-12)


@pytest.mark.slow
def test_nystrom_works_under_jit_and_its_gradient_is_that_of_finite_differences():
    X, Y = swings(40)
    solver = Nystrom(tolerance=1e-3, max_points=40)

    def loss(log_lengthscale):
        K = hk.Symplectic(hk.Gaussian(jnp.exp(log_lengthscale)))
        field = hk.fit(K, X, Y, 1e-3, solver=solver)
        return jnp.sum(field(jnp.array([0.2, 0.1])) ** 2) + jnp.sum(field.residual**2)

    start, step = jnp.asarray(0.4), 1e-4
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(eqx.filter_jit(loss)(start), loss(start), rtol=1e-5)
    slope = jax.jit(jax.grad(loss))(start)

    def objective(log_lengthscale):  # the exact fit, which this tolerance stands for
        K = hk.Symplectic(hk.Gaussian(jnp.exp(log_lengthscale)))
        field = hk.fit(K, X, Y, 1e-3)
        return jnp.sum(field(jnp.array([0.2, 0.1])) ** 2) + jnp.sum(field.residual**2)

    expected = (objective(start + step) - objective(start - step)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-3)


def test_too_few_landmarks_are_said():
    X, Y = swings(150)
    with pytest.warns(UserWarning, match=r"4 landmarks leave .* Raise max_points"):
        field = hk.fit(K, X, Y, RIDGE, solver=Nystrom(max_points=4))
    assert info(field).truncation > 0.1
    assert int(info(field).landmarks) == 4


def test_nystrom_refuses_what_makes_no_sense():
    with pytest.raises(ValueError, match="tolerance must be positive"):
        Nystrom(tolerance=0.0)
    with pytest.raises(ValueError, match="at least 1"):
        Nystrom(max_points=0)
    with pytest.raises(ValueError, match=r"most 100 landmarks write hk.Nystrom\(max_points=100\)"):
        Nystrom(100)
    with pytest.raises(ValueError, match=r"hk.Nystrom\(max_points=100\)"):
        Nystrom(np.int64(100))  # pyright: ignore[reportArgumentType]
    for wrong in (True, "0.1", None):
        with pytest.raises(TypeError, match="tolerance must be a number; got"):
            Nystrom(wrong)  # pyright: ignore[reportArgumentType]
    assert Nystrom(100.0).tolerance == 100.0


@pytest.mark.slow
def test_second_derivatives_of_a_fit_on_landmarks_are_those_of_differences():
    X, Y = np.random.default_rng(0).normal(size=(2, 20, 2))
    solver = Nystrom(tolerance=1e9, points=X[::3])

    def norm(lengthscale):
        return hk.fit(hk.Symplectic(hk.Matern(2.5, lengthscale)), X, Y, 1e-2, solver=solver).norm

    slope, h = jax.jit(jax.grad(norm)), 1e-4
    expected = (slope(1.2 + h) - slope(1.2 - h)) / (2 * h)
    np.testing.assert_allclose(jax.hessian(norm)(1.2), expected, rtol=1e-6)


@pytest.mark.slow
def test_a_kernel_that_is_not_positive_is_refused():
    X, Y = swings(60)
    with pytest.raises(RuntimeError, match="check_kernel"):
        hk.fit(hk.CurlFree(lambda x, z: jnp.linalg.norm(x - z)), X, Y, RIDGE, solver=Nystrom())
    with pytest.raises(RuntimeError, match="did not converge"):
        hk.fit(hk.CurlFree(lambda x, z: -x @ z), X, Y, RIDGE, solver=ConjugateGradient())


# Conjugate gradients.


@pytest.mark.parametrize("name", ["symplectic", *slow("odd", "rough")])
def test_conjugate_gradients_find_the_exact_coefficients(name):
    K = {
        "symplectic": hk.Symplectic(hk.Gaussian(1.5)),
        "odd": hk.Odd(hk.Symplectic(hk.Gaussian(1.5))),
        "rough": hk.Symplectic(hk.Matern(1.5, 1.0)),
    }[name]
    X, Y = swings(150, n=4)
    field = hk.fit(K, X, Y, RIDGE, solver=ConjugateGradient())
    a, values = exact(K, X, Y, RIDGE)
    assert relative(field.coefficients, a) < 1e-7
    np.testing.assert_allclose(fitted(field, Y), values, atol=1e-7)
    np.testing.assert_allclose(field.norm, np.sqrt(np.sum(a * values)), rtol=1e-6)
    system = dense(K, X) + len(X) * RIDGE * np.eye(X.size)
    left = np.linalg.norm(Y.ravel() - system @ np.asarray(field.coefficients).ravel())
    np.testing.assert_allclose(
        info(field).relative_residual, left / np.linalg.norm(Y), rtol=1e-3, atol=1e-14
    )
    assert info(field).relative_residual < 1e-8
    assert 1 <= int(info(field).iterations) <= 30


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["states", "rows"])
def test_iterations_that_are_shown_end_at_the_same_field(kind, capsys, monkeypatch):
    X, Y = swings(150)
    data: Any = (X, Y) if kind == "states" else (hk.Velocities(X, Y, noise=0.5),)
    solver = ConjugateGradient(preconditioner=Nystrom(10.0, max_points=8))
    silent = hk.fit(K, *data, regularization=RIDGE, solver=solver)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    shown = hk.fit(K, *data, regularization=RIDGE, solver=solver, progress=True)
    assert relative(shown.coefficients, np.asarray(silent.coefficients)) < 1e-5
    assert abs(int(info(shown).iterations) - int(info(silent).iterations)) <= 2
    said = capsys.readouterr().err
    assert "conjugate gradients" in said
    assert "residual" in said


@pytest.mark.parametrize("ask", [hk.fit, hk.condition])
def test_blocks_of_a_factorisation_are_shown(ask, capsys, monkeypatch):
    small = sizes()._replace(rows_in_place=1000)
    monkeypatch.setattr("hamkernel._solvers.dense.sizes", lambda: small)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    model = hk.Odd(hk.Symplectic(2.0 * hk.Gaussian(1.0)))
    ask(model, *swings(600), regularization=RIDGE, progress=True)
    assert "factor" in capsys.readouterr().err
    ask(model, *swings(600), regularization=RIDGE)
    assert "factor" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_new_tolerance_of_conjugate_gradients_compiles_nothing():
    traces = []

    def kernel(x, z):
        traces.append(1)
        return jnp.exp(-((x - z) @ (x - z)))

    X, Y = swings(20)
    for tolerance, new in (1e-6, True), (1e-7, False):
        hk.fit(hk.Symplectic(kernel), X, Y, RIDGE, solver=ConjugateGradient(tolerance))
        assert bool(traces) == new
        traces.clear()


@pytest.mark.slow
def test_landmarks_precondition():
    X, Y = swings(150, n=4)
    counts = [
        int(info(hk.fit(K, X, Y, RIDGE, solver=ConjugateGradient(1e-6, 2000, p))).iterations)
        for p in (Nystrom(10.0, 64), Nystrom(1e5, 1))
    ]
    assert counts[0] <= 15 < 2 * counts[0] < counts[1]


@pytest.mark.few(1)
@pytest.mark.parametrize("structure", [hk.Symplectic, hk.Separable])
@pytest.mark.parametrize(
    "kernel", [lambda x, z: jnp.tanh(x @ z - 1.0), lambda x, z: jnp.tanh(0.1 * x @ z + 1.0)]
)
@pytest.mark.parametrize("solver", [Nystrom(), ConjugateGradient(1e-6)], ids=["low rank", "CG"])
def test_a_low_rank_gram_that_is_larger_than_the_gram_is_refused(structure, kernel, solver):
    X, Y = swings(40)
    assert np.linalg.eigvalsh(dense(structure(kernel), X)).min() < -0.1
    with pytest.raises(RuntimeError, match=r"not positive definite|did not converge") as refused:
        hk.fit(structure(kernel), X, Y, 1e-3, solver=solver)
    assert "check_kernel" in str(refused.value)


@pytest.mark.slow
def test_conjugate_gradients_that_do_not_converge_say_so():
    X, Y = swings(150)
    solver = ConjugateGradient(1e-12, max_iterations=2, preconditioner=Nystrom(1e5, 1))
    with pytest.raises(RuntimeError, match=r"converge after 2 iterations.*max_iterations"):
        hk.fit(K, X, Y, RIDGE, solver=solver)


@pytest.mark.slow
def test_the_gradient_of_conjugate_gradients_is_that_of_cholesky():
    X, Y = swings(40)

    def loss(log_lengthscale, solver):
        K = hk.Symplectic(hk.Gaussian(jnp.exp(log_lengthscale)))
        field = hk.fit(K, X, Y, 1e-3, solver=solver)
        return jnp.sum(field(jnp.array([0.2, 0.1])) ** 2)

    start = jnp.asarray(0.4)
    iterative = ConjugateGradient(1e-10, preconditioner=Nystrom(10.0, 16))
    slope = jax.jit(jax.grad(lambda s: loss(s, iterative)))(start)
    np.testing.assert_allclose(slope, jax.grad(lambda s: loss(s, hk.Cholesky()))(start), rtol=1e-6)


@pytest.mark.slow
def test_the_gradient_of_conjugate_gradients_in_the_velocities_is_that_of_cholesky():
    X, Y = swings(40)
    iterative = ConjugateGradient(1e-10, preconditioner=Nystrom(10.0, 16))

    def slope(solver):
        return jax.grad(lambda Y: hk.fit(K, X, Y, 1e-3, solver=solver)(X[0])[1])(jnp.asarray(Y))

    expected = slope(hk.Cholesky())
    assert jnp.abs(expected).max() > 1e-3
    np.testing.assert_allclose(slope(iterative), expected, atol=1e-8)


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [Nystrom(1e-6), ConjugateGradient(1e-10)], ids=["low", "cg"])
def test_a_kernel_may_have_leaves_that_are_no_arrays(solver):
    net = eqx.nn.MLP(2, 3, 4, 1, activation=jnp.tanh, key=jax.random.key(0))
    net = jax.tree.map(lambda a: a.astype(float) if eqx.is_inexact_array(a) else a, net)
    K, (X, Y) = hk.Symplectic(hk.Warp(hk.Gaussian(1.0), net)), swings(40)
    field = hk.fit(K, X, Y, 1e-3, solver=solver)
    _, values = exact(K, X, Y, 1e-3)
    assert relative(fitted(field, Y), values) < 1e-5


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "solver",
    [hk.Cholesky(), Nystrom(), ConjugateGradient(), hk.RandomFeatures(20, jax.random.key(0))],
    ids=lambda solver: type(solver).__name__,
)
def test_a_fit_that_fails_says_so_whatever_is_asked_of_it(solver):
    # Under jit a check is dropped together with the value it hangs on.
    X, Y = swings(20)
    broken = eqx.tree_at(lambda K: K.kernel.log_lengthscale, K, jnp.nan)
    with pytest.raises(RuntimeError, match="check_kernel"):
        hk.fit(broken, X, Y, 1e-3, solver=solver)
    for part in (lambda f: f.norm, lambda f: f.residual, lambda f: f(X[0])):
        with pytest.raises(Exception, match="check_kernel"):
            eqx.filter_jit(lambda K, part=part: part(hk.fit(K, X, Y, 1e-3, solver=solver)))(broken)


def test_conjugate_gradients_refuse_what_makes_no_sense():
    with pytest.raises(ValueError, match="tolerance must be positive"):
        ConjugateGradient(tolerance=-1.0)
    with pytest.raises(ValueError, match="at least 1"):
        ConjugateGradient(max_iterations=0)


# The choice.


@pytest.mark.slow
def test_a_dense_fit_is_chosen_where_it_takes_half_of_the_memory(monkeypatch):
    X, Y = swings(20)
    need = 4 * 40**2 * 8
    monkeypatch.setattr(_fit, "memory_bytes", lambda: 2 * need)
    assert info(hk.fit(K, X, Y, RIDGE)).solver == "Cholesky"
    monkeypatch.setattr(_fit, "memory_bytes", lambda: 2 * need - 1)
    assert info(hk.fit(K, X, Y, RIDGE)).solver == "ConjugateGradient"
    assert info(hk.fit(K, X, Y, RIDGE, solver=hk.Cholesky())).solver == "Cholesky"


@pytest.mark.slow
def test_a_factor_made_in_place_is_that_of_lapack(monkeypatch):
    K, (X, Y) = hk.Symplectic(1.1 * hk.Gaussian(1.5)), swings(150)
    one = hk.condition(K, X, Y, RIDGE)
    small = sizes()._replace(rows_in_place=200, strip_entries=7000)
    monkeypatch.setattr("hamkernel._solvers.dense.sizes", lambda: small)
    monkeypatch.setattr("hamkernel._solvers.factors.ROWS_IN_PLACE", 130)
    monkeypatch.setattr("hamkernel._solvers.dense.ROWS_IN_PLACE", 130)
    monkeypatch.setattr("hamkernel._gram.sizes", lambda: small)
    blocks = hk.condition(K, X, Y, RIDGE)
    A = dense(K, X) + len(X) * RIDGE * np.eye(X.size)
    given: Any = blocks.given
    np.testing.assert_allclose(given.factor.R, np.linalg.cholesky(A).T, atol=1e-12)
    np.testing.assert_allclose(given.factor.size, np.linalg.norm(A))
    assert relative(blocks.field.evaluate(X), np.asarray(one.field.evaluate(X))) < 1e-12
    np.testing.assert_allclose(blocks.deviation(X[0]), one.deviation(X[0]), rtol=1e-8)
    with pytest.raises(RuntimeError, match="not positive definite"):
        hk.fit(hk.Symplectic(lambda x, z: -jnp.exp(-((x - z) @ (x - z)))), X, Y, RIDGE)


PEAK = """
import itertools, json, resource, sys, warnings
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
import hamkernel as hk

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

name, D = sys.argv[1], int(sys.argv[2])
swaps = []
for a, b in ((0, 1), (1, 2)):
    S = np.eye(9)
    S[[*range(3 * a, 3 * a + 3), *range(3 * b, 3 * b + 3)]] = S[
        [*range(3 * b, 3 * b + 3), *range(3 * a, 3 * a + 3)]
    ]
    swaps.append(S.tolist())

def distances(x):
    r = x.reshape(3, 3)
    return jnp.sum((r[jnp.array([0, 0, 1])] - r[jnp.array([1, 2, 2])]) ** 2, axis=1)

k = hk.Matern(2.5, 2.0)
K, n, act = {
    "plain": (hk.Symplectic(hk.Gaussian(2.0)), 2, hk.fit),
    "kept": (hk.Symplectic(1.5 * hk.Gaussian(2.0)), 2, hk.condition),
    "six permutations": (hk.Invariant(hk.CurlFree(hk.Warp(k, distances)), swaps), 9, hk.fit),
    "noise": (hk.Symplectic(hk.Gaussian(2.0)), 2, None),
}[name]

def data(N):
    X, Y = np.random.default_rng(0).normal(size=(2, N, n))
    if act is not None:
        return act(K, X, Y, 0.1)
    data = hk.Velocities(X[:-20], Y[:-20], noise=2.0) + hk.Energies(X[-20:], Y[-20:, 0])
    return hk.condition(K, data, regularization=0.1)

warnings.simplefilter("ignore")
data(30)
before = peak()
data(D // n)
print(json.dumps((peak() - before) / (8 * D**2)))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "D", "planned"),
    [("plain", 10_000, 2), ("kept", 10_000, 2), ("six permutations", 9_999, 2), ("noise", 4000, 4)],
)
def test_the_peak_memory_of_a_dense_fit_is_what_is_planned(name, D, planned):
    run = [sys.executable, "-c", PEAK, name, str(D)]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    assert float(done.stdout) < planned


def test_a_dense_fit_that_cannot_fit_is_refused_before_it_starts():
    X = np.zeros((10_000_000, 2))
    with pytest.raises(ValueError, match=r"needs 6.4e\+06 GB .* Use solver=hk.ConjugateGradient"):
        hk.fit(K, X, X, RIDGE, solver=hk.Cholesky())


MACHINE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if os.name == "posix" else None


@pytest.mark.skipif(MACHINE is None, reason="asks the operating system")
@pytest.mark.parametrize(
    ("limit", "expected"),
    [("4096\n", 4096), ("max\n", MACHINE), ("9" * 20, MACHINE), (None, MACHINE)],
    ids=["a small container", "no limit", "a limit above all", "no container"],
)
def test_memory_is_that_of_the_machine_or_of_a_smaller_container(
    tmp_path, monkeypatch, limit, expected
):
    if jax.default_backend() != "cpu":
        pytest.skip("the device says what it has")
    file = tmp_path / "memory.max"
    if limit is not None:
        file.write_text(limit)
    monkeypatch.setattr(_memory, "_CGROUP_LIMIT", file)
    assert _memory._memory_of.__wrapped__("cpu") == expected


def test_the_memory_of_a_device_that_says_it_is_believed(monkeypatch):
    class Device:
        def memory_stats(self):
            return {"bytes_in_use": 7, "bytes_limit": 12345}

    monkeypatch.setattr(jax, "local_devices", lambda backend: [Device()])
    assert _memory._memory_of.__wrapped__("cpu") == 12345


def test_where_the_system_does_not_say_its_memory_nothing_is_refused(monkeypatch):
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(
        jax, "local_devices", lambda **_: [types.SimpleNamespace(memory_stats=dict)]
    )
    assert _memory._memory_of.__wrapped__("cpu") is None
    monkeypatch.setattr(_memory, "memory_bytes", lambda: None)
    monkeypatch.setattr(_fit, "memory_bytes", lambda: None)
    X, Y = swings(20)
    assert info(hk.fit(K, X, Y, RIDGE)).solver == "Cholesky"


@pytest.mark.parametrize(("dtype", "size"), [(np.float32, 4), (np.float64, 8)])
def test_what_just_fits_is_not_refused_and_a_byte_less_is_with_its_size(monkeypatch, dtype, size):
    matrices = {1: "one matrix of 3000 by 2000", 3: "3 matrices of 3000 by 2000"}
    for copies, words in matrices.items():
        problem = "a fit", 3000, 2000, jnp.dtype(dtype), copies, "Use less."
        need = size * copies * 3000 * 2000
        monkeypatch.setattr(_memory, "memory_bytes", lambda need=need: need)
        _memory.refuse_beyond_memory(*problem)
        monkeypatch.setattr(_memory, "memory_bytes", lambda need=need: need - 1)
        gigabytes = f"{need / 1e9:.3g} GB"
        with pytest.raises(ValueError, match=rf"a fit needs {gigabytes} \({words}.*Use less\."):
            _memory.refuse_beyond_memory(*problem)


@pytest.mark.slow
def test_landmarks_beyond_the_first_buffer_are_all_different():
    X = np.random.default_rng(0).normal(size=(400, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a hundred do not suffice
        field = hk.fit(hk.Symplectic(hk.Gaussian(1.0)), X, X, solver=Nystrom(max_points=100))
    assert field.points.shape == (100, 4)
    assert len(np.unique(field.points, axis=0)) == 100


SOLVERS = [None, Nystrom(), ConjugateGradient(), hk.RandomFeatures(20, jax.random.key(0))]


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_data_at_the_centre_of_an_odd_kernel_has_the_zero_field(solver):
    field = hk.fit(hk.Odd(K), np.zeros((3, 2)), np.ones((3, 2)), RIDGE, solver=solver)
    assert not field(jnp.ones(2)).any()
    np.testing.assert_allclose(field.residual_norm, 6**0.5, rtol=1e-12)


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", SOLVERS[1:3], ids=lambda solver: type(solver).__name__)
def test_a_gram_without_any_column_above_rounding_is_no_zero_gram(solver):
    X, Y = swings(20)
    with pytest.raises(RuntimeError, match=r"positive definite|did not converge"):
        hk.fit(hk.CurlFree(lambda x, z: -(x @ z)), X, Y, RIDGE, solver=solver)


@pytest.mark.slow
def test_gradients_in_single_precision_ask_for_what_it_can_give():
    X, Y = (each.astype(np.float32) for each in swings(20))
    with pytest.warns(UserWarning, match="float32"):
        reached = info(hk.fit(K, X, Y, 1e-3, solver=ConjugateGradient())).relative_residual
    assert reached <= 1e-5
    float32 = pytest.warns(UserWarning, match="float32")
    with float32, pytest.raises(RuntimeError, match=r"tolerance 1\.0e-08"):
        hk.fit(K, X, Y, 1e-3, solver=ConjugateGradient(1e-8))


def test_a_preconditioner_is_an_instance_of_nystrom():
    for other in (3, hk.Cholesky(), Nystrom):
        with pytest.raises(TypeError, match=r"an instance of hk\.Nystrom"):
            ConjugateGradient(preconditioner=other)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("key", [5, "a"])
def test_a_key_is_one_key_of_jax(key):
    for made in (lambda: Nystrom(key=key), lambda: hk.RandomFeatures(5, key)):
        with pytest.raises(TypeError, match="a key of JAX"):
            made()
    with pytest.raises(ValueError, match=r"array of keys of shape \(3,\)"):
        Nystrom(key=jax.random.split(jax.random.key(0), 3))


@pytest.mark.slow
def test_warnings_name_the_line_of_the_user():
    X, Y = (each.astype(np.float32) for each in swings(20))
    calls = [
        lambda: hk.fit(K, X, Y, 1e-2),
        lambda: Nystrom().start(K, X, 1e-2),
        lambda: hk.tune(K, X, Y, starts=1, max_steps=1),
    ]
    for call in calls:
        with pytest.warns(UserWarning, match="float32") as seen:
            call()
        assert {each.filename for each in seen} == {__file__}


@pytest.mark.slow
def test_landmarks_depend_on_the_key():
    X, Y = swings(60)
    keys = None, jax.random.key(0), jax.random.key(1)
    default, same, other = (hk.fit(K, X, Y, 1e-2, solver=Nystrom(key=key)).points for key in keys)
    np.testing.assert_array_equal(default, same)
    assert default.shape != other.shape or (default != other).any()


@pytest.mark.slow
def test_the_warning_of_few_landmarks_comes_at_twice_the_tolerance():
    X, Y = swings(60)
    few = hk.fit(K, X, Y, 1e-3, solver=Nystrom(1e9, points=X[:4]))
    truncation = float(info(few).truncation)
    hk.fit(K, X, Y, 1e-3, solver=Nystrom(truncation / 1.9, points=X[:4]))  # warnings are errors
    with pytest.warns(UserWarning, match="4 landmarks leave"):
        hk.fit(K, X, Y, 1e-3, solver=Nystrom(truncation / 2.1, points=X[:4]))
