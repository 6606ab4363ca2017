"""The dense A = G + ridge I, its Cholesky factor, and its inverse.

A = RᵀR by LAPACK, U = R⁻¹ from blocks of columns,

    U_<j,j = −(U_<j,<j R_<j,j) U_jj,        C = A⁻¹ = U Uᵀ,

and quadratic forms as ‖R⁻ᵀy‖². C is then positive by construction. A faster inversion by blocks of
C itself was wrong by a factor of 1e14 at condition 1e13; `tests/benchmarks/accuracy.py` compares
this one with 100 digits from condition 1e2 to 1e14.

Source: Du Croz & Higham (1992), IMA J. Numer. Anal. 12, method 2, on the stability of inversions.
"""

import itertools
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from hamkernel._factors.base import (
    AbstractFactor,
    AbstractInverse,
    AbstractSystem,
    CholeskyBlocks,
)
from hamkernel._factors.groups import Group

# Rows of the blocks of U at least, and how many of them at most. More compile longer (1.7 s for 16,
# 0.7 s for 8), and fewer are slower (D = 592 to 2000).
_ROWS, _BLOCKS = 128, 8


# Rows of R made at once by `factor_in_place`. Its temporaries are four blocks of rows, and every
# block compiles a program of its own, in 0.2 s.
ROWS_IN_PLACE = 1000


# LAPACK. One after the other under `jax.vmap`: two batches of its calls side by side were seen to
# stall for ever on two cores, since jaxlib 0.10.2 waits for threads that wait for it.


@sequential_vmap
def _lapack_cholesky(A):
    # Transposed twice, the matrix is never copied from the order of rows to that of columns.
    return jax.lax.linalg.cholesky(A.T, symmetrize_input=False).T


@sequential_vmap
def _lapack_backward(R, b):
    # Rᵀ in the order of columns, which LAPACK asks for, is R as it lies in memory: without a copy a
    # solve with 2000 rows takes a third of the time.
    return jax.lax.linalg.triangular_solve(R.T, b, left_side=True, lower=True, transpose_a=True)


@sequential_vmap
def _lapack_forward(R, b):
    return jax.lax.linalg.triangular_solve(R.T, b, left_side=True, lower=True)


def backward(R: Float[Array, "D D"], b: Float[Array, "D m"]) -> Float[Array, "D m"]:
    """R⁻¹ b for an upper triangular R."""
    return jax.lax.custom_linear_solve(
        lambda x: R @ x,
        b,
        lambda _, b: _lapack_backward(R, b),
        lambda _, b: _lapack_forward(R, b),
    )


def forward(R: Float[Array, "D D"], b: Float[Array, "D m"]) -> Float[Array, "D m"]:
    """R⁻ᵀ b for an upper triangular R."""
    return jax.lax.custom_linear_solve(
        lambda x: R.T @ x,
        b,
        lambda _, b: _lapack_forward(R, b),
        lambda _, b: _lapack_backward(R, b),
    )


@jax.custom_jvp
def cholesky(A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """R upper triangular with A = RᵀR; NaN where A is not positive definite."""
    return _lapack_cholesky(A)


@cholesky.defjvp
def _(primals, tangents):
    # dR = upper(R⁻ᵀ dA R⁻¹) R, with half of the diagonal: Murray (2016), arXiv 1602.07527.
    (A,), (dA,) = primals, tangents
    R = cholesky(A)
    S = forward(R, forward(R, dA).T)
    half = 1 - 0.5 * jnp.eye(len(A), dtype=A.dtype)
    return R, (jnp.triu(S) * half) @ R


class DenseSystem(AbstractSystem):
    """A as a matrix."""

    matrix: Float[Array, "D D"]

    def factor(self) -> "DenseFactor":
        return dense_factor(self.matrix)


class DenseFactor(AbstractFactor[DenseSystem]):
    """A = RᵀR with R upper triangular.

    Attributes:
        R: the factor; NaN where A is not positive definite to rounding.
        size: ‖A‖ in the Frobenius norm.
    """

    R: Float[Array, "D D"]
    size: Float[Array, ""]

    def whiten(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        """R⁻ᵀ b, so that ‖R⁻ᵀb‖² = bᵀA⁻¹b."""
        return forward(self.R, b.reshape(len(b), -1)).reshape(b.shape)

    def solve(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        return backward(self.R, forward(self.R, b.reshape(len(b), -1))).reshape(b.shape)

    def solved(self, y: Float[Array, " D"]) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        z = self.whiten(y)
        return backward(self.R, z[:, None])[:, 0], z @ z

    @property
    def log_det(self) -> Float[Array, ""]:
        return 2 * jnp.sum(jnp.log(jnp.diagonal(self.R)))

    @property
    def inverse_trace(self) -> Float[Array, ""]:
        return jnp.sum(self.inverse_root() ** 2)

    def inverse(self) -> "DenseInverse":
        return DenseInverse(_outer_square(self.inverse_root()))

    def inverse_root(self) -> Float[Array, "D D"]:
        """U = R⁻¹, upper triangular, with A⁻¹ = U Uᵀ."""
        R = self.R
        U = jnp.zeros_like(R)
        for j in _blocks(len(R)):
            before = slice(0, j.start)
            own = backward(R[j, j], jnp.eye(j.stop - j.start, dtype=R.dtype))
            # Each call of LAPACK waits for the one before.
            R, own = jax.lax.optimization_barrier((R, own))
            U = U.at[j, j].set(own)
            U = U.at[before, j].set(-(U[before, before] @ R[before, j]) @ own)
        return U


def dense_factor(A: Float[Array, "D D"]) -> DenseFactor:
    """The factor of A, inside of a compiled program."""
    A, size = jax.lax.optimization_barrier((A, jnp.linalg.norm(A)))  # A is not kept
    return DenseFactor(cholesky(A), size)


def factor_in_place(A: Float[Array, "D D"], steps: Callable[[Iterable], Iterable]) -> DenseFactor:
    """The factor of A in the memory of A, which is lost.

    Rows of R are made one block after the other,

        S = A_jk − Σ_{i<j} R_ijᵀ R_ik,    R_jj = chol(S_jj),    R_jk = R_jj⁻ᵀ S_jk    for k > j.

    LAPACK's own takes a second matrix for the result and a third for what XLA returns.

    Args:
        A: a matrix outside of any trace.
        steps: passes on the blocks, to show how far it is.
    """
    size = _norm(A)
    starts = range(0, len(A), ROWS_IN_PLACE)
    for start in steps(starts):
        A = jax.block_until_ready(_rows_of_factor((start,), A))  # Ctrl-C stops between blocks
    return DenseFactor(A, size)


_norm = jax.jit(jnp.linalg.norm)


@eqx.filter_jit(donate="all-except-first")
def _rows_of_factor(at: tuple[int], A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    start, D = at[0], len(A)
    b = min(ROWS_IN_PLACE, D - start)

    def less(i, S):
        above = jax.lax.dynamic_slice(A, (i * ROWS_IN_PLACE, start), (ROWS_IN_PLACE, D - start))
        return S - above[:, :b].T @ above

    S = jax.lax.fori_loop(0, start // ROWS_IN_PLACE, less, A[start : start + b, start:])
    own = _lapack_cholesky(S[:, :b])
    rest = _lapack_forward(own, S[:, b:])
    rows = jnp.concatenate([jnp.zeros((b, start), A.dtype), own, rest], axis=1)
    return jax.lax.dynamic_update_slice(A, rows, (start, 0))


def solution(
    A: Float[Array, "D D"], y: Float[Array, " D"]
) -> tuple[DenseFactor, Float[Array, " D"]]:
    """The factor of A, and A⁻¹y, differentiated implicitly: by one more solve with the factor."""
    factor, solve = dense_factor(A), jax.lax.custom_linear_solve
    return factor, solve(lambda x: A @ x, y, lambda _, b: factor.solve(b), symmetric=True)


class DenseInverse(AbstractInverse[DenseSystem]):
    """C as a matrix."""

    C: Float[Array, "D D"]

    def blocks(self, group: Group) -> CholeskyBlocks:
        return CholeskyBlocks(group.diagonal_blocks(self.C))

    def pulled(self, u, w, inverse=None, square=None) -> DenseSystem:
        A_bar = u[:, None] * w[None, :]
        if inverse is not None:
            A_bar = A_bar + inverse * self.C
        if square is not None:
            A_bar = A_bar + square * (self.C @ self.C)
        return DenseSystem(A_bar)

    def pulled_folds(self, a, groups, V, R, bars) -> tuple[DenseSystem, Float[Array, " D"]]:
        P, Q = [], []  # C_:S v_S and C_:S r_S, a column for each fold
        for group, v, r in zip(groups, V, R, strict=True):
            rows = group.gather(self.C)  # whose sums are three times faster than those of columns
            P.append(jnp.einsum("fid,fi->df", rows, v))
            Q.append(jnp.einsum("fid,fi->df", rows, r))
        w = jnp.concatenate(P, axis=1).sum(axis=1) + self.C @ bars[1]
        left, right = jnp.column_stack([*P, -w]), jnp.column_stack([*Q, a])
        # Else XLA computes these sums again for every entry of the product: 10 times slower.
        left, right, w = jax.lax.optimization_barrier((left, right, w))
        return DenseSystem(left @ right.T), w


def _outer_square(U: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """U Uᵀ of an upper triangular U, at a third of the price of the product."""
    C = U  # in its place: no column after j needs those before
    for j in _blocks(len(U)):
        columns = C[: j.stop, j.start :] @ C[j, j.start :].T
        C = C.at[: j.stop, j].set(columns).at[j, : j.start].set(columns[: j.start].T)
    return C


def _blocks(D: int) -> list[slice]:
    starts = np.linspace(0, D, min(-(-D // _ROWS), _BLOCKS) + 1).astype(int).tolist()
    return [slice(start, stop) for start, stop in itertools.pairwise(starts)]
