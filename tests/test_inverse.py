"""The inverse in blocks, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hamkernel._inverse import inverse


def positive(D: int) -> np.ndarray:
    B = np.random.default_rng(D).normal(size=(D, D))
    return B @ B.T / D + 0.1 * np.eye(D)


@pytest.mark.parametrize("D", [1, 31, 32, 75, 300, 1001])  # one block, two, padded, in halves
def test_inverse_is_that_of_numpy(D):
    A = positive(D)
    C = inverse(jnp.asarray(np.linalg.cholesky(A)))
    np.testing.assert_allclose(C, np.linalg.inv(A), atol=1e-11)


@pytest.mark.parametrize("D", [40, 300])
def test_a_batch_is_one_matrix_after_the_other(D):
    A = np.stack([positive(D), 2 * positive(D)])
    C = jax.vmap(inverse)(jnp.asarray(np.linalg.cholesky(A)))
    np.testing.assert_allclose(C, np.linalg.inv(A), atol=1e-11)


@pytest.mark.parametrize("D", [75, 300])
def test_a_factor_that_failed_gives_nan(D):
    L = np.linalg.cholesky(positive(D))
    L[D // 2 :] = np.nan  # what `jnp.linalg.cholesky` returns is NaN throughout
    assert np.isnan(inverse(jnp.asarray(L))).any()
