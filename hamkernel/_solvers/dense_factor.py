"""The Cholesky factor of a dense positive definite matrix, and what is made of it.

A = RᵀR by LAPACK, U = R⁻¹ from blocks of columns,

    U_<j,j = −U_<j,<j R_<j,j U_jj,        A⁻¹ = U Uᵀ,

and every quadratic form as ‖R⁻ᵀy‖². A⁻¹ is then positive by construction. A faster inversion, with
blocks of A⁻¹ itself in place of U, was wrong by a factor of 1e14 at condition 1e13; this one is
compared with 60 digits from condition 1e2 to 1e14 in `tests/benchmarks/accuracy.py`.

Source: Du Croz & Higham (1992), IMA J. Numer. Anal. 12, method 2, on the stability of inversions.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

# Blocks of U: more of them compile longer, and from 250 rows on were not faster at D = 600 to 2000.
_ROWS, _BLOCKS = 128, 8


# One after the other under `jax.vmap`: two batches of LAPACK calls side by side were seen to stall
# for ever on two cores, since jaxlib 0.10.2 waits for threads that wait for it.
@sequential_vmap
def cholesky(A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """R upper triangular with A = RᵀR; NaN where A is not positive definite."""
    # Transposed twice, the matrix is never copied from the order of rows to that of columns.
    return jax.lax.linalg.cholesky(A.T, symmetrize_input=False).T


@sequential_vmap
def _backward(R: Float[Array, "D D"], b: Float[Array, "D m"]) -> Float[Array, "D m"]:
    return jax.lax.linalg.triangular_solve(R, b, left_side=True, lower=False)


@sequential_vmap
def _forward(R: Float[Array, "D D"], b: Float[Array, "D m"]) -> Float[Array, "D m"]:
    return jax.lax.linalg.triangular_solve(R, b, left_side=True, lower=False, transpose_a=True)


class DenseFactor(eqx.Module):
    """A = RᵀR with R upper triangular, NaN where A is not positive definite. Not differentiated."""

    R: Float[Array, "D D"]

    def __init__(self, A: Float[Array, "D D"]):
        self.R = cholesky(A)

    def whiten(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        """R⁻ᵀ b, so that ‖R⁻ᵀb‖² = bᵀA⁻¹b."""
        return _forward(self.R, b.reshape(len(b), -1)).reshape(b.shape)

    def solve(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        """A⁻¹ b."""
        z = _forward(self.R, b.reshape(len(b), -1))
        return _backward(self.R, z).reshape(b.shape)

    @property
    def log_det(self) -> Float[Array, ""]:
        """Log det A."""
        return 2 * jnp.sum(jnp.log(jnp.diagonal(self.R)))

    def inverse_root(self) -> Float[Array, "D D"]:
        """U = R⁻¹, upper triangular, with A⁻¹ = U Uᵀ."""
        R = self.R
        U = jnp.zeros_like(R)
        for j in _blocks(len(R)):
            before = slice(0, j.start)
            own = _backward(R[j, j], jnp.eye(j.stop - j.start, dtype=R.dtype))
            # Each call of LAPACK waits for the one before.
            R, own = jax.lax.optimization_barrier((R, own))
            U = U.at[j, j].set(own)
            U = U.at[before, j].set(-(U[before, before] @ R[before, j]) @ own)
        return U


def outer_square(U: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """U Uᵀ of an upper triangular U, at a third of the price of the product."""
    C = jnp.zeros_like(U)
    for j in _blocks(len(U)):
        columns = U[: j.stop, j.start :] @ U[j, j.start :].T
        C = C.at[: j.stop, j].set(columns).at[j, : j.start].set(columns[: j.start].T)
    return C


def _blocks(D: int) -> list[slice]:
    starts = np.linspace(0, D, min(-(-D // _ROWS), _BLOCKS) + 1).astype(int).tolist()
    return [slice(start, stop) for start, stop in itertools.pairwise(starts)]
