"""Regularised least squares in the span of landmarks: O(N r²) time, O(N n + r²) memory.

With S the landmarks, L the Cholesky factor of their Gram and F = G_XS L⁻ᵀ, the Gram is nearly
Ĝ = F Fᵀ, and the field Σⱼ K(x, sⱼ) αⱼ with α = L⁻ᵀw minimises ‖y − F w‖² + Nλ‖w‖². F is seen tile
by tile and only the sums FᵀF and Fᵀy stay.

The matrix FᵀF + NλI has the condition of G + NλI, not its square: these are no normal equations in
α, which would lose twice the digits. What the sums round off is given back by one step of
refinement with the residual of the data (Björck's corrected seminormal equations).
"""

import math
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hamkernel import _require as require
from hamkernel._field import KernelField, SolverInfo
from hamkernel._gram import assemble
from hamkernel._gram_operator import product, tiles
from hamkernel._solve import AbstractSolver
from hamkernel._solve_landmarks import Landmarks, choose_landmarks, masked
from hamkernel._structured import AbstractMatrixKernel

# Numbers in the tile of the Gram that is held at once; see `_gram_operator`.
TILE = 2**20


class Nystrom(AbstractSolver):
    """A low-rank fit: the field lives on a few landmarks, chosen from the data.

    Landmarks are drawn by randomly pivoted Cholesky until trace(G − Ĝ) ≤ tolerance · Nλ. Then the
    fitted values ŷ differ from those of the exact fit by at most tolerance · ‖y − ŷ‖, since the
    difference is Nλ (G + NλI)⁻¹ (G − Ĝ) (Ĝ + NλI)⁻¹ y. So more noise and a larger λ need fewer
    landmarks, and N does not matter. Smooth kernels in few dimensions need tens to hundreds. The
    result carries `field.info.landmarks`, `.rank` and the `.truncation` that was reached.

    Under jit, vmap and grad the number of landmarks cannot depend on values: buffers have the size
    of `max_points`. Derivatives hold the landmarks fixed.

    Args:
        tolerance: the bound on trace(G − Ĝ)/(Nλ), dimensionless.
        max_points: the largest number of landmarks m; memory 16 (m n)² bytes in float64.
        candidates: landmarks are chosen from the data, or from a random part of this size.
        key: for the draws; `jax.random.key(0)` if None, so that a fit can be repeated.

    Raises:
        ValueError: an argument is not positive.

    Warns:
        UserWarning: `max_points` landmarks do not reach the tolerance.

    Source: Chen, Epperly, Tropp & Webber (2023), arXiv 2207.06503; Björck (1987) for the solve.
    """

    tolerance: float = eqx.field(static=True)
    max_points: int = eqx.field(static=True)
    candidates: int = eqx.field(static=True)
    key: PRNGKeyArray | None

    def __init__(
        self,
        tolerance: float = 0.1,
        max_points: int = 512,
        candidates: int = 4096,
        key: PRNGKeyArray | None = None,
    ):
        if not (tolerance > 0 and math.isfinite(tolerance)):
            raise ValueError(f"tolerance must be positive and finite, got {tolerance}.")
        if max_points < 1 or candidates < 1:
            raise ValueError(
                f"max_points and candidates must be at least 1, got {max_points} and {candidates}."
            )
        self.tolerance = float(tolerance)
        self.max_points = max_points
        self.candidates = candidates
        self.key = key

    def landmarks(
        self, K: AbstractMatrixKernel, X: Float[Array, "N n"], regularization: Float[Array, ""]
    ) -> Landmarks:
        """The points that reach the tolerance, or `max_points` of them."""
        key = jax.random.key(0) if self.key is None else self.key
        left = self.tolerance * regularization
        return choose_landmarks(K, X, left, self.max_points, self.candidates, key)

    def fit(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
    ) -> KernelField:
        landmarks = self.landmarks(K, X, regularization)
        A, residual, norm, truncation = _fit(K, X, Y, regularization, landmarks)
        failed = ~jnp.isfinite(A).all() | (landmarks.count == 0)
        A = require.value(A, failed, singular(X.dtype), RuntimeError)
        self._warn_if_truncated(truncation, landmarks)
        return KernelField(
            kernel=K,
            points=landmarks.points,
            coefficients=A,
            residual=residual,
            norm=norm,
            regularization=regularization,
            offset=jnp.zeros((), X.dtype),
            info=SolverInfo(
                "Nystrom",
                landmarks=landmarks.count,
                rank=landmarks.kept.sum(),
                truncation=truncation,
            ),
        )

    def _warn_if_truncated(self, truncation, landmarks):
        if not require.is_concrete(truncation, landmarks):
            return
        # Twice: a random part of the data need not show all that the rest has.
        if truncation > 2 * self.tolerance and int(landmarks.count) >= self.max_points:
            warnings.warn(
                f"{self.max_points} landmarks leave trace(G - Ĝ)/(N λ) = {float(truncation):.2g}, "
                f"more than the tolerance {self.tolerance:.2g}. The field is the best one on these "
                "landmarks, but may be far from the exact fit. Raise max_points, the tolerance or "
                "the regularization; for a rough kernel or many dimensions take "
                "hk.ConjugateGradient(), which is exact.",
                stacklevel=4,
            )


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
) -> Normal:
    """The sums over all of X and Y, tile by tile."""
    N, n = X.shape
    rows = max(16, TILE // (S.size * n))
    there = jnp.ones((N, 1), X.dtype)
    none = jnp.zeros((1, n), X.dtype)
    parts = (tiles(X, X[:1], rows), tiles(Y, none, rows), tiles(there, none[:, :1], rows))

    @jax.checkpoint
    def sums(x, y, weight):
        F = (assemble(K, x, S) * weight[:, :, None, None]).reshape(x.size, S.size) @ T
        trace = jax.vmap(lambda x: jnp.trace(K(x, x)))(x) @ weight[:, 0]
        return Normal(F.T @ F, F.T @ y.reshape(-1), trace)

    def add(total, part):
        return jax.tree.map(jnp.add, total, sums(*part)), None

    zero = Normal(jnp.zeros_like(T), jnp.zeros_like(T[0]), jnp.zeros((), T.dtype))
    return jax.lax.scan(add, zero, parts)[0]


def factor(square: Float[Array, "r r"], ridge: Float[Array, ""]) -> Float[Array, "r r"]:
    """The lower Cholesky factor of FᵀF + ridge I; NaN where the ridge is below rounding."""
    diagonal = jnp.arange(len(square))
    return jnp.linalg.cholesky(square.at[diagonal, diagonal].add(ridge))


@eqx.filter_jit
def _fit(K, X, Y, regularization, landmarks):
    S, ridge = landmarks.points, len(X) * regularization
    T = whitening(K, landmarks)
    total = normal_sums(K, S, T, X, Y)
    R = factor(total.square, ridge)

    def step(w, residual):
        """One step of refinement, from w and y − F w."""
        slope = T.T @ product(K, S, X, residual).reshape(-1) - ridge * w
        correction = jax.scipy.linalg.cho_solve((R, True), slope)
        change = product(K, X, S, (T @ correction).reshape(S.shape))
        return w + correction, residual - change

    w = jax.scipy.linalg.cho_solve((R, True), total.moment)
    A = (T @ w).reshape(S.shape)
    w, residual = step(w, Y - product(K, X, S, A))
    truncation = jnp.maximum(total.trace - jnp.trace(total.square), 0 * ridge) / ridge
    # ‖f‖² = αᵀ G_SS α = ‖w‖²
    return (T @ w).reshape(S.shape), residual, jnp.linalg.norm(w), truncation


def singular(dtype: jnp.dtype) -> str:
    """What to do when the factorisation of the low-rank system fails."""
    return (
        f"the low-rank system plus the ridge N * regularization is not positive definite to "
        f"rounding in {dtype}. Likely causes, in order: the regularization is too small: raise "
        "it; float32 where float64 is needed: jax.config.update('jax_enable_x64', True); a kernel "
        "that is not positive definite or not finite: hk.check_kernel(k, X) tells."
    )
