"""The low-rank Gram Ĝ = F Fᵀ of landmarks, F = G_XS L⁻ᵀ, and its sums over any number of points.

F has N n rows and is seen tile by tile only. With L the Cholesky factor of the landmarks' Gram the
columns of F are the orthonormal basis of the span of their kernels, taken at the data: weights w of
F are the field Σⱼ K(x, sⱼ) αⱼ with α = L⁻ᵀw, of norm ‖w‖.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._devices import Rows, on_each
from hamkernel._gram import assemble, block_traces
from hamkernel._gram_operator import tiles
from hamkernel._solve_landmarks import Landmarks, masked
from hamkernel._structured import AbstractMatrixKernel

# Numbers in the tile of the Gram that is held at once; see `_gram_operator`.
TILE = 2**20


class Columns(eqx.Module):
    """The columns of the Gram that belong to landmarks, at some points: (t, n) -> (t, n, r)."""

    kernel: AbstractMatrixKernel
    points: Float[Array, "m n"]

    def __call__(self, X: Float[Array, "t n"]) -> Float[Array, "t n r"]:
        return assemble(self.kernel, X, self.points).reshape(*X.shape, -1)


class Normal(NamedTuple):
    """The sums over the data that the fit needs; sums of parts of the data add up."""

    square: Float[Array, "r r"]  # FᵀF
    moment: Float[Array, " r"]  # Fᵀy
    trace: Float[Array, ""]  # trace G


def whitening(K: AbstractMatrixKernel, landmarks: Landmarks) -> Float[Array, "r r"]:
    """T = L⁻ᵀ with L Lᵀ = G_SS on the kept columns, zero on the others."""
    S, kept = landmarks.points, landmarks.kept.reshape(-1)
    L = jnp.linalg.cholesky(masked(assemble(K, S, S).reshape(S.size, S.size), kept))
    T = jax.scipy.linalg.solve_triangular(L, jnp.eye(S.size, dtype=S.dtype), lower=True).T
    both = kept[:, None] & kept[None, :]
    return jnp.where(both, T, jnp.zeros_like(T))


def normal_sums(
    K: AbstractMatrixKernel,
    S: Float[Array, "m n"],
    T: Float[Array, "r r"],
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    spread: Rows | None = None,
) -> Normal:
    """The sums over all of X and Y, tile by tile, on the devices where the rows are."""
    if spread is not None:

        def part(whole, X, Y):
            K, S, T = whole
            return spread.sum(normal_sums(K, S, T, X, Y))

        return on_each(spread, part, (K, S, T), X, Y, joined=False)
    N, n = X.shape
    rows = max(16, TILE // (S.size * n))
    there = jnp.ones((N, 1), X.dtype)
    none = jnp.zeros((1, n), X.dtype)
    parts = (tiles(X, X[:1], rows), tiles(Y, none, rows), tiles(there, none[:, :1], rows))

    @jax.checkpoint
    def sums(x, y, weight):
        F = (assemble(K, x, S) * weight[:, :, None, None]).reshape(x.size, S.size) @ T
        trace = block_traces(K, x) @ weight[:, 0]
        return Normal(F.T @ F, F.T @ y.reshape(-1), trace)

    def add(total, part):
        return jax.tree.map(jnp.add, total, sums(*part)), None

    zero = Normal(jnp.zeros_like(T), jnp.zeros_like(T[0]), jnp.zeros((), T.dtype))
    return jax.lax.scan(add, zero, parts)[0]


def factor(square: Float[Array, "r r"], ridge: Float[Array, ""]) -> Float[Array, "r r"]:
    """The lower Cholesky factor of FᵀF + ridge I; NaN where the ridge is below rounding."""
    diagonal = jnp.arange(len(square))
    return jnp.linalg.cholesky(square.at[diagonal, diagonal].add(ridge))


def truncated(
    trace: Float[Array, ""], covered: Float[Array, ""], ridge: Float[Array, ""]
) -> Float[Array, ""]:
    """trace(G − Ĝ)/ridge from trace G and trace Ĝ; NaN if Ĝ is larger than G.

    Of a positive definite kernel it is not, but for rounding, of 1e-16 where it was measured; of
    kernels that are not it was by 4 per cent and more.
    """
    left = jnp.where(covered - trace > 1e-3 * jnp.abs(trace), jnp.nan, trace - covered)
    return jnp.maximum(left, jnp.zeros_like(left)) / ridge


INDEFINITE = (
    "the low-rank Gram of the landmarks is larger than the Gram itself, so the kernel is not "
    "positive definite: hk.check_kernel(k, X) tells."
)


def singular(dtype: jnp.dtype) -> str:
    """What to do when the factorisation of the low-rank system fails."""
    return (
        f"the low-rank system plus the ridge N * regularization is not positive definite to "
        f"rounding in {dtype}. Likely causes, in order: the regularization is too small: raise "
        "it; float32 where float64 is needed: jax.config.update('jax_enable_x64', True); a kernel "
        "that is not positive definite or not finite: hk.check_kernel(k, X) tells."
    )
