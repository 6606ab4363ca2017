"""The dense Gram."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._kernels.base import Descriptor, Invariance
from hamkernel._machine import RowSharding, automatic, on_each, refuse_beyond_memory
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
        slopes = jax.vmap(jax.vmap(slope, (None, None, 0)), (None, 1, None))(*point, E)
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
