"""Losses and their gradients against 100 digits of Arb and refits of SciPy, where it is hard."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from benchmarks.accuracy import allowed, bases, compiled, errors, orbit, problems

import hamkernel as hk
from hamkernel._observations.blocks import Components
from hamkernel._solvers.landmarks import landmarks_of
from hamkernel._solvers.low_rank import LandmarkBasis

CASES = {
    f"{problem.name}, {kind}": (problem, basis)
    for problem in problems()
    for kind, basis in bases(problem, problem.make(jnp.zeros(()))).items()
}


@pytest.mark.few(1)
@pytest.mark.parametrize("case", CASES)
def test_every_loss_and_gradient_is_right_or_says_that_it_cannot_tell(case):
    problem, basis = CASES[case]
    losses = compiled(problem, basis)
    for condition in (1e9, 1e13, 1e15):
        for name, error in errors(problem, basis, losses, condition).items():
            assert error <= allowed(condition) or (error == np.inf and condition > 1e13), name


# 87 points of one Kepler orbit: a Gram of condition 1e6 to 1e15, without noise.
X, Y = orbit(87)
K = hk.Symplectic(1.0 * hk.Gaussian(0.5))
G = np.asarray(hk.gram(K, X)).reshape(X.size, X.size)


@pytest.mark.few(2)
@pytest.mark.parametrize("regularization", [1e-8, 1e-10, 1e-12, 1e-13])
def test_losses_of_a_kepler_orbit_are_those_of_refits(regularization):
    N, y = len(X), Y.ravel()

    def solve(A, b):
        return scipy.linalg.cho_solve(scipy.linalg.cho_factor(A, lower=True), b)

    A = G + N * regularization * np.eye(len(y))
    log_det = 2 * np.log(np.diagonal(scipy.linalg.cholesky(A, lower=True))).sum()
    expected = -0.5 * (y @ solve(A, y) + log_det + len(y) * np.log(2 * np.pi))
    found = hk.log_marginal_likelihood(K, X, Y, regularization)
    rounding = 100 * np.finfo(float).eps * np.linalg.norm(A, 2) / (N * regularization)
    np.testing.assert_allclose(found, expected, rtol=rounding)

    ridge, losses = (N - N / 5) * regularization, []
    for out in np.array_split(np.arange(len(y)).reshape(N, -1), 5):
        rest = np.setdiff1d(np.arange(len(y)), out)
        a = solve(G[np.ix_(rest, rest)] + ridge * np.eye(len(rest)), y[rest])
        losses.append(np.mean((y[out.ravel()] - G[np.ix_(out.ravel(), rest)] @ a) ** 2))
    found = hk.cross_validation_loss(K, X, Y, regularization, 5)
    np.testing.assert_allclose(found, np.mean(losses), rtol=rounding)


def test_losses_below_rounding_are_infinite_and_not_large():
    np.linalg.cholesky(G + len(X) * 2e-15 * np.eye(len(G)))  # which exists, and has few digits
    for ridge in (2e-15, 1e-17, 1e-20):
        assert hk.cross_validation_loss(K, X, Y, ridge, 5) == np.inf
        assert hk.generalized_cross_validation(K, X, Y, ridge) == np.inf
        assert hk.log_marginal_likelihood(K, X, Y, ridge) == -np.inf
        slope = jax.grad(lambda log_ridge: hk.cross_validation_loss(K, X, Y, jnp.exp(log_ridge)))
        assert slope(np.log(ridge)) == 0


# What fits say of themselves.


@pytest.mark.slow
def test_conjugate_gradients_name_cholesky_where_the_ridge_is_rounding():
    for regularization in (1e-12, 1e-14):
        with pytest.raises(RuntimeError, match=r"times the rounding.*hk\.Cholesky\(\)"):
            hk.fit(K, X, Y, regularization, solver=hk.ConjugateGradient())
    few = hk.ConjugateGradient(max_iterations=1)
    with pytest.raises(RuntimeError) as failure:
        hk.fit(K, X, Y, 1e-8, solver=few)
    assert "rounding" not in str(failure.value).split("float32")[0]  # another cause


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore:.*landmarks leave")
@pytest.mark.parametrize("regularization", [1e-2, 1e-5, 1e-8])
def test_the_truncation_bounds_the_distance_to_the_exact_fit(regularization):
    exact = hk.fit(K, X, Y, regularization)
    field = hk.fit(K, X, Y, regularization, solver=hk.Nystrom(tolerance=0.5))
    a = np.linalg.solve(G + len(X) * regularization * np.eye(Y.size), Y.ravel())
    misfit = len(X) * regularization * np.linalg.norm(a)  # of the exact fit, by NumPy
    distance = np.linalg.norm(field.evaluate(X) - exact.evaluate(X))
    bound = float(field.info.truncation) * misfit
    assert distance <= bound + 1e-13 * np.linalg.norm(Y) * np.linalg.cond(G)
    coarse = hk.fit(K, X, Y, regularization, solver=hk.Nystrom(points=X[::40]))
    assert np.linalg.norm(coarse.evaluate(X) - exact.evaluate(X)) > bound  # the control


@pytest.mark.parametrize("regularization", [1e-4, 1e-9, 1e-13])
def test_the_relative_residual_is_that_of_the_coefficients(regularization):
    field = hk.fit(K, X, Y, regularization)
    a = np.asarray(field.coefficients).astype(np.longdouble).reshape(-1)
    left = Y.ravel() - (G.astype(np.longdouble) @ a + len(X) * regularization * a)
    expected = float(np.linalg.norm(left) / np.linalg.norm(Y))
    # Both round: the products of the fit by ε‖G‖‖a‖.
    rounding = np.finfo(float).eps * np.linalg.norm(G, 2) * np.linalg.norm(a) / np.linalg.norm(Y)
    assert abs(float(field.info.relative_residual) - expected) <= 10 * rounding
    assert expected < 1e-9


@pytest.mark.few(3)
@pytest.mark.parametrize("solver", [None, hk.Nystrom(max_points=40), hk.ConjugateGradient()])
@pytest.mark.parametrize("regularization", [1e-3, 1e-7])
def test_energy_differences_are_line_integrals_of_the_field(solver, regularization):
    field = hk.fit(K, X, Y, regularization, solver=solver)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    rotated = np.kron([[0, -1], [1, 0]], np.eye(2))  # ∇H = −J f
    for start, end in ((X[0], X[50]), (X[3], X[3] + 0.4), (X[7] - 0.3, X[80])):
        path = start + (end - start) * (nodes[:, None] + 1) / 2
        slopes = np.asarray(field.evaluate(path)) @ rotated.T
        integral = weights / 2 @ (slopes @ (end - start))
        difference = field.hamiltonian(end) - field.hamiltonian(start)
        terms = np.abs(field.coefficients).sum() * np.finfo(float).eps
        np.testing.assert_allclose(difference, integral, rtol=1e-9, atol=10 * terms + 1e-12)
    assert abs(integral + weights / 2 @ (slopes @ (end - start))) > 1e-2  # the wrong sign


FEATURES = hk.RandomFeatures(7, jax.random.key(1))
LANDMARKS = hk.Nystrom(points=X[::12])


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore:.*landmarks leave")
@pytest.mark.parametrize("way", ["at once", "in chunks"])
@pytest.mark.parametrize("solver", [FEATURES, LANDMARKS], ids=["features", "landmarks"])
def test_low_rank_fits_are_those_of_a_stable_least_squares(solver, way):
    span = bases_of(solver).span(K, X.shape[1], jnp.asarray(X).dtype)
    rows, y = np.asarray(span.rows_of(Components(jnp.asarray(X)))), np.asarray(Y).reshape(-1, 1)
    largest = np.linalg.norm(rows, 2) ** 2
    for condition in (1e2, 1e5, 1e8, 1e11):
        ridge = largest / condition
        stacked = np.vstack([rows, np.sqrt(ridge) * np.eye(rows.shape[1])])
        target = np.vstack([y, np.zeros((rows.shape[1], 1))])
        expected = rows @ scipy.linalg.lstsq(stacked, target, lapack_driver="gelsy")[0]
        if way == "at once":
            field = hk.fit(K, X, Y, ridge / len(X), solver=solver)
        else:
            chunks = [(X[:30], Y[:30]), (X[30:], Y[30:])]
            field = solver.fit_chunks(K, chunks, ridge / len(X), sample=X)
        error = np.linalg.norm(np.asarray(field.evaluate(X)).reshape(-1, 1) - expected)
        assert error <= (100 * np.finfo(float).eps * condition + 1e-10) * np.linalg.norm(y)


def bases_of(solver):
    if isinstance(solver, hk.RandomFeatures):
        return solver
    return LandmarkBasis(landmarks_of(Components(solver.points)))
