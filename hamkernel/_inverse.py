"""The inverse of a positive definite matrix from its Cholesky factor L, in blocks.

LAPACK has a routine for this that XLA does not call, and solving with the identity takes three
times the operations, since half of L is zero. In blocks,

    L = [L₁  0 ]            A⁻¹ = [A₁⁻¹ + WᵀSW   −WᵀS]         W = B L₁⁻¹,   S = (L₂L₂ᵀ)⁻¹,
        [B   L₂],                 [−SW            S  ],

with A₁⁻¹ = (L₁L₁ᵀ)⁻¹: two inverses of half the size, a triangular solve and two products.

Source: Du Croz & Higham (1992), IMA J. Numer. Anal. 12, also on the stability of the inversion.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# OpenBLAS wakes its threads from 1024 entries on, which on a busy machine was measured to take
# 500 times as long as the work.
_SOLVED = 31  # rows of the blocks that are inverted by LAPACK, all in one batch
_SMALL = 256  # rows up to which there is no arithmetic to save


def inverse(L: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """(LLᵀ)⁻¹ for a lower triangular L; NaN where L is NaN."""
    if len(L) <= _SMALL:
        U = _inverse_transpose(L)
        return U @ U.T
    half = len(L) // 2
    first, across, second = L[:half, :half], L[half:, :half], L[half:, half:]
    Wt = jax.lax.linalg.triangular_solve(
        first, across.T, left_side=True, lower=True, transpose_a=True
    )
    S = inverse(second)
    corner = -(Wt @ S)
    # A product with the transpose on the right: on the left, XLA takes twice the time.
    top = inverse(first) - corner @ Wt.T
    above = jnp.concatenate([top, corner], axis=1)
    return jnp.concatenate([above, jnp.concatenate([corner.T, S], axis=1)])


def _inverse_transpose(L: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """L⁻ᵀ from the inverses of blocks on the diagonal, then of half as many, and so on."""
    D, count = len(L), 1
    while -(-D // count) > _SOLVED:
        count *= 2
    size = -(-D // count)
    L = _padded(L, size * count - D)
    identity = jnp.broadcast_to(jnp.eye(size, dtype=L.dtype), (count, size, size))
    U = jax.lax.linalg.triangular_solve(
        _diagonal_blocks(L, size), identity, left_side=True, lower=True, transpose_a=True
    )
    while len(U) > 1:
        below = _diagonal_blocks(L, 2 * size)[:, size:, :size]
        first, second = U[::2], U[1::2]
        corner = -(first @ jnp.swapaxes(below, 1, 2)) @ second
        U = jnp.zeros((len(below), 2 * size, 2 * size), L.dtype)
        U = U.at[:, :size, :size].set(first).at[:, size:, size:].set(second)
        U = U.at[:, :size, size:].set(corner)  # in place, where joining them takes two copies
        size *= 2
    return jax.lax.optimization_barrier(U[0, :D, :D])  # else XLA makes it for each of its uses


def _padded(L: Float[Array, "D D"], extra: int) -> Float[Array, "{len(L)+extra} {len(L)+extra}"]:
    """L beside an identity."""
    if not extra:
        return L
    past_the_end = jnp.asarray(jnp.arange(len(L) + extra) >= len(L), L.dtype)
    return jnp.pad(L, ((0, extra), (0, extra))) + jnp.diag(past_the_end)


def _diagonal_blocks(L: Float[Array, "D D"], size: int) -> Float[Array, "count size size"]:
    starts = jnp.arange(0, len(L), size)
    return jax.vmap(lambda i: jax.lax.dynamic_slice(L, (i, i), (size, size)))(starts)
