"""The inverse of a positive definite matrix, A⁻¹ = UUᵀ with U = L⁻ᵀ and A = LLᵀ, in blocks.

LAPACK has routines for both steps that XLA does not call, and solving with the identity or
multiplying dense matrices takes three times the operations, since half of U is zero. In blocks,

    U = [A  B]⁻¹ = [A⁻¹  −A⁻¹BC⁻¹]            [A  B][A  B]ᵀ   [AAᵀ + BBᵀ  BCᵀ]
        [0  C]     [0     C⁻¹    ]     and    [0  C][0  C]  = [CBᵀ        CCᵀ],

so both are matrix products, with no arithmetic on the zero blocks.

Source: Du Croz & Higham (1992), IMA J. Numer. Anal. 12, also on the stability of the inversion.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# One batch of LAPACK calls after the other: jaxlib 0.10.2 was seen to stall forever on two cores
# where one that does not depend on it runs beside it, such as a solve with the same factor.
#
# OpenBLAS wakes its threads from 1024 entries on, which on a busy machine was measured to take
# 500 times as long as the work.
_SOLVED = 31  # rows of the blocks that are inverted by LAPACK, all in one batch
_MULTIPLIED = 256  # rows up to which products are dense


def inverse_factor(A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """U = L⁻ᵀ with A = LLᵀ, upper triangular; NaN where A is not positive definite."""
    D, count = len(A), 1
    while -(-D // count) > _SOLVED:
        count *= 2
    size = -(-D // count)
    L = _padded(jax.lax.linalg.cholesky(A, symmetrize_input=False), size * count - D)
    identity = jnp.broadcast_to(jnp.eye(size, dtype=A.dtype), (count, size, size))
    # From the inverses of the blocks on the diagonal to those of half as many, and so on.
    U = jax.lax.linalg.triangular_solve(
        _diagonal_blocks(L, size), identity, left_side=True, lower=True, transpose_a=True
    )
    while len(U) > 1:
        below = _diagonal_blocks(L, 2 * size)[:, size:, :size]
        first, second = U[::2], U[1::2]
        corner = -(first @ jnp.swapaxes(below, 1, 2)) @ second
        U = jnp.zeros((len(below), 2 * size, 2 * size), A.dtype)
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


def inverse(U: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """A⁻¹ = UUᵀ for U of `inverse_factor`."""
    if len(U) <= _MULTIPLIED:
        return U @ U.T
    half = len(U) // 2
    first, across, second = U[:half, :half], U[:half, half:], U[half:, half:]
    corner = across @ second.T
    upper = jnp.concatenate([inverse(first) + across @ across.T, corner], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([corner.T, inverse(second)], axis=1)])
