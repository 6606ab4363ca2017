"""Losses and their gradients against 60 digits of mpmath and refits of SciPy, where it is hard."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from benchmarks.accuracy import allowed, bases, compiled, errors, orbit, problems

import hamkernel as hk

CASES = {
    f"{problem.name}, {kind}": (problem, basis)
    for problem in problems()
    for kind, basis in bases(problem, problem.make(jnp.zeros(()))).items()
}


@pytest.mark.few(5)
@pytest.mark.parametrize("case", CASES)
def test_every_loss_and_gradient_is_right_or_says_that_it_cannot_tell(case):
    problem, basis = CASES[case]
    losses = compiled(problem, basis)
    for condition in (1e4, 1e9, 1e13, 1e15):
        for name, error in errors(problem, basis, losses, condition).items():
            assert error <= allowed(condition) or (error == np.inf and condition > 1e13), name


# 87 points of one Kepler orbit: a Gram of condition 1e6 to 1e15, without noise.
X, Y = orbit(87)
K = hk.Symplectic(1.0 * hk.Gaussian(0.5))
G = np.asarray(hk.gram(K, X)).reshape(X.size, X.size)


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
    for ridge in (1e-17, 1e-20):
        assert hk.cross_validation_loss(K, X, Y, ridge, 5) == np.inf
        assert hk.generalized_cross_validation(K, X, Y, ridge) == np.inf
        assert hk.log_marginal_likelihood(K, X, Y, ridge) == -np.inf
        slope = jax.grad(lambda log_ridge: hk.cross_validation_loss(K, X, Y, jnp.exp(log_ridge)))
        assert slope(np.log(ridge)) == 0
