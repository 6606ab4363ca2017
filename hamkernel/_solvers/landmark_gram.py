"""The low-rank Gram Ĝ = F Fᵀ of landmarks, F = G_XS L⁻ᵀ.

F has N n rows and is seen tile by tile only. With L the Cholesky factor of the landmarks' Gram the
columns of F are the orthonormal basis of the span of their kernels, taken at the data: weights w of
F are the field Σⱼ K(x, sⱼ) αⱼ with α = L⁻ᵀw, of norm ‖w‖.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from hamkernel import _require as require
from hamkernel._gram.dense import plus_ridge
from hamkernel._gram.observed import components
from hamkernel._solvers.landmarks import Landmarks, masked
from hamkernel._structures.base import AbstractMatrixKernel

Learned = TypeVar("Learned")


class Columns(eqx.Module):
    """The columns of the Gram that belong to landmarks, at some points: (t, d) -> (t, n, r)."""

    kernel: AbstractMatrixKernel
    landmarks: Landmarks

    def __call__(self, X: Float[Array, "t d"]) -> Float[Array, "t n r"]:
        columns = self.landmarks.columns(self.kernel, components(self.kernel, X))
        return columns.reshape(len(X), -1, columns.shape[1])


def whitening(K: AbstractMatrixKernel, landmarks: Landmarks) -> Float[Array, "r r"]:
    """T with T Tᵀ = G_SS⁻¹ on the kept columns, zero on the others."""
    return _inverse_root(landmarks.gram(K), landmarks.kept)


@jax.custom_jvp
def _inverse_root(G: Float[Array, "r r"], kept: Bool[Array, " r"]) -> Float[Array, "r r"]:
    L = jnp.linalg.cholesky(masked(G, kept))
    T = jax.scipy.linalg.solve_triangular(L, jnp.eye(len(G), dtype=G.dtype), lower=True).T
    both = kept[:, None] & kept[None, :]
    return jnp.where(both, T, jnp.zeros_like(T))


@_inverse_root.defjvp
def _(primals, tangents):
    # Only T Tᵀ = G⁻¹ matters, which this dT changes as that of the Cholesky factor would; that one
    # rounds by the condition of G.
    (G, kept), (dG, _) = primals, tangents
    T = _inverse_root(G, kept)
    return T, -0.5 * T @ (T.T @ dG @ T)


def factor(square: Float[Array, "r r"], ridge: Float[Array, ""]) -> Float[Array, "r r"]:
    """The lower Cholesky factor of FᵀF + ridge I; NaN where the ridge is below rounding."""
    return jnp.linalg.cholesky(plus_ridge(square, ridge))


def truncated(
    trace: Float[Array, ""], covered: Float[Array, ""], ridge: Float[Array, ""]
) -> Float[Array, ""]:
    """trace(G − Ĝ)/ridge from trace G and trace Ĝ; NaN if Ĝ is larger than G.

    Of a positive definite kernel it is not, but for rounding, of 1e-16 where it was measured; of
    kernels that are not it was by 4 per cent and more.
    """
    left = jnp.where(covered - trace > 1e-3 * jnp.abs(trace), jnp.nan, trace - covered)
    return jnp.maximum(left, jnp.zeros_like(left)) / ridge


def checked(
    learned: Learned,
    landmarks: Landmarks,
    truncation: Float[Array, ""] | None,
    failed: Bool[ArrayLike, ""],
    message: str | Callable[[], str],
    throw: bool,
) -> Learned:
    """What was learned with landmarks, if it was; `message` says what to do where it `failed`.

    Without landmarks all of the Gram must be missing, unless it is zero, and so is the field.
    """
    if truncation is None:
        return require.value(learned, failed, message, RuntimeError, throw)
    none = require.on_host(landmarks.count) == 0
    failed = failed | (none & (require.on_host(truncation) != 0))
    learned = require.value(learned, failed, message, RuntimeError, throw)
    indefinite = (
        "the low-rank Gram of the landmarks is larger than the Gram itself, so the kernel is not "
        "positive definite: hk.check_kernel(k, X) finds out."
    )
    return require.value(learned, require.not_finite(truncation), indefinite, RuntimeError, throw)


def singular(dtype: jnp.dtype) -> str:
    """What to do when the factorisation of the low-rank system fails."""
    return (
        f"the low-rank system plus the ridge N * regularization is not positive definite to "
        f"rounding in {dtype}. Likely causes, in order: the regularization is too small: raise "
        "it; float32 where float64 is needed: jax.config.update('jax_enable_x64', True); a kernel "
        "that is not positive definite or not finite: hk.check_kernel(k, X) finds out."
    )
