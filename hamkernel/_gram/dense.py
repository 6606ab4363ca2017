"""The dense Gram of a kernel: of points, and of the rows of observations.

The rows of observations are linear functionals of a field and its potential. Between values of u
and derivatives there is one forward derivative less than between derivatives,

    Cov(u(x), u(z)) = k(x, z),  Cov(u(x), vᵀf(z)) = ∂z k(x, z)·B(z)ᵀv,  Cov(uᵀf(x), vᵀf(z)) = uᵀKv,

the second of which is the potential of the representer K(·, z)v, and the third is `K.form`. A block
of observations maps such covariances at its points to rows.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._kernels.base import Descriptor, Invariance
from hamkernel._machine import RowSharding, automatic, on_each, refuse_beyond_memory
from hamkernel._observations.blocks import AbstractBlock, Combinations, Components
from hamkernel._observations.measurements import Measurements
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel


def gram(
    K: AbstractMatrixKernel, X: Num[ArrayLike, "N n"], Z: Num[ArrayLike, "M n"] | None = None
) -> Float[Array, "N n M n"]:
    """The Gram G[i, a, j, b] = K(xᵢ, zⱼ)[a, b].

    `gram(K, X).reshape(N * n, N * n)` is the symmetric positive semidefinite matrix of the
    representer system. Compiled once for each kernel type and shape, not for each value.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n).
        Z: states, shape (M, n); X if None.

    Returns:
        Shape (N, n, M, n). O(N M n²) time and memory: 8 (N n)² bytes in float64.

    Raises:
        TypeError: K is not matrix-valued. ValueError: shapes do not fit, the structure does not
            allow this n, or the Gram does not fit in memory.
    """
    K = matrix_kernel(K)
    X = require.points(X, "X")
    X, Z = require.same_space(X, X if Z is None else require.points(Z, "Z"))
    K.check_points(X)
    X, Z = automatic(X), automatic(Z)
    cure = "hk.gram_operator(K, X, Z) multiplies with it and never forms it."
    refuse_beyond_memory("the Gram", X.size, Z.size, X.dtype, 1, cure)
    return _compiled_gram(K, X, Z)


@eqx.filter_jit
def _compiled_gram(K, X, Z):
    return assemble(K, X, Z)


def assemble(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """`gram` without its checks and its own compilation."""
    found = K.through_descriptor(X.shape[1])
    if found is not None:
        return _by_jacobians(found, X, Z)
    X, Z = centred(K, X, Z)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)
    # Entry by entry in the order of memory. Computing blocks of K and then moving them to their
    # place was measured to take two to four times as long, most of it for a copy of the Gram.
    form = K.form
    for axis in (3, 2, 1, 0):  # b, zⱼ, a, xᵢ
        form = jax.vmap(form, in_axes=[0 if i == axis else None for i in range(4)])
    return form(X, basis, Z, basis)  # (N, n, M, n)


def _by_jacobians(
    found: Descriptor, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """The Gram J(x)ᵀ [∂d ∂eᵀ κ(d, e)] J(z), with each Jacobian made once and not for each pair.

    A row of blocks costs n gradients of κ a pair and a product with the Jacobians of Z, where
    entries one by one cost n² second derivatives.
    """

    def described(x):
        return found.map(x), jax.jacfwd(found.map)(x) @ found.directions(x)

    (D, J), (E, L) = jax.vmap(described)(X), jax.vmap(described)(Z)  # (N, m), (N, m, n)

    def slope(d, v, e):
        """The gradient in e of the derivative of κ(d, e) along v, (m,)."""
        return jax.grad(lambda e: jax.jvp(lambda d: found.kernel(d, e), (d,), (v,))[1])(e)

    def rows(point):
        d, J = point
        slopes = jax.vmap(jax.vmap(slope, (None, None, 0)), (None, 1, None))(d, J, E)
        return jnp.einsum("ajm,jmb->ajb", slopes, L)  # (n, M, n)

    return jax.lax.map(rows, (D, J))


def diagonals(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "N n"]
) -> Float[Array, "N n"]:
    """The diagonals of the blocks K(xᵢ, zᵢ)."""
    X, Z = centred(K, X, Z)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)
    over_basis = jax.vmap(K.form, in_axes=(None, 0, None, 0))
    return jax.vmap(over_basis, in_axes=(0, None, 0, None))(X, basis, Z, basis)


def block_traces(K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Float[Array, " N"]:
    """The traces of the diagonal blocks of the Gram, tr K(xᵢ, xᵢ)."""
    return diagonals(K, X, X).sum(axis=1)


# Whose blocks are made at once: of a network in a kernel they take kilobytes each. A Gaussian's
# then stay in the cache: 16 ms for a million points, four times as many at once 90 ms.
_POINTS = 1024


def trace(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], spread: RowSharding | None = None
) -> Float[Array, ""]:
    """The trace of the Gram, in O(N n) memory for every kernel, where the rows are."""
    if Invariance.TRANSLATION in K.invariance:  # all blocks on the diagonal are K(0, 0)
        return len(X) * block_traces(K, jnp.zeros((1, X.shape[1]), X.dtype))[0]
    if spread is not None:
        return on_each(spread, lambda K, X: spread.sum(trace(K, X)), K, X, joined=False)

    @jax.checkpoint
    def of_point(x):
        return block_traces(K, x[None])[0]

    return jax.lax.map(of_point, X, batch_size=_POINTS).sum()


def centred(K: AbstractMatrixKernel, x: Array, Z: Float[Array, "M n"]) -> tuple[Array, Array]:
    """Both arguments relative to the mean of Z, where K allows it.

    The product form x·x + z·z − 2x·z loses the digits of (‖x‖/ℓ)²: far from the origin and in
    float32 that is all of them.
    """
    centre = jax.lax.stop_gradient(K.centre(Z))
    if centre is None:
        return x, Z
    return x - centre.reshape((1,) * (x.ndim - 1) + centre.shape), Z - centre[None]


def plus_ridge(G: Float[Array, "D D"], ridge: Float[Array, ""]) -> Float[Array, "D D"]:
    """G + ridge I."""
    return G + ridge * jnp.eye(len(G), dtype=G.dtype)


# Groups of combinations whose points are made at once, for each of which there are Q n rows as long
# as all points of the other side.
_ENTRIES = 1_000_000


def between_all(
    K: AbstractMatrixKernel, block: AbstractBlock, others: tuple[AbstractBlock, ...]
) -> Float[Array, "d e"]:
    """The covariances of the rows of a block with those of others."""
    return jnp.concatenate([between(K, block, other) for other in others], axis=1)


def gram_of_rows(
    K: AbstractMatrixKernel,
    rows: Measurements,
    contrasted: bool = True,
    between_all: Any = between_all,
) -> Float[Array, "D D"]:
    """The Gram of all rows, after the contrast of the energies or before it."""
    found = []
    for i, (block, place) in enumerate(zip(rows.blocks, rows.slices, strict=True)):
        left = [above[:, place].T for above in found]
        found.append(jnp.concatenate([*left, between_all(K, block, rows.blocks[i:])], axis=1))
    G = jnp.concatenate(found)
    return rows.contrast(rows.contrast(G).T) if contrasted and len(rows.energies) else G


# Entries of a Gram up to which it is made at once: in strips 2000 rows took a fifth longer.
_WHOLE = 4_000_000
_STRIP = 500_000  # entries made at once: of some kernels each takes 40 numbers on its way


def regularized_gram(
    K: AbstractMatrixKernel, rows: Measurements, ridge: Float[Array, ""]
) -> Float[Array, "D D"]:
    """The Gram of all rows, after the contrast of the energies, plus ridge I."""
    if rows.states is None or rows.size**2 <= _WHOLE:
        return plus_ridge(gram_of_rows(K, rows), ridge)
    empty = jnp.zeros((rows.size, rows.size), rows.targets.dtype)
    return strips_of_gram((K, rows.points, ridge, 0, len(rows.points)), empty)


def strips_of_gram(asked: tuple, A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """A with some of its rows those of the Gram of velocities plus ridge I, strip by strip.

    Args:
        asked: the kernel, its points, the ridge, the first point whose rows are made, and the
            number of such points, a Python integer.
        A: whose other rows stay as they are.
    """
    K, X, ridge, first, count = asked
    D, n = len(A), len(A) // len(X)
    size = max(1, min(count, _STRIP // (n * D)))

    @jax.checkpoint
    def strip(K, X, ridge, start):
        own = jax.lax.dynamic_slice_in_dim(X, start, size)
        rows = assemble(K, own, X).reshape(size * n, D)
        on_diagonal = jnp.arange(D)[None] == (start * n + jnp.arange(size * n))[:, None]
        return rows + jnp.where(on_diagonal, ridge, jnp.zeros_like(ridge))

    def write(i, A):
        start = first + jnp.minimum(i * size, count - size)
        return jax.lax.dynamic_update_slice_in_dim(A, strip(K, X, ridge, start), start * n, 0)

    return jax.lax.fori_loop(0, -(-count // size), write, A)


def rows_between(
    K: AbstractMatrixKernel, rows: Measurements, block: AbstractBlock
) -> Float[Array, "D d"]:
    """The covariances of all rows with those of a block."""
    return rows.contrast(jnp.concatenate([between(K, each, block) for each in rows.blocks]))


def trace_of_rows(K: AbstractMatrixKernel, rows: Measurements) -> Float[Array, ""]:
    """The trace of the Gram of all rows, before the contrast of the energies."""
    return sum((_trace(K, block) for block in rows.blocks), jnp.zeros((), rows.targets.dtype))


def _trace(K: AbstractMatrixKernel, block: AbstractBlock) -> Float[Array, ""]:
    X = block.points
    if block.of_values:
        variances = jax.vmap(K.potential_covariance)(*centred(K, X, X))
        return jnp.sum(block.rows(variances) / block.scale)
    if not isinstance(block, Combinations):
        return jnp.sum(block.rows(diagonals(K, X, X)) / block.scale)

    def of_group(group):
        one = Combinations(groups=group[0][None], weights=group[1][None])  # pyright: ignore[reportCallIssue]
        return jnp.trace(_mapped(K, one, one))

    return jax.lax.map(of_group, (block.groups, block.weights)).sum()


def components(K: AbstractMatrixKernel, points: Float[Array, "P d"]) -> Components:
    """All components of the field at points, (x, u) of a kernel with inputs."""
    n = K.outputs(points.shape[1])
    return Components(points, outputs=None if n == points.shape[1] else n)


def between(
    K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock
) -> Float[Array, "D d"]:
    """The covariances of the rows of two blocks."""
    if isinstance(right, Combinations) and not isinstance(left, Combinations):
        return between(K, right, left).T
    if not isinstance(left, Combinations):
        return _mapped(K, left, right)

    def of_group(group):
        points, weights = group
        one = Combinations(groups=points[None], weights=weights[None])  # pyright: ignore[reportCallIssue]
        return _mapped(K, one, right)

    # One group after the other: the covariances of all points need not fit in memory.
    at_once = max(1, _ENTRIES // (left.groups[0].size * right.points.size))
    out = jax.lax.map(of_group, (left.groups, left.weights), batch_size=at_once)
    return out.reshape(left.count, -1)


def _mapped(K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock) -> Array:
    """Rows of the left of covariances, and of the right of these."""
    of_left = left.rows(_at_points(K, left, right))  # (D, P′, *n′)
    return jax.vmap(right.rows)(of_left)


def _at_points(K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock) -> Array:
    """The covariances of f or u at the points of the left with f or u at those of the right."""
    X, Z = left.points, right.points
    if not left.of_values and not right.of_values:
        return assemble(K, X, Z)  # (P, n, P′, n)
    if not left.of_values:
        return jnp.moveaxis(_at_points(K, right, left), 0, -1)  # (P, n, P′)
    X, Z = centred(K, X, Z)
    if right.of_values:
        pair = jax.vmap(K.potential_covariance, in_axes=(None, 0))
        return jax.vmap(pair, in_axes=(0, None))(X, Z)  # (P, P′)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)

    def entry(x, z, e):
        return K.potential(x, z[None], e[None])

    for axis in (2, 1, 0):  # b, zⱼ, xᵢ
        entry = jax.vmap(entry, in_axes=[0 if i == axis else None for i in range(3)])
    return entry(X, Z, basis)  # (P, P′, n)
