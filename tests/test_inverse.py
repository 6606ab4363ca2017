"""The inverse in blocks, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hamkernel._inverse import inverse, inverse_factor


def positive(D: int) -> np.ndarray:
    B = np.random.default_rng(D).normal(size=(D, D))
    return B @ B.T / D + 0.1 * np.eye(D)


@pytest.mark.parametrize("D", [1, 31, 32, 75, 300, 600])  # one block, two, padded, nested products
def test_factor_and_inverse_are_those_of_numpy(D):
    A = positive(D)
    U = inverse_factor(jnp.asarray(A))
    np.testing.assert_array_equal(U, np.triu(U))
    np.testing.assert_allclose(U, np.linalg.inv(np.linalg.cholesky(A)).T, atol=1e-11)
    np.testing.assert_allclose(inverse(U), np.linalg.inv(A), atol=1e-11)


def test_a_batch_is_one_matrix_after_the_other():
    A = np.stack([positive(40), 2 * positive(40)])
    expected = np.linalg.inv(np.linalg.cholesky(A)).swapaxes(1, 2)
    np.testing.assert_allclose(jax.vmap(inverse_factor)(jnp.asarray(A)), expected, atol=1e-12)


def test_a_matrix_that_is_not_positive_gives_nan():
    A = positive(75)
    A[50, 50] = -1.0
    assert np.isnan(inverse_factor(jnp.asarray(A))).any()
