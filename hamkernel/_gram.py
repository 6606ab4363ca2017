"""The dense Gram of a kernel: of points and of rows of observations, its derivatives and rounding.

The rows of observations are linear functionals of a field and its potential. Their covariances are
made of three, of which those with a value of u take fewer derivatives,

    Cov(u(x), u(z)) = k(x, z),  Cov(u(x), vᵀf(z)) = ∂z k(x, z)·B(z)ᵀv,  Cov(uᵀf(x), vᵀf(z)) = uᵀKv,

The second is the potential of the representer K(·, z)v, and the third is `K.form`. A block of
observations maps the covariances at its points to rows.

Derivatives with respect to the hyperparameters of a kernel, of which there are few, are taken in
forward mode: each costs about one assembly. Reverse mode through the pairs of points was measured
at 6 to 60 assemblies, and takes several times as long to compile. A kernel that writes its Gram
itself may say that reverse mode is cheaper: that of `hk.compare` takes four assemblies for all.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._kernels.base import Descriptor, Invariance
from hamkernel._kernels.symmetry import without_symmetry
from hamkernel._machine import (
    RowSharding,
    automatic,
    compiled,
    full_precision,
    on_each,
    refuse_beyond_memory,
)
from hamkernel._observations.blocks import AbstractBlock, Combinations, Components
from hamkernel._observations.measurements import Measurements
from hamkernel._sizes import sizes
from hamkernel._structures.base import AbstractMatrixKernel, Sum, matrix_kernel, total
from hamkernel._structures.structure import mixed


@full_precision
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


@compiled
def _compiled_gram(K, X, Z):
    return assemble(K, X, Z)


def assemble(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """`gram` without its checks and its own compilation."""
    n = X.shape[1]
    if isinstance(K, Sum) and any(term.through_descriptor(n) for term in K.terms):
        return total([assemble(term, X, Z) for term in K.terms])
    found = K.through_descriptor(n)
    if found is not None:
        return _by_jacobians(found, X, Z)
    closed = K.blocks(X, Z)
    if closed is not None:
        return closed
    X, Z = centred(K, X, Z)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)
    # Entries are computed in the order of memory. Blocks of K that are moved to their place
    # afterwards took two to four times as long, most of it for a copy of the Gram.
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
    (D, J), (E, L) = jax.vmap(found.at)(X), jax.vmap(found.at)(Z)  # (N, m), (N, m, n)

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
    if isinstance(K, Sum):
        return total([block_traces(term, X) for term in K.terms])
    found = K.through_descriptor(X.shape[1])
    if found is None:
        return diagonals(K, X, X).sum(axis=1)

    def of_point(x):
        d, J = found.at(x)
        return jax.vmap(lambda v: mixed(found.kernel, d, v, d, v))(J.T).sum()

    return jax.lax.map(of_point, X)


def trace(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], spread: RowSharding | None = None
) -> Float[Array, ""]:
    """The trace of the Gram of X, in O(N n) memory; each device adds up its own rows."""
    if Invariance.TRANSLATION in K.invariance:  # all blocks on the diagonal are K(0, 0)
        return len(X) * block_traces(K, jnp.zeros((1, X.shape[1]), X.dtype))[0]

    def of_points(K, X):
        of_point = jax.checkpoint(lambda x: block_traces(K, x[None])[0])
        return jax.lax.map(of_point, X, batch_size=sizes().trace_points).sum()

    return on_each(spread, of_points, K, X, joined=False)


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


# The largest number of entries of a strip: some kernels hold 40 intermediate numbers for each, and
# these are then 160 MB.
_STRIP = 500_000


def regularized_gram(
    K: AbstractMatrixKernel, rows: Measurements, ridge: Float[Array, ""]
) -> Float[Array, "D D"]:
    """The Gram of all rows, after the contrast of the energies, plus ridge I."""
    if rows.states is None or rows.size <= 2000:  # in strips 2000 rows took a fifth longer
        return plus_ridge(gram_of_rows(K, rows), ridge)
    empty = jnp.zeros((rows.size, rows.size), rows.targets.dtype)
    return strips_of_gram((K, rows.points, ridge, 0, len(rows.points)), empty)


def strips_of_gram(asked: tuple, A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """A, in which the rows of some points are replaced by those of the Gram plus ridge I.

    The rows are computed in strips, so that the intermediate arrays stay small.

    Args:
        asked: the kernel, its points, the ridge, the first point whose rows are made, and the
            number of such points, a Python integer.
        A: the matrix, whose other rows are kept.
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

    # The covariances at the points of all groups may not fit in memory. So many groups are taken
    # at once that theirs, Q n rows for each group, have some million entries, 8 MB.
    at_once = max(1, 1_000_000 // (left.groups[0].size * right.points.size))
    out = jax.lax.map(of_group, (left.groups, left.weights), batch_size=at_once)
    return out.reshape(left.count, -1)


def _mapped(K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock) -> Array:
    """The covariances of the rows of two blocks, from those of the field at their points."""
    of_left = left.rows(_at_points(K, left, right))  # (D, P′, *n′)
    return jax.vmap(right.rows)(of_left)


def _at_points(K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock) -> Array:
    """The covariances of f or u at the points of one block with f or u at those of the other."""
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


@eqx.filter_custom_vjp
def forward_differentiated(kernel_and_data, make, rowwise: bool = False):
    """The array make(K, data), whose derivatives with respect to K are taken in forward mode.

    With `rowwise` the value of make(K, data) is a pair (rows, X) of a function and points, and the
    array is rows(X), with one row for each point. Its derivatives take the memory of a strip of
    rows.
    """
    return _array(make, rowwise, *kernel_and_data)


@forward_differentiated.def_fwd
def _(perturbed, kernel_and_data, make, rowwise=False):
    return forward_differentiated(kernel_and_data, make, rowwise), None


@forward_differentiated.def_bwd
@full_precision
def _(saved, bar, perturbed, kernel_and_data, make, rowwise=False):
    K, data = kernel_and_data

    def paired(K, data, bar):
        if not rowwise:
            return jnp.vdot(bar, make(K, data))
        rows, X = make(K, data)
        return _paired_by_rows(rows, X, bar)

    params, static = eqx.partition(K, eqx.is_inexact_array)
    arrays, rest = eqx.partition(data, eqx.is_inexact_array)
    of_data = any(jax.tree.leaves(perturbed[1]))
    if K.differentiated_backward and not of_data:
        _, pull = jax.vjp(lambda p: _array(make, rowwise, eqx.combine(p, static), data), params)
        return pull(bar)[0], jax.tree.map(lambda _: None, arrays)
    flat, unravel = ravel_pytree(params)

    def slope(direction):
        # The barrier makes every intermediate depend on the direction. XLA would compute those
        # that do not before the loop and keep them, several arrays of the size of the Gram.
        here, direction = jax.lax.optimization_barrier((flat, direction))
        at = lambda h: paired(eqx.combine(unravel(h), static), data, bar)  # noqa: E731
        return jax.jvp(at, (here,), (direction,))[1]

    # Directions that are taken together share the intermediates that do not depend on them. So
    # many are taken together that the array and its derivatives have up to 200 000 entries.
    largest = max(each.size for each in [bar, *jax.tree.leaves(arrays)])
    together = min(flat.size, 200_000 // largest)
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    slopes = jax.lax.map(slope, directions, batch_size=together if together > 1 else None)
    K_bar = unravel(slopes.astype(flat.dtype))
    if not of_data:
        return K_bar, jax.tree.map(lambda _: None, arrays)
    _, pull = jax.vjp(lambda arrays: _array(make, rowwise, K, eqx.combine(arrays, rest)), arrays)
    return K_bar, pull(bar)[0]


def _array(make, rowwise: bool, K, data) -> Array:
    if not rowwise:
        return make(K, data)
    rows, X = make(K, data)
    return rows(X)


def _paired_by_rows(rows, X: Float[Array, "N n"], bar: Float[Array, "N ..."]) -> Float[Array, ""]:
    """⟨bar, rows(X)⟩, in strips.

    The products of the strips are added entry by entry, and summed once at the end: a sum that XLA
    fuses with the computation of its terms runs in one thread and takes four times as long. Each
    strip is sliced out of `bar`, since `over_tiles` would reshape, and so copy, the whole array.
    """
    N = len(X)
    if bar.size <= 10_000:  # as fast at once, and sooner compiled
        return jnp.vdot(bar, rows(X))
    # Strips of 200 000 entries, whose derivatives hold up to 13 arrays of this size. There are at
    # least four strips, since a shorter loop is unrolled.
    points = max(1, min(N // 4, 200_000 * N // bar.size))

    def strip(start, count):
        x, own = (jax.lax.dynamic_slice_in_dim(each, start, count) for each in (X, bar))
        return own * rows(x)

    def add(total, start):
        return total + strip(start, points), None

    starts = jnp.arange(0, N - points + 1, points)
    total, _ = jax.lax.scan(add, jnp.zeros((points, *bar.shape[1:]), bar.dtype), starts)
    left = N % points
    return total.sum() + (strip(N - left, left).sum() if left else 0.0)


def constant(tree):
    """The PyTree with `stop_gradient` applied to its arrays; leaves of other kinds are kept."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(jax.lax.stop_gradient, arrays), rest)


def gram_rounding(trace: Float[Array, "..."]) -> Float[Array, "..."]:
    """ε tr(G), the size of the rounding errors in products with the Gram G and in its factors.

    A ridge or a pivot that is smaller than this number is lost in the rounding. `trace` may be that
    of G, of its diagonal blocks, or of G/N, for a bound of λ.
    """
    return jnp.finfo(trace.dtype).eps * trace


@compiled
def field_rounding(
    K: AbstractMatrixKernel,
    x: Float[Array, " n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
    velocity: Float[Array, " n"],
    most: float = jnp.inf,
) -> Float[Array, ""]:
    """ε ‖Σⱼ |K(x, zⱼ) aⱼ|‖ / ‖f(x)‖, the relative rounding error of f(x) = Σⱼ K(x, zⱼ) aⱼ.

    The error is cut off at `most`, since it grows without bound where f(x) tends to zero. Where the
    ridge is small the terms are large and of both signs, and each rounds to ε of itself.
    """
    K = without_symmetry(K)
    terms = jax.vmap(lambda z, a: K.expansion(x, z[None], a[None]))(Z, A)
    size = jnp.linalg.norm(jnp.sum(jnp.abs(terms), axis=0))
    least = jnp.finfo(x.dtype).tiny
    share = jnp.finfo(x.dtype).eps * size / jnp.maximum(jnp.linalg.norm(velocity), least)
    return jax.lax.stop_gradient(jnp.minimum(share, most).astype(x.dtype))
