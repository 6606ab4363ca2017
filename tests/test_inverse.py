"""The inverse in blocks, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hamkernel._solvers.inverse import inverse


def positive(D: int) -> np.ndarray:
    B = np.random.default_rng(D).normal(size=(D, D))
    return B @ B.T / D + 0.1 * np.eye(D)


@pytest.mark.parametrize("D", [1, 31, 32, 75, 300, 601])  # one block, two, of unequal size, all
def test_inverse_and_factor_are_those_of_numpy(D):
    A = positive(D)
    C, R = jax.jit(inverse)(jnp.asarray(A))
    np.testing.assert_allclose(C, np.linalg.inv(A), atol=1e-11)
    np.testing.assert_allclose(C, C.T, rtol=0, atol=1e-13)
    np.testing.assert_allclose(R, np.linalg.cholesky(A).T, atol=1e-12)


def test_a_batch_is_one_matrix_after_the_other():
    A = np.stack([positive(40), 2 * positive(40)])
    C, _ = jax.vmap(inverse)(jnp.asarray(A))
    np.testing.assert_allclose(C, np.linalg.inv(A), atol=1e-12)


def test_a_matrix_that_is_not_positive_gives_nan():
    A = positive(75)
    A[50, 50] = -1.0
    C, R = jax.jit(inverse)(jnp.asarray(A))
    assert np.isnan(C).all()
    assert np.isnan(np.diagonal(R)).all()
