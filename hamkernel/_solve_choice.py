"""Which solver a problem gets when none is named, and which dense problems are refused."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._devices import rows_of
from hamkernel._solve import AbstractSolver, Cholesky
from hamkernel._solve_cg import ConjugateGradient

# Matrices of the size of the Gram that a dense fit holds: Gram, Gram with ridge, factor.
COPIES = 3
_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def dense_bytes(N: int, n: int, dtype: jnp.dtype, copies: int = COPIES) -> int:
    """Bytes in so many matrices of the size of the Gram of N points in ℝⁿ, by default for a fit."""
    return copies * (N * n) ** 2 * jnp.dtype(dtype).itemsize


def memory_bytes() -> int | None:
    """The memory of the default device, or of this machine or container; None if unknown."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"]
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on every system
        return None
    limit = _CGROUP_LIMIT.read_text().strip() if _CGROUP_LIMIT.exists() else "max"
    return min(total, int(limit)) if limit.isdigit() else total


def chosen(solver: AbstractSolver | None, X: Float[Array, "N n"]) -> AbstractSolver:
    """`solver`; if None, Cholesky where it takes at most half of the memory, else CG.

    Data that is spread over devices gets CG, which leaves it there.

    Raises:
        ValueError: Cholesky was asked for and does not fit in memory.
    """
    (N, n), dtype = X.shape, X.dtype
    needed, memory = dense_bytes(N, n, dtype), memory_bytes()
    if solver is None:
        fits = rows_of(X) is None and (memory is None or needed <= memory / 2)
        tolerance = 1e-8 if dtype == jnp.float64 else 1e-5
        return Cholesky() if fits else ConjugateGradient(tolerance)
    if isinstance(solver, Cholesky) and memory is not None and needed > memory:
        raise ValueError(
            f"a dense fit of N = {N} points with n = {n} coordinates needs {needed / 1e9:.3g} GB "
            f"({COPIES} matrices of {N * n} rows) and there are {memory / 1e9:.3g} GB. Use "
            "solver=hk.ConjugateGradient(), which is exact, or solver=hk.Nystrom(), which is "
            "faster and approximate to a stated tolerance."
        )
    return solver
