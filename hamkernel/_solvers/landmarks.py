"""Landmarks: the few points whose columns of the Gram carry all of it, to a stated tolerance.

Randomly pivoted Cholesky draws points with probability proportional to what the columns so far
leave of the Gram's diagonal, so it goes where the data still say something new, and stops when
little is left. Points are drawn in blocks; inside a block a point is kept with the probability
that drawing one by one would have given it (Epperly, Tropp & Webber), so blocks cost nothing.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from hamkernel import _require as require
from hamkernel._gram.dense import assemble, block_traces
from hamkernel._gram.derivatives import constant
from hamkernel._machine import rows_of, split
from hamkernel._structures.base import AbstractMatrixKernel

BLOCK = 16  # points drawn at once
FIRST = 64  # points in the first buffer; it doubles until they suffice


class Landmarks(eqx.Module):
    """Points S and the columns of G_SS that are independent to rounding.

    Attributes:
        points: shape (m, n). The last ones may be repetitions that keep no column.
        kept: for each column (point, component), whether it is used, shape (m, n).
        count: the number of points in use, shape ().
    """

    points: Float[Array, "m n"]
    kept: Bool[Array, "m n"]
    count: Int[Array, ""]


def choose_landmarks(
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    left: Float[Array, ""],
    most: int,
    candidates: int,
    key: Key[Array, ""],
) -> Landmarks:
    """Points of X after which the mean of trace(K(x, x)) over X falls to `left`, at most `most`.

    Nothing is differentiated: the landmarks are constants of a fit.

    Args:
        K: a matrix-valued kernel.
        X: states.
        left: the mean of trace(G − Ĝ) per candidate to stop at.
        most: how many landmarks to choose at most.
        candidates: the points to choose from: X, or a random part of it if X is longer.
        key: for the draws.

    Returns:
        The landmarks, at least one of them unless the kernel is not positive or not finite.
        O(P n r²) time and O(P n r) memory for P candidates and r = m n columns.

    Source: Chen, Epperly, Tropp & Webber (2023), arXiv 2207.06503; in blocks, Epperly, Tropp &
        Webber (2024), arXiv 2410.03969.
    """
    K, X, left = constant((K, X, left))
    rows = rows_of(X)
    X = split(rows, X)
    if len(X) > candidates:
        X = X[_spread(jax.random.split(key)[0], len(X), candidates)]
    if rows is not None:
        X = rows.whole(X)
    most = min(most, len(X))
    if not require.is_concrete(K, X, left, key):
        drawn = _begin(K, X, left, key, most)
        return _landmarks(X, drawn, most)
    size = min(FIRST, most)
    drawn = _begin(K, X, left, key, size)
    while int(drawn.count) >= size and size < most:
        size = min(2 * size, most)
        drawn = _draw(K, X, left, _enlarged(drawn, size + BLOCK), size)
    # A multiple of the block, so that similar fits share their compiled code.
    blocks = max(1, -(-int(drawn.count) // BLOCK))
    return _landmarks(X, drawn, min(size, blocks * BLOCK))


def _spread(key, N: int, count: int) -> Int[Array, " count"]:
    """A random index out of each of `count` equal parts of N, in O(count) memory."""
    ends = np.arange(count + 1) * N // count
    index: Int[Array, " count"] = jax.random.randint(key, (count,), ends[:-1], ends[1:])
    return index


@eqx.filter_jit
def given_landmarks(K: AbstractMatrixKernel, S: Float[Array, "m n"]) -> Landmarks:
    """All of S, with those columns that pivoted Cholesky finds independent.

    O((m n)² r) time for r of them. Nothing is differentiated, as in `choose_landmarks`.
    """
    K, S = constant((K, S))
    m, r = len(S), len(S) * K.outputs(S.shape[1])
    rounding = _rounding(block_traces(K, S), r)
    kept = _independent(assemble(K, S, S).reshape(r, r), rounding).reshape(m, -1)
    return Landmarks(points=S, kept=kept, count=kept.any(axis=1).sum())


def _independent(matrix, rounding):
    """Columns of a Gram: the one with the most left, until what is left is rounding.

    In the order in which they come, columns whose pivots all exceed rounding may still depend on
    each other: only with pivoting does a small eigenvalue show in a small pivot.
    """

    def more(carry):
        rank, _, left, _ = carry
        return (rank < len(matrix)) & (left.max() > rounding)

    def column(carry):
        rank, factor, left, kept = carry
        c = jnp.argmax(left)
        v = (matrix[c] - factor[:, c] @ factor) / jnp.sqrt(left[c])
        left = (left - v**2).at[c].set(0.0)
        return rank + 1, factor.at[rank].set(v), left, kept.at[c].set(True)

    none = jnp.zeros(len(matrix), bool)
    start = (jnp.zeros((), int), jnp.zeros_like(matrix), jnp.diagonal(matrix), none)
    return jax.lax.while_loop(more, column, start)[3]


def _rounding(traces: Float[Array, " P"], columns: int) -> Float[Array, ""]:
    """What is left of a pivot that should be zero."""
    eps = jnp.finfo(traces.dtype).eps
    return (10 * columns * eps * jnp.abs(traces).max()).astype(traces.dtype)


class _Drawn(NamedTuple):
    """The state of the drawing, in buffers of m + BLOCK points."""

    count: Int[Array, ""]
    index: Int[Array, " m"]
    kept: Bool[Array, "m n"]
    factor: Float[Array, "m n P n"]  # Ĝ = FᵀF over the candidates
    left: Float[Array, " P"]  # the traces of the diagonal blocks of G − Ĝ
    rounding: Float[Array, ""]  # what a pivot must exceed
    key: Key[Array, ""]
    rounds: Int[Array, ""]


@eqx.filter_jit
def _begin(K, X, left, key, size):
    """`_draw` from the beginning."""
    P, n = len(X), K.outputs(X.shape[1])
    buffer = size + BLOCK
    traces = block_traces(K, X)
    zero = jnp.zeros((), int)
    drawn = _Drawn(
        count=zero,
        index=jnp.zeros(buffer, int),
        kept=jnp.zeros((buffer, n), bool),
        factor=jnp.zeros((buffer, n, P, n), X.dtype),
        left=traces,
        rounding=_rounding(traces, buffer * n),
        key=jax.random.split(key)[1],  # the other is for the candidates
        rounds=zero,
    )
    return _draw(K, X, left, drawn, size)


def _enlarged(drawn: _Drawn, size: int) -> _Drawn:
    def longer(a):
        return jnp.concatenate([a, jnp.zeros((size - len(a), *a.shape[1:]), a.dtype)])

    return drawn._replace(
        index=longer(drawn.index), kept=longer(drawn.kept), factor=longer(drawn.factor)
    )


@eqx.filter_jit
def _draw(K, X, left, drawn, size):
    """Draw blocks until the mean trace is at most `left` or `size` points are chosen."""
    goal = len(X) * jnp.maximum(left, drawn.rounding)

    def more(drawn):
        # Rounds end the loop where rounding alone would go on drawing.
        wanted = (drawn.left.sum() > goal) & (drawn.count < size) & (drawn.rounds < 4 * size)
        return wanted | (drawn.rounds == 0)

    return jax.lax.while_loop(more, lambda drawn: _draw_block(K, X, drawn), drawn)


def _draw_block(K, X, drawn: _Drawn) -> _Drawn:
    P, n = len(X), drawn.kept.shape[1]
    key, draw, accept = jax.random.split(drawn.key, 3)
    index = jax.random.choice(draw, P, (BLOCK,), p=drawn.left / drawn.left.sum())
    size = len(drawn.index)
    factor = drawn.factor.reshape(size * n, P * n)
    at_index = drawn.factor[:, :, index].reshape(size * n, BLOCK * n)
    rows = assemble(K, X[index], X).reshape(BLOCK * n, P * n) - at_index.T @ factor
    block = rows.reshape(BLOCK * n, P, n)[:, index].reshape(BLOCK * n, BLOCK * n)
    L, kept = _accepted(accept, block, n, drawn.rounding)
    new = jax.scipy.linalg.solve_triangular(L, rows, lower=True)
    new = jnp.where(kept[:, None], new, jnp.zeros_like(new))

    # Those refused go to the end of the block, where the next block overwrites them.
    kept = kept.reshape(BLOCK, n)
    chosen = kept.any(axis=1)
    order = jnp.argsort(~chosen, stable=True)
    new = new.reshape(BLOCK, n, P, n)
    left = drawn.left - jnp.sum(new**2, axis=(0, 1, 3))
    left = left.at[index].multiply(jnp.where(chosen, 0.0, 1.0).astype(left.dtype))

    def written(buffer, values):
        start = (drawn.count,) + (0,) * (buffer.ndim - 1)
        return jax.lax.dynamic_update_slice(buffer, values[order], start)

    return _Drawn(
        count=drawn.count + chosen.sum(),
        index=written(drawn.index, index.astype(drawn.index.dtype)),
        kept=written(drawn.kept, kept),
        factor=written(drawn.factor, new),
        left=jnp.maximum(left, jnp.zeros_like(left)),
        rounding=drawn.rounding,
        key=key,
        rounds=drawn.rounds + 1,
    )


def _accepted(key, block, n, rounding):
    """Cholesky of the accepted columns of `block`, with the identity in the place of the others.

    Point j is kept with the probability that its trace now has over its trace before the block.
    """
    before = jnp.diagonal(block).reshape(-1, n).sum(axis=1)
    thresholds = jnp.maximum(jax.random.uniform(key, before.shape, block.dtype) * before, rounding)
    return _factor(block, thresholds, n, rounding)


def _factor(block, thresholds, n, rounding):
    """Cholesky of the points whose trace exceeds its threshold when their turn comes."""

    def column(c, carry):
        block, L, kept, chosen = carry
        now = jax.lax.dynamic_slice(jnp.diagonal(block), ((c // n) * n,), (n,)).sum()
        chosen = jnp.where(c % n == 0, now > thresholds[c // n], chosen)
        pivot = block[c, c]
        keep = chosen & (pivot > rounding)
        scale = jnp.sqrt(jnp.where(keep, pivot, jnp.ones_like(pivot)))
        v = jnp.where(keep, block[:, c] / scale, jnp.zeros_like(scale))
        block = block - v[:, None] * v[None, :]
        return block, L.at[:, c].set(v), kept.at[c].set(keep), chosen

    size = len(block)
    start = (block, jnp.zeros_like(block), jnp.zeros(size, bool), jnp.zeros((), bool))
    _, L, kept, _ = jax.lax.fori_loop(0, size, column, start)
    return masked(jnp.tril(L), kept), kept


def masked(matrix: Float[Array, "r r"], kept: Bool[Array, " r"]) -> Float[Array, "r r"]:
    """`matrix` on the kept rows and columns, the identity on the others."""
    both = kept[:, None] & kept[None, :]
    return jnp.where(both, matrix, jnp.diag(~kept).astype(matrix.dtype))


@eqx.filter_jit
def _landmarks(X, drawn, size):
    used = jnp.arange(size) < drawn.count
    return Landmarks(
        points=X[drawn.index[:size]],
        kept=drawn.kept[:size] & used[:, None],
        count=jnp.minimum(drawn.count, size),
    )
