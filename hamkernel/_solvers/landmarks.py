"""Landmarks: the few rows whose columns of the Gram carry all of it, to a stated tolerance.

A landmark is a row of the observations, a linear functional of the field or of its potential, and
its column of the Gram is the representer of that functional. The n rows of a velocity are chosen
together.

Randomly pivoted Cholesky draws candidates with probability proportional to the diagonal of the
residual G − Ĝ, where Ĝ is the Gram of the columns drawn so far: it prefers points at which the
data say something new, and stops when the trace of the residual is small. Candidates are drawn in
blocks; inside a block a candidate is kept with the probability that drawing one by one would have
given it (Epperly, Tropp & Webber), so blocks change nothing but the speed.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Key

from hamkernel import _require as require
from hamkernel._gram import (
    assemble,
    between_all,
    block_traces,
    components,
    constant,
    gram_of_rows,
    gram_rounding,
)
from hamkernel._machine import compiled, full_precision, rows_of, split
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._structures.base import AbstractMatrixKernel

# Candidates drawn at once. The number of landmarks is rounded up to a multiple of it, so that
# similar fits share their compiled programs.
BLOCK = 16


class Landmarks(eqx.Module):
    """Rows of linear functionals, and which of their columns are independent to rounding.

    Attributes:
        blocks: the rows, before any contrast of energies.
        index: which of the rows are the r columns, shape (r,); None if all are, in their order.
        kept: for each column whether it is used, shape (r,).
        count: the number of landmarks in use, shape ().
    """

    blocks: tuple[AbstractBlock, ...]
    index: Int[Array, " r"] | None
    kept: Bool[Array, " r"]
    count: Int[Array, ""]

    @property
    def points(self) -> Float[Array, "m d"]:
        """The points of the first block: all of them, where the landmarks are velocities."""
        return self.blocks[0].points

    @property
    def rows(self) -> Measurements:
        """All rows of the blocks, with no targets."""
        size = sum(block.size for block in self.blocks)
        return Measurements(self.blocks, jnp.zeros(size, self.points.dtype))

    def columns(self, K: AbstractMatrixKernel, block: AbstractBlock) -> Float[Array, "d r"]:
        """The covariances of the rows of a block with the landmarks."""
        covariances = between_all(K, block, self.blocks)
        return covariances if self.index is None else covariances[:, self.index]

    def gram(self, K: AbstractMatrixKernel) -> Float[Array, "r r"]:
        """The Gram of the landmarks."""
        G = gram_of_rows(K, self.rows, contrasted=False)
        return G if self.index is None else G[self.index][:, self.index]

    def representer(
        self, c: Float[Array, " r"]
    ) -> tuple[Float[Array, "P d"], Float[Array, "P n"], Float[Array, "E d"], Float[Array, " E"]]:
        """The function Σ c_r L_r K: its points and coefficients, and those of its values."""
        if self.index is not None:
            c = jnp.zeros(self.rows.targets.shape, c.dtype).at[self.index].add(c)
        return self.rows.representer(c)


def choose_landmarks(
    K: AbstractMatrixKernel,
    X: Float[Array, "N d"],
    left: Float[Array, ""],
    most: int,
    candidates: int,
    key: Key[Array, ""],
) -> Landmarks:
    """Points of X after which the mean of trace(K(x, x)) over X falls to `left`, at most `most`.

    Nothing is differentiated: the landmarks are constants of a fit.

    Args:
        K: a matrix-valued kernel.
        X: points.
        left: the mean of trace(G − Ĝ) per point to stop at.
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
        X = X[_stratified(jax.random.split(key)[0], len(X), candidates)]
    if rows is not None:
        X = rows.whole(X)
    index, kept, count = _chosen(PointCandidates(K, X), left, min(most, len(X)), key)
    return Landmarks((components(K, X[index]),), None, kept.reshape(-1), count)


def choose_rows(
    K: AbstractMatrixKernel,
    rows: Measurements,
    left: Float[Array, ""],
    most: int,
    candidates: int,
    key: Key[Array, ""],
) -> Landmarks:
    """`choose_landmarks` out of the rows of any observations, one row at a time.

    The constant of the energies is not taken off: trace(G − Ĝ) of the contrasts is no larger.

    Args:
        K: a matrix-valued kernel.
        rows: the observations; a row counts relative to its noise.
        left: the mean of trace(G − Ĝ) per row to stop at.
        most: how many landmarks to choose at most.
        candidates: the rows to choose from: all, or the rows of a random part of the observations.
        key: for the draws.

    Returns:
        The landmarks. O(P² + P r²) time and O(P²) memory for P candidates and r landmarks.
    """
    K, rows, left = constant((K, rows, left))
    blocks = rows.blocks
    size = sum(block.size for block in blocks)
    if size > candidates:
        blocks = _part(blocks, candidates / size, jax.random.split(key)[0])
    G = _gram_of_landmarks(K, landmarks_of(*blocks))
    index, kept, count = _chosen(RowCandidates(G), left, min(most, len(G)), key)
    return _pruned(blocks, index, kept.reshape(-1), count)


def _chosen(
    candidates: "AbstractCandidates", left: Float[Array, ""], most: int, key: Key[Array, ""]
) -> tuple[Int[Array, " m"], Bool[Array, "m n"], Int[Array, ""]]:
    """The index of the chosen candidates, which of their columns are kept, and how many."""
    if not require.is_concrete(candidates, left, key):
        return _first_candidates(_begin(candidates, left, key, most), most)
    size = min(64, most)  # of the buffer, which doubles until it suffices
    drawn = _begin(candidates, left, key, size)
    while int(drawn.count) >= size and size < most:
        size = min(2 * size, most)
        drawn = _draw(candidates, left, _enlarged(drawn, size + BLOCK), size)
    blocks = max(1, -(-int(drawn.count) // BLOCK))
    return _first_candidates(drawn, min(size, blocks * BLOCK))


@compiled
def _gram_of_landmarks(K: AbstractMatrixKernel, landmarks: Landmarks) -> Float[Array, "r r"]:
    return landmarks.gram(K)


def _stratified(key, N: int, count: int) -> Int[Array, " count"]:
    """A random index out of each of `count` equal parts of N, in O(count) memory."""
    ends = np.arange(count + 1) * N // count
    index: Int[Array, " count"] = jax.random.randint(key, (count,), ends[:-1], ends[1:])
    return index


def _part(
    blocks: tuple[AbstractBlock, ...], share: float, key: Key[Array, ""]
) -> tuple[AbstractBlock, ...]:
    """A random share of the observations of each block; evenly spaced ones under tracing."""
    found = []
    for block in blocks:
        count = max(1, int(share * block.count))
        traced = not require.is_concrete(block, key)
        if isinstance(getattr(block, "kept", None), Tracer):
            found.append(block)  # which rows there are is not known
            continue
        even = np.arange(count) * block.count // count
        chosen = even if traced else np.asarray(_stratified(key, block.count, count))
        found.append(block.subset(chosen)[0])
    return tuple(found)


def _pruned(
    blocks: tuple[AbstractBlock, ...],
    index: Int[Array, " r"],
    kept: Bool[Array, " r"],
    count: Int[Array, ""],
) -> Landmarks:
    """The landmarks without observations of which no row is used; all of them under tracing."""
    if not require.is_concrete(blocks, index, kept):
        return Landmarks(blocks, index, kept, count)
    rows, used = np.asarray(index), np.asarray(kept)
    parts, places = [], np.zeros(len(rows), int)
    start = size = 0
    for block in blocks:
        own = used & (rows >= start) & (rows < start + block.size)
        if own.any() or (block is blocks[-1] and not parts):
            chosen = np.unique(block.labels()[rows[own] - start])
            # Other observations fill up a multiple of the block.
            wanted = min(block.count, max(1, -(-len(chosen) // BLOCK)) * BLOCK)
            others = np.setdiff1d(np.arange(block.count), chosen)[: wanted - len(chosen)]
            part, taken, _ = block.subset(np.sort(np.concatenate([chosen, others])))
            places[own] = size + np.searchsorted(taken, rows[own] - start)
            parts.append(part)
            size += part.size
        start += block.size
    return Landmarks(tuple(parts), jnp.asarray(places), kept, count)


@compiled
def given_landmarks(K: AbstractMatrixKernel, landmarks: Landmarks) -> Landmarks:
    """The landmarks with those columns kept that pivoted Cholesky finds independent.

    O(r³) time for r columns. Nothing is differentiated, as in `choose_landmarks`.
    """
    K, landmarks = constant((K, landmarks))
    G = landmarks.gram(K)
    # In units in which the diagonal is 1: the rounding errors of Cholesky are relative to it.
    norms = jnp.sqrt(jnp.abs(jnp.diagonal(G)))
    norms = jnp.where(norms > 0, norms, jnp.ones_like(norms))
    rounding = _rounding(jnp.ones(1, G.dtype), len(G))
    kept = _independent(G / (norms[:, None] * norms[None]), rounding[0])
    at_points = landmarks.index is None and len(landmarks.blocks) == 1
    in_use = kept.reshape(len(landmarks.points) if at_points else len(kept), -1).any(axis=1)
    return Landmarks(landmarks.blocks, landmarks.index, kept, in_use.sum())


def landmarks_of(*blocks: AbstractBlock) -> Landmarks:
    """The landmarks that consist of all rows of some blocks, dependent rows included."""
    size = sum(block.size for block in blocks)
    return Landmarks(blocks, None, jnp.ones(size, bool), jnp.asarray(size))


def _independent(matrix, rounding):
    """Independent columns of a Gram, by pivoted Cholesky until the largest pivot is rounding.

    Without pivoting, columns whose pivots all exceed rounding may still depend on each other: only
    with pivoting does a small eigenvalue show in a small pivot.
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


def _rounding(traces: Float[Array, " P"], columns: int) -> Float[Array, " P"]:
    """The rounding error of pivots that should be zero, given their traces before elimination.

    The error of Cholesky's method is relative to the diagonal entry of the same row.
    """
    return (10 * columns * gram_rounding(jnp.abs(traces))).astype(traces.dtype)


class AbstractCandidates(eqx.Module):
    """P candidates of n rows each, and their Gram."""

    @property
    @abc.abstractmethod
    def traces(self) -> Float[Array, " P"]:
        """The traces of the diagonal blocks of the Gram."""

    @property
    @abc.abstractmethod
    def outputs(self) -> int:
        """The number n of rows of a candidate."""

    @abc.abstractmethod
    def gram(self, index: Int[Array, " B"]) -> Float[Array, "Bn Pn"]:
        """The rows of the Gram that belong to some of the candidates."""


class PointCandidates(AbstractCandidates):
    """All components of the field at points."""

    kernel: AbstractMatrixKernel
    points: Float[Array, "P d"]

    @property
    def traces(self) -> Float[Array, " P"]:
        return block_traces(self.kernel, self.points)

    @property
    def outputs(self) -> int:
        return self.kernel.outputs(self.points.shape[1])

    def gram(self, index: Int[Array, " B"]) -> Float[Array, "Bn Pn"]:
        G = assemble(self.kernel, self.points[index], self.points)
        return G.reshape(G.shape[0] * G.shape[1], -1)


class RowCandidates(AbstractCandidates):
    """Single rows, whose Gram is a matrix."""

    matrix: Float[Array, "P P"]

    @property
    def traces(self) -> Float[Array, " P"]:
        return jnp.diagonal(self.matrix)

    @property
    def outputs(self) -> int:
        return 1

    def gram(self, index: Int[Array, " B"]) -> Float[Array, "B P"]:
        return self.matrix[index]


class _Drawn(NamedTuple):
    """The state of the drawing, in buffers of m + BLOCK points."""

    count: Int[Array, ""]
    index: Int[Array, " m"]
    kept: Bool[Array, "m n"]
    factor: Float[Array, "m n P n"]  # Ĝ = FᵀF over the candidates
    left: Float[Array, " P"]  # the traces of the diagonal blocks of G − Ĝ
    rounding: Float[Array, " P"]  # what a pivot must exceed
    key: Key[Array, ""]
    rounds: Int[Array, ""]


@compiled
def _begin(candidates: AbstractCandidates, left, key, size):
    """The state after the first call of `_draw`."""
    traces, n = candidates.traces, candidates.outputs
    P, buffer = len(traces), size + BLOCK
    zero = jnp.zeros((), int)
    drawn = _Drawn(
        count=zero,
        index=jnp.zeros(buffer, int),
        kept=jnp.zeros((buffer, n), bool),
        factor=jnp.zeros((buffer, n, P, n), traces.dtype),
        left=traces,
        rounding=_rounding(traces, buffer * n),
        key=jax.random.split(key)[1],  # the other is for the candidates
        rounds=zero,
    )
    return _draw(candidates, left, drawn, size)


def _enlarged(drawn: _Drawn, size: int) -> _Drawn:
    def longer(a):
        return jnp.concatenate([a, jnp.zeros((size - len(a), *a.shape[1:]), a.dtype)])

    return drawn._replace(
        index=longer(drawn.index), kept=longer(drawn.kept), factor=longer(drawn.factor)
    )


@compiled
def _draw(candidates: AbstractCandidates, left, drawn, size):
    """Draw blocks until the mean trace is at most `left` or `size` candidates are chosen."""
    goal = jnp.maximum(left, drawn.rounding).sum()

    def more(drawn):
        # The number of rounds is bounded, since rounding errors alone could go on for ever.
        wanted = (drawn.left.sum() > goal) & (drawn.count < size) & (drawn.rounds < 4 * size)
        return wanted | (drawn.rounds == 0)

    return jax.lax.while_loop(more, lambda drawn: _draw_block(candidates, drawn), drawn)


def _draw_block(candidates: AbstractCandidates, drawn: _Drawn) -> _Drawn:
    P, n = len(drawn.left), drawn.kept.shape[1]
    key, draw, accept = jax.random.split(drawn.key, 3)
    index = jax.random.choice(draw, P, (BLOCK,), p=drawn.left / drawn.left.sum())
    size = len(drawn.index)
    factor = drawn.factor.reshape(size * n, P * n)
    at_index = drawn.factor[:, :, index].reshape(size * n, BLOCK * n)
    rows = candidates.gram(index) - at_index.T @ factor
    block = rows.reshape(BLOCK * n, P, n)[:, index].reshape(BLOCK * n, BLOCK * n)
    L, kept = _accepted(accept, block, n, drawn.rounding[index])
    new = jax.scipy.linalg.solve_triangular(L, rows, lower=True)
    new = jnp.where(kept[:, None], new, jnp.zeros_like(new))

    # Refused candidates go to the end of the block, where the next block overwrites them.
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

    Point j is kept with a probability that is the ratio of its trace now to that before the block.
    """
    before = jnp.diagonal(block).reshape(-1, n).sum(axis=1)
    thresholds = jnp.maximum(jax.random.uniform(key, before.shape, block.dtype) * before, rounding)
    return _masked_cholesky(block, thresholds, n, rounding)


def _masked_cholesky(block, thresholds, n, rounding):
    """Cholesky of the points whose trace exceeds its threshold when their turn comes."""

    def column(c, carry):
        block, L, kept, chosen = carry
        now = jax.lax.dynamic_slice(jnp.diagonal(block), ((c // n) * n,), (n,)).sum()
        chosen = jnp.where(c % n == 0, now > thresholds[c // n], chosen)
        pivot = block[c, c]
        keep = chosen & (pivot > rounding[c // n])
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


@compiled
def _first_candidates(drawn, size):
    """The first candidates drawn, at most `size`."""
    used = jnp.arange(size) < drawn.count
    kept = drawn.kept[:size] & used[:, None]
    return drawn.index[:size], kept, jnp.minimum(drawn.count, size)


def whitening(K: AbstractMatrixKernel, landmarks: Landmarks) -> Float[Array, "r r"]:
    """T with T Tᵀ = G_SS⁻¹ on the kept columns, zero on the others."""
    return _inverse_root(landmarks.gram(K), landmarks.kept)


@jax.custom_jvp
@full_precision
def _inverse_root(G: Float[Array, "r r"], kept: Bool[Array, " r"]) -> Float[Array, "r r"]:
    L = jnp.linalg.cholesky(masked(G, kept))
    T = jax.scipy.linalg.solve_triangular(L, jnp.eye(len(G), dtype=G.dtype), lower=True).T
    both = kept[:, None] & kept[None, :]
    return jnp.where(both, T, jnp.zeros_like(T))


@_inverse_root.defjvp
@full_precision
def _(primals, tangents):
    # Only T Tᵀ = G⁻¹ matters, and its derivative is the same with this dT as with that of the
    # Cholesky factor, whose rounding error grows with the condition of G.
    (G, kept), (dG, _) = primals, tangents
    T = _inverse_root(G, kept)
    return T, -0.5 * T @ (T.T @ dG @ T)
