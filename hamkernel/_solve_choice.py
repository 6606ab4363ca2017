"""Which solver a problem gets when none is named, and which dense problems are refused."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._devices import rows_of
from hamkernel._memory import dense_bytes, memory_bytes, refuse_beyond_memory
from hamkernel._solve import AbstractSolver, Cholesky
from hamkernel._solve_cg import ConjugateGradient

# Matrices of the size of the Gram that a dense fit holds: Gram, Gram with ridge, factor.
COPIES = 3


def chosen(solver: AbstractSolver | None, X: Float[Array, "N n"]) -> AbstractSolver:
    """`solver`; if None, Cholesky where it takes at most half of the memory, else CG.

    Data that is spread over devices gets CG, which leaves it there.

    Raises:
        ValueError: Cholesky was asked for and does not fit in memory.
    """
    (N, n), dtype = X.shape, X.dtype
    if solver is None:
        needed, memory = dense_bytes(N * n, N * n, dtype, COPIES), memory_bytes()
        fits = rows_of(X) is None and (memory is None or needed <= memory / 2)
        tolerance = 1e-8 if dtype == jnp.float64 else 1e-5
        return Cholesky() if fits else ConjugateGradient(tolerance)
    if isinstance(solver, Cholesky):
        cure = (
            "Use solver=hk.ConjugateGradient(), which is exact, or solver=hk.Nystrom(), which is "
            "faster and approximate to a stated tolerance."
        )
        what = f"a dense fit of N = {N} points with n = {n} coordinates"
        refuse_beyond_memory(what, N * n, N * n, dtype, COPIES, cure)
    return solver
