"""The dense Gram of a kernel: of points and of rows of observations, its derivatives and rounding.

The rows of observations are linear functionals of a field and its potential. Their covariances are
combinations of three kinds,

    Cov(u(x), u(z)) = k(x, z),  Cov(u(x), vᵀf(z)) = ∂z k(x, z)·B(z)ᵀv,  Cov(uᵀf(x), vᵀf(z)) = uᵀKv,

with none, one and two derivatives of k. The second is the potential of the representer K(·, z)v,
and the third is `K.form`. A block of observations maps the covariances at its points to rows.

A kernel has few hyperparameters, so we take derivatives with respect to them in forward mode. Each
derivative costs about one assembly of the Gram. Reverse mode through the pairs of points cost 6 to
60 assemblies, and several times as long to compile. A kernel with a closed form of its Gram may
choose reverse mode: the kernel of `hk.compare` needs four assemblies for all derivatives.
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
from hamkernel._kernels.symmetry import drop_symmetry
from hamkernel._machine import (
    RowSharding,
    automatic,
    full_precision,
    map_devices,
    precise_jit,
    refuse_beyond_memory,
)
from hamkernel._observations.blocks import AbstractBlock, Combinations, Components
from hamkernel._observations.measurements import Measurements
from hamkernel._sizes import sizes
from hamkernel._structures.base import AbstractMatrixKernel, Sum, matrix_kernel, total
from hamkernel._structures.structure import mixed_derivative


@full_precision
def gram(
    K: AbstractMatrixKernel, X: Num[ArrayLike, "N n"], Z: Num[ArrayLike, "M n"] | None = None
) -> Float[Array, "N n M n"]:
    """The Gram G[i, a, j, b] = K(xᵢ, zⱼ)[a, b].

    `gram(K, X).reshape(N * n, N * n)` is symmetric and positive semidefinite. JAX compiles once for
    each type of kernel and shape of the data, not for each value.

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
    X, Z = require.one_space(X, X if Z is None else require.points(Z, "Z"))
    K.check_points(X)
    X, Z = automatic(X), automatic(Z)
    cure = "hk.gram_operator(K, X, Z) multiplies with the Gram and never forms it."
    refuse_beyond_memory("the Gram", X.size, Z.size, X.dtype, 1, cure)
    return _assemble(K, X, Z)


def assemble(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """`gram` without its checks and its own compilation."""
    n = X.shape[1]
    if isinstance(K, Sum) and any(term.through_descriptor(n) for term in K.terms):
        return total([assemble(term, X, Z) for term in K.terms])
    descriptor = K.through_descriptor(n)
    if descriptor is not None:
        return _gram_of_descriptor(descriptor, X, Z)
    closed = K.blocks(X, Z)
    if closed is not None:
        return closed
    X, Z = subtract_centre(K, X, Z)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)
    # Entries are computed in the order of memory. Computing blocks of K and transposing them took
    # two to four times as long, most of it for a copy of the Gram.
    form = K.form
    for axis in (3, 2, 1, 0):  # b, zⱼ, a, xᵢ
        form = jax.vmap(form, in_axes=[0 if i == axis else None for i in range(4)])
    return form(X, basis, Z, basis)  # (N, n, M, n)


_assemble = precise_jit(assemble)


def _gram_of_descriptor(
    descriptor: Descriptor, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """The Gram of a kernel of descriptors, k(x, z) = κ(d(x), d(z)).

    With the Jacobian J_d = ∂d/∂x, shape (m, n), and the directions D(x) along which the structure
    differentiates, D = B(x)ᵀ, the chain rule gives

        K(x, z) = (J_d(x) D(x))ᵀ [∂_d ∂_eᵀ κ(d, e)] (J_d(z) D(z)),    d = d(x), e = d(z).

    We compute each Jacobian once per point. A row of blocks then costs n gradients of κ per pair
    and a product with the Jacobians of Z, instead of n² second derivatives per pair.

    Source: Chmiela, Sauceda, Müller & Tkatchenko (2018), Nature Communications 9, 3887.
    """
    # (N, m) and (N, m, n), (M, m) and (M, m, n)
    values_and_jacobians = jax.vmap(descriptor.value_and_jacobian)
    (D, J), (E, L) = values_and_jacobians(X), values_and_jacobians(Z)

    def slope(d, v, e):
        """The gradient in e of the derivative of κ(d, e) along v, (m,)."""
        return jax.grad(lambda e: jax.jvp(lambda d: descriptor.kernel(d, e), (d,), (v,))[1])(e)

    def rows(point):
        d, J = point
        slopes = jax.vmap(jax.vmap(slope, (None, None, 0)), (None, 1, None))(d, J, E)  # (n, M, m)
        return jnp.einsum("ajm,jmb->ajb", slopes, L)  # (n, M, n)

    return jax.lax.map(rows, (D, J))


def diagonals(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "N n"]
) -> Float[Array, "N n"]:
    """The diagonals of the blocks K(xᵢ, zᵢ)."""
    X, Z = subtract_centre(K, X, Z)
    basis = jnp.eye(K.outputs(X.shape[1]), dtype=X.dtype)
    over_basis = jax.vmap(K.form, in_axes=(None, 0, None, 0))
    return jax.vmap(over_basis, in_axes=(0, None, 0, None))(X, basis, Z, basis)


def block_traces(K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Float[Array, " N"]:
    """The traces of the diagonal blocks of the Gram, tr K(xᵢ, xᵢ)."""
    if isinstance(K, Sum):
        return total([block_traces(term, X) for term in K.terms])
    descriptor = K.through_descriptor(X.shape[1])
    if descriptor is None:
        return diagonals(K, X, X).sum(axis=1)

    def block_trace(x):
        d, J = descriptor.value_and_jacobian(x)
        return jax.vmap(lambda v: mixed_derivative(descriptor.kernel, d, v, d, v))(J.T).sum()

    return jax.lax.map(block_trace, X)


def trace(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], spread: RowSharding | None = None
) -> Float[Array, ""]:
    """The trace of the Gram of X, in O(N n) memory; each device adds up its own rows."""
    if Invariance.TRANSLATION in K.invariance:  # all blocks on the diagonal are K(0, 0)
        return len(X) * block_traces(K, jnp.zeros((1, X.shape[1]), X.dtype))[0]

    def trace_of_points(K, X):
        trace_of_point = jax.checkpoint(lambda x: block_traces(K, x[None])[0])
        return jax.lax.map(trace_of_point, X, batch_size=sizes().trace_points).sum()

    return map_devices(spread, trace_of_points, K, X, joined=False)


def subtract_centre(
    K: AbstractMatrixKernel, x: Array, Z: Float[Array, "M n"]
) -> tuple[Array, Array]:
    """Both arguments relative to the mean of Z, if K is invariant under translations.

    The product form x·x + z·z − 2x·z has a relative error of ε (‖x‖/ℓ)²; far from the origin, in
    float32, no digit remains.
    """
    centre = jax.lax.stop_gradient(K.centre(Z))
    if centre is None:
        return x, Z
    return x - centre.reshape((1,) * (x.ndim - 1) + centre.shape), Z - centre[None]


def plus_ridge(G: Float[Array, "D D"], ridge: Float[Array, ""]) -> Float[Array, "D D"]:
    """G + ridge I."""
    return G + ridge * jnp.eye(len(G), dtype=G.dtype)


def between_all(
    K: AbstractMatrixKernel, block: AbstractBlock, blocks: tuple[AbstractBlock, ...]
) -> Float[Array, "d e"]:
    """The covariances of the rows of one block with the rows of several blocks."""
    return jnp.concatenate([between(K, block, right) for right in blocks], axis=1)


def gram_of_rows(
    K: AbstractMatrixKernel,
    rows: Measurements,
    contrasted: bool = True,
    between_all: Any = between_all,
) -> Float[Array, "D D"]:
    """The Gram of all rows, after the contrast of the energies or before it."""
    strips = []
    for i, (block, place) in enumerate(zip(rows.blocks, rows.slices, strict=True)):
        lower = [above[:, place].T for above in strips]
        strips.append(jnp.concatenate([*lower, between_all(K, block, rows.blocks[i:])], axis=1))
    G = jnp.concatenate(strips)
    return rows.contrast(rows.contrast(G).T) if contrasted and len(rows.energies) else G


def regularized_gram(
    K: AbstractMatrixKernel, rows: Measurements, ridge: Float[Array, ""]
) -> Float[Array, "D D"]:
    """The Gram of all rows, after the contrast of the energies, plus ridge I."""
    if rows.states is None or rows.size <= 2000:  # strips took 20 % longer for 2000 rows
        return plus_ridge(gram_of_rows(K, rows), ridge)
    empty = jnp.zeros((rows.size, rows.size), rows.targets.dtype)
    return strips_of_gram((K, rows.points, ridge, 0, len(rows.points)), empty)


def strips_of_gram(args: tuple, A: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """The matrix A, with the rows of some points replaced by rows of the Gram plus ridge I.

    The rows are computed in strips, so that the intermediate arrays stay small.

    Args:
        args: (kernel, points, ridge, first, count), packed into one tuple because everything else
            is donated. Rows of the points first, …, first + count − 1 are computed; count is
            static.
        A: the matrix (D, D); the other rows do not change.
    """
    K, X, ridge, first, count = args
    D, n = len(A), len(A) // len(X)
    size = max(1, min(count, sizes().strip_entries // (n * D)))

    @jax.checkpoint
    def strip(K, X, ridge, start):
        points = jax.lax.dynamic_slice_in_dim(X, start, size)
        rows = assemble(K, points, X).reshape(size * n, D)
        on_diagonal = jnp.arange(D)[None] == (start * n + jnp.arange(size * n))[:, None]
        return rows + jnp.where(on_diagonal, ridge, jnp.zeros_like(ridge))

    def write(i, A):
        start = first + jnp.minimum(i * size, count - size)
        return jax.lax.dynamic_update_slice_in_dim(A, strip(K, X, ridge, start), start * n, 0)

    return jax.lax.fori_loop(0, -(-count // size), write, A)


def rows_between(
    K: AbstractMatrixKernel, rows: Measurements, block: AbstractBlock
) -> Float[Array, "D d"]:
    """The covariances of all rows with the rows of a block."""
    return rows.contrast(
        jnp.concatenate([between(K, row_block, block) for row_block in rows.blocks])
    )


def trace_of_rows(
    K: AbstractMatrixKernel, rows: Measurements, spread: RowSharding | None = None
) -> Float[Array, ""]:
    """The trace of the Gram of all rows, before the contrast of the energies."""
    if rows.states is not None:
        return trace(K, rows.states[0], spread)
    return sum((_trace(K, block) for block in rows.blocks), jnp.zeros((), rows.targets.dtype))


def _trace(K: AbstractMatrixKernel, block: AbstractBlock) -> Float[Array, ""]:
    X = block.points
    if block.of_values:
        variances = jax.vmap(K.potential_covariance)(*subtract_centre(K, X, X))
        return jnp.sum(block.rows(variances) / block.scale)
    if not isinstance(block, Combinations):
        return jnp.sum(block.rows(diagonals(K, X, X)) / block.scale)

    def trace_of_group(group):
        one = Combinations(groups=group[0][None], weights=group[1][None])  # pyright: ignore[reportCallIssue]
        return jnp.trace(_map_rows(K, one, one))

    return jax.lax.map(trace_of_group, (block.groups, block.weights)).sum()


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
        return _map_rows(K, left, right)

    def rows_of_group(group):
        points, weights = group
        one = Combinations(groups=points[None], weights=weights[None])  # pyright: ignore[reportCallIssue]
        return _map_rows(K, one, right)

    # The covariances at the points of all groups may not fit in memory. Groups are batched so
    # that the covariances of one batch, Q n rows for each group, have about 10⁶ entries (8 MB).
    batch = max(1, 1_000_000 // (left.groups[0].size * right.points.size))
    out = jax.lax.map(rows_of_group, (left.groups, left.weights), batch_size=batch)
    return out.reshape(left.count, -1)


def _map_rows(K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock) -> Array:
    """The covariances of the rows of two blocks, from those of the field at their points."""
    left_rows = left.rows(_covariances_at_points(K, left, right))  # (D, P′, *n′)
    return jax.vmap(right.rows)(left_rows)


def _covariances_at_points(
    K: AbstractMatrixKernel, left: AbstractBlock, right: AbstractBlock
) -> Array:
    """The covariances of f or u at the points of one block with f or u at the points of another."""
    X, Z = left.points, right.points
    if not left.of_values and not right.of_values:
        return assemble(K, X, Z)  # (P, n, P′, n)
    if not left.of_values:
        return jnp.moveaxis(_covariances_at_points(K, right, left), 0, -1)  # (P, n, P′)
    X, Z = subtract_centre(K, X, Z)
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
    """The array make(K, data); derivatives with respect to K use forward mode.

    For a cotangent Ḡ of the array G and a hyperparameter h_p, h̄_p = ⟨Ḡ, ∂G/∂h_p⟩. This is one JVP
    for each hyperparameter, and costs about one assembly of G. Reverse mode would go backward
    through N² pairs of points, so forward mode is cheaper for few hyperparameters.

    With `rowwise`, make(K, data) is a pair (rows, X) of a function g and points, and the array is
    G = g(X), with one row for each point. The pairing is then summed strip by strip,
    h̄_p = Σ_i ⟨Ḡ_i, ∂g(x_i)/∂h_p⟩, in the memory of one strip.
    """
    return _array(make, rowwise, *kernel_and_data)


@forward_differentiated.def_fwd
def _(perturbed, kernel_and_data, make, rowwise=False):
    return forward_differentiated(kernel_and_data, make, rowwise), None


@forward_differentiated.def_bwd
@full_precision
def _(saved, bar, perturbed, kernel_and_data, make, rowwise=False):
    K, data = kernel_and_data

    def pair(K, data, bar):
        if not rowwise:
            return jnp.vdot(bar, make(K, data))
        rows, X = make(K, data)
        return _pair_by_strips(rows, X, bar)

    params, static = eqx.partition(K, eqx.is_inexact_array)
    arrays, rest = eqx.partition(data, eqx.is_inexact_array)
    perturbs_data = any(jax.tree.leaves(perturbed[1]))
    if K.differentiated_backward and not perturbs_data:
        _, pull = jax.vjp(lambda p: _array(make, rowwise, eqx.combine(p, static), data), params)
        return pull(bar)[0], jax.tree.map(lambda _: None, arrays)
    flat, unravel = ravel_pytree(params)

    def slope(direction):
        # The barrier makes every intermediate depend on the direction. Otherwise XLA would move
        # intermediates out of the loop and keep several arrays of the size of the Gram.
        here, direction = jax.lax.optimization_barrier((flat, direction))
        at = lambda h: pair(eqx.combine(unravel(h), static), data, bar)  # noqa: E731
        return jax.jvp(at, (here,), (direction,))[1]

    # Directions in one batch share the intermediates that do not depend on the direction. A batch
    # holds as many directions as give up to 200 000 entries of the array and its derivatives.
    largest = max(array.size for array in [bar, *jax.tree.leaves(arrays)])
    batch = min(flat.size, 200_000 // largest)
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    slopes = jax.lax.map(slope, directions, batch_size=batch if batch > 1 else None)
    K_bar = unravel(slopes.astype(flat.dtype))
    if not perturbs_data:
        return K_bar, jax.tree.map(lambda _: None, arrays)
    _, pull = jax.vjp(lambda arrays: _array(make, rowwise, K, eqx.combine(arrays, rest)), arrays)
    return K_bar, pull(bar)[0]


def _array(make, rowwise: bool, K, data) -> Array:
    if not rowwise:
        return make(K, data)
    rows, X = make(K, data)
    return rows(X)


def _pair_by_strips(rows, X: Float[Array, "N n"], bar: Float[Array, "N ..."]) -> Float[Array, ""]:
    """⟨bar, rows(X)⟩, in strips.

    The products of the strips are added entry by entry, and summed once at the end. If XLA fuses a
    sum with the computation of its terms, the sum runs in one thread and takes four times as long.
    Each strip is sliced out of `bar`; `over_tiles` would reshape `bar` and thereby copy it.
    """
    N = len(X)
    if bar.size <= 10_000:  # one strip is as fast, and compiles faster
        return jnp.vdot(bar, rows(X))
    # Strips of 200 000 entries, whose derivatives hold up to 13 arrays of this size. There are at
    # least four strips, since a shorter loop is unrolled.
    points = max(1, min(N // 4, 200_000 * N // bar.size))

    def strip(start, count):
        x, bar_strip = (jax.lax.dynamic_slice_in_dim(array, start, count) for array in (X, bar))
        return bar_strip * rows(x)

    def add(total, start):
        return total + strip(start, points), None

    starts = jnp.arange(0, N - points + 1, points)
    total, _ = jax.lax.scan(add, jnp.zeros((points, *bar.shape[1:]), bar.dtype), starts)
    remainder = N % points
    return total.sum() + (strip(N - remainder, remainder).sum() if remainder else 0.0)


def stop_gradients(tree):
    """A copy of the PyTree whose arrays are constants for JAX's derivatives (`stop_gradient`)."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(jax.lax.stop_gradient, arrays), rest)


def gram_rounding(trace: Float[Array, "..."]) -> Float[Array, "..."]:
    """ε tr(G), the size of the rounding errors in products with the Gram G and in its factors.

    A ridge or a pivot below this number is lost in the rounding. `trace` may be the trace of G, of
    its diagonal blocks, or of G/N for a bound of λ.
    """
    return jnp.finfo(trace.dtype).eps * trace


def size_of_terms(
    K: AbstractMatrixKernel, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> Float[Array, ""]:
    """‖Σⱼ |K(x, zⱼ) aⱼ|‖, the size of f(x) if its terms did not cancel."""
    K = drop_symmetry(K)
    terms = jax.vmap(lambda z, a: K.expansion(x, z[None], a[None]))(Z, A)
    return jnp.linalg.norm(jnp.sum(jnp.abs(terms), axis=0))


@precise_jit
def field_rounding(
    K: AbstractMatrixKernel,
    x: Float[Array, " n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
    velocity: Float[Array, " n"],
    limit: float = jnp.inf,
) -> Float[Array, ""]:
    """ε ‖Σⱼ |K(x, zⱼ) aⱼ|‖ / ‖f(x)‖, the relative rounding error of f(x) = Σⱼ K(x, zⱼ) aⱼ.

    If the ridge is small, the terms are large and of both signs, and each rounds to ε of its size.
    The error is clipped at `limit`, since it grows without bound where f(x) tends to zero.
    """
    size = size_of_terms(K, x, Z, A)
    tiny = jnp.finfo(x.dtype).tiny
    share = jnp.finfo(x.dtype).eps * size / jnp.maximum(jnp.linalg.norm(velocity), tiny)
    return jax.lax.stop_gradient(jnp.minimum(share, limit).astype(x.dtype))
