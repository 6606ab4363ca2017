"""The inverse of a positive definite matrix, in blocks.

LAPACK has a routine for this that XLA does not call, and solving with the identity takes three
times the operations, since half of the factor is zero. With A = RᵀR and C = A⁻¹ one has RC = R⁻ᵀ,
which is lower triangular. So from the last rows of blocks to the first,

    C_ij = −T C_>j,   C_ii = U Uᵀ + T C_>> Tᵀ,   U = R_ii⁻¹,   T = U R_i>,

where > stands for all blocks after i, and j for each of them: matrix products, all of them with
the part of C that is there already.

Source: Du Croz & Higham (1992), IMA J. Numer. Anal. 12, also on the stability of the inversion.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# OpenBLAS wakes its threads from 1024 entries on, which on a busy machine was measured to take
# 500 times as long as the work.
_FEW = 31  # rows of a block, while there are not many of them
_MOST = 8  # blocks: a program of more compiles longer and does not run faster


def inverse(A: Float[Array, "D D"]) -> tuple[Float[Array, "D D"], Float[Array, "D D"]]:
    """C = A⁻¹, and R upper triangular with A = RᵀR; both NaN where A is not positive definite.

    Every LAPACK call waits for the one before: jaxlib 0.10.2 was seen to stall forever on two
    cores where two batches of them run side by side.
    """
    D = len(A)
    # Transposed twice, the matrix is never copied from the order of rows to that of columns.
    R = jax.lax.linalg.cholesky(A.T, symmetrize_input=False).T
    starts = np.linspace(0, D, min(-(-D // _FEW), _MOST) + 1).astype(int)
    blocks = [slice(start, stop) for start, stop in itertools.pairwise(starts)]
    C = jnp.zeros_like(A)
    for i, U in reversed(list(zip(blocks, _triangular_inverses(R, blocks), strict=True))):
        own = U @ U.T
        if i.stop < D:
            after = slice(i.stop, D)
            T = U @ R[i, after]
            across = -(T @ C[after, after])
            own = own - across @ T.T
            C = C.at[i, after].set(across).at[after, i].set(across.T)
        C = C.at[i, i].set(own)
    return C, R


def _triangular_inverses(R: Float[Array, "D D"], blocks: list[slice]) -> list[Array]:
    """The inverse of each block on the diagonal of R, all in one call."""
    sizes = [block.stop - block.start for block in blocks]
    one = jnp.eye(max(sizes), dtype=R.dtype)
    padded = [one.at[:size, :size].set(R[i, i]) for size, i in zip(sizes, blocks, strict=True)]
    identities = jnp.broadcast_to(one, (len(blocks), *one.shape))
    U = jax.lax.linalg.triangular_solve(jnp.stack(padded), identities, left_side=True, lower=False)
    return [each[:size, :size] for each, size in zip(U, sizes, strict=True)]
