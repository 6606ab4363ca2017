"""The dense Gram, and the evaluation of kernel expansions."""

import equinox as eqx
import jax
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._scalar import Invariance
from hamkernel._structured import AbstractMatrixKernel


def gram(
    K: AbstractMatrixKernel, X: ArrayLike, Z: ArrayLike | None = None
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
        TypeError: K is not matrix-valued. ValueError: shapes do not fit, or n is not one that
            the structure allows.
    """
    K = matrix_kernel(K)
    X = require.points(X, "X")
    Z = X if Z is None else require.points(Z, "Z").astype(X.dtype)
    if X.shape[1] != Z.shape[1]:
        raise ValueError(f"X has {X.shape[1]} coordinates and Z has {Z.shape[1]}.")
    K.check_dimension(X.shape[1])
    return _compiled_gram(K, X, Z)


@eqx.filter_jit
def _compiled_gram(K, X, Z):
    return assemble(K, X, Z)


def assemble(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], Z: Float[Array, "M n"]
) -> Float[Array, "N n M n"]:
    """`gram` without its checks and its own compilation."""
    X, Z = centred(K, X, Z)
    over_columns = jax.vmap(K, in_axes=(None, 0), out_axes=1)  # (n, M, n)
    return jax.vmap(over_columns, in_axes=(0, None))(X, Z)  # (N, n, M, n)


@eqx.filter_jit
def expansion(
    K: AbstractMatrixKernel, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> Float[Array, " n"]:
    """f(x) = Σⱼ K(x, zⱼ) aⱼ through the potential, without (n, n) blocks."""
    x, Z = centred(K, x, Z)
    return K.expansion(x, Z, A)


@eqx.filter_jit
def potential(
    K: AbstractMatrixKernel, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> Float[Array, ""]:
    """The potential of `expansion`."""
    x, Z = centred(K, x, Z)
    return K.potential(x, Z, A)


def centred(K: AbstractMatrixKernel, x: Array, Z: Float[Array, "M n"]) -> tuple[Array, Array]:
    """Both arguments relative to the mean of Z, where K allows it.

    The product form x·x + z·z − 2x·z loses the digits of (‖x‖/ℓ)²: far from the origin and in
    float32 that is all of them. A shift-invariant kernel may have its origin among the data.
    """
    if Invariance.TRANSLATION not in K.invariance:
        return x, Z
    centre = jax.lax.stop_gradient(Z.mean(axis=0))
    if x.ndim == 1:
        return x - centre, Z - centre[None]
    return x - centre[None], Z - centre[None]


def matrix_kernel(K: object) -> AbstractMatrixKernel:
    """K, if it is matrix-valued; else a TypeError that says how to make one."""
    if isinstance(K, AbstractMatrixKernel):
        return K
    raise TypeError(
        f"a matrix-valued kernel is needed, got {K!r}. Give a scalar kernel its structure: "
        "hk.Symplectic(k), hk.CurlFree(k), hk.DivergenceFree(k) or hk.Separable(k)."
    )
