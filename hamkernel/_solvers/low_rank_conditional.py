"""The field given observations in a space of r functions: landmarks' columns, or random features.

The prior there is f(x) = Φ(x) w, w ~ N(0, I). With F the rows of the data and RᵀR = FᵀF + σ²I, the
weights are N(R⁻¹R⁻ᵀFᵀy, σ² R⁻¹R⁻ᵀ), so that a covariance given the data is σ² Φ₁ R⁻¹R⁻ᵀ Φ₂ᵀ. What
landmarks do not span, K − ΦΦᵀ, is not told by the data and stays as it was before, so that far from
them nothing is claimed to be known. R comes from a QR of F below σI, not from FᵀF; new rows go on
with it.

Source: Quiñonero-Candela & Rasmussen (2005), section 5, the deterministic training conditional.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._features.structured import AbstractFeatures
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.features import FeatureField
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.observed import between, components
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.rows import Rows
from hamkernel._solvers.conditional import AbstractConditional, check_potential
from hamkernel._solvers.landmark_gram import singular, whitening
from hamkernel._solvers.landmarks import Landmarks
from hamkernel._solvers.prior import Prior, of_features, prior_draws
from hamkernel._structures.base import AbstractMatrixKernel


class AbstractSpan(eqx.Module):
    """r functions with Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z)."""

    kernel: eqx.AbstractVar[AbstractMatrixKernel]

    @abc.abstractmethod
    def of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        """The rows of a block of each function."""

    @abc.abstractmethod
    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """What they leave of the prior covariance of the rows of two blocks."""

    @abc.abstractmethod
    def field(self, w: Float[Array, " r"], residual: Array, ridge: Array, N: int) -> AbstractField:
        """The function with these weights."""

    @abc.abstractmethod
    def draws(
        self,
        weights: Float[Array, "count r"],
        rows: Rows,
        key: Key[Array, ""],
        region: Float[Array, "2 n"],
    ) -> AbstractField:
        """The functions with these weights, and what they leave of the prior, as a batch."""

    def of_rows(self, rows: Rows) -> Float[Array, "D r"]:
        """The rows of observations of each function."""
        return rows.contrast(jnp.concatenate([self.of(block) for block in rows.blocks]))


class LandmarkSpan(AbstractSpan):
    """The columns K(·, s) of landmarks, times T, which makes them orthonormal."""

    kernel: AbstractMatrixKernel
    landmarks: Landmarks
    T: Float[Array, "r r"]

    def of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        return between(self.kernel, block, components(self.kernel, self.landmarks.points)) @ self.T

    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        return between(self.kernel, left, right) - self.of(left) @ self.of(right).T

    def field(self, w, residual, ridge, N) -> KernelField:
        S = self.landmarks.points
        info = SolverInfo("Nystrom", landmarks=self.landmarks.count, rank=self.landmarks.kept.sum())
        return KernelField(
            kernel=self.kernel,
            points=S,
            coefficients=(self.T @ w).reshape(len(S), -1),
            residual=residual,
            norm=root(w @ w),
            regularization=ridge / N,
            offset=jnp.zeros((), S.dtype),
            info=info,
        )

    def draws(self, weights, rows, key, region) -> KernelField:
        count, S = len(weights), self.landmarks.points
        everywhere = jnp.concatenate([S, rows.points])
        prior = prior_draws(self.kernel, everywhere, region, key, count)
        return _on_landmarks(self, weights, prior)


@eqx.filter_jit
def _on_landmarks(span: LandmarkSpan, weights, prior: Prior) -> KernelField:
    S, T = span.landmarks.points, span.T
    # A draw of the prior less what it is in the span.
    here = Rows((components(span.kernel, S),), jnp.zeros(len(T), S.dtype))
    n, d = here.dimension, S.shape[1]
    less = weights - prior.rows(here).T @ T

    def one(w, coefficients, basis, of_basis):
        return KernelField(
            kernel=span.kernel,
            points=jnp.concatenate([S, prior.points]),
            coefficients=jnp.concatenate([(T @ w).reshape(len(S), n), coefficients]),
            residual=jnp.zeros((0, n), w.dtype),
            norm=jnp.full((), jnp.inf, w.dtype),
            regularization=jnp.zeros((), w.dtype),
            offset=jnp.zeros((), w.dtype),
            info=SolverInfo("draw"),
            mean=None if basis is None else of_features(span.kernel, basis, of_basis, d),
        )

    return jax.vmap(one)(less, prior.coefficients, prior.features, prior.weights)


class FeatureSpan(AbstractSpan):
    """Random Fourier features, which stand for a kernel of their own."""

    kernel: AbstractMatrixKernel
    features: AbstractFeatures
    dimension: int = eqx.field(static=True)

    def of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        if not block.of_values:
            return block.rows(self.features(block.points))
        none = jnp.zeros(self.features.columns, block.points.dtype)
        values = jax.vmap(lambda x: jax.grad(lambda w: self.features.potential(x, w))(none))
        return block.rows(values(block.points))

    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        return jnp.zeros((len(left.scale), len(right.scale)), left.points.dtype)

    def field(self, w, residual, ridge, N) -> FeatureField:
        left = jnp.linalg.norm(residual)
        unknown = jnp.zeros((0, self.dimension), w.dtype)
        return FeatureField(
            kernel=self.kernel,
            features=self.features,
            weights=w,
            residual=residual if residual.ndim == 2 else unknown,
            norm=root(w @ w),
            regularization=ridge / N,
            offset=jnp.zeros((), w.dtype),
            info=SolverInfo("RandomFeatures", rank=jnp.asarray(len(w)), residual_norm=left),
        )

    def draws(self, weights, rows, key, region) -> FeatureField:
        def one(w):
            return of_features(self.kernel, self.features, w, self.dimension)

        return jax.vmap(one)(weights)


class LowRankConditional(AbstractConditional):
    """By R with RᵀR = FᵀF + σ²I; the weights are w = R⁻¹ `rotated`."""

    field: AbstractField
    rows: Rows
    ridge: Float[Array, ""]
    span: AbstractSpan
    R: Float[Array, "r r"]
    rotated: Float[Array, " r"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        own = self._told(left)
        other = own if right is left else self._told(right)
        return self.span.missing(left, right) + self.ridge * own.T @ other

    def _told(self, block: AbstractBlock) -> Float[Array, "r d"]:
        return solve_triangular(self.R, self.span.of(block).T, trans="T")

    def updated(self, new: Rows) -> "LowRankConditional":
        rows = self.rows.joined(new)
        beside, fresh = self.rows.beside(new), rows.size - self.rows.size
        own = self.span.of_rows(beside)[-fresh:], rows.y[-fresh:]
        R, rotated = _below(self.R, self.rotated, *own)
        return _conditional(self.span, rows, self.ridge, R, rotated)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        of_weights, rest = jax.random.split(key)
        z = jax.random.normal(of_weights, (len(self.R), count), self.R.dtype)
        w = solve_triangular(self.R, self.rotated[:, None] + jnp.sqrt(self.ridge) * z)
        return self.span.draws(w.T, self.rows, rest, region)


def low_rank_conditional(
    span: AbstractSpan, rows: Rows, regularization: Float[Array, ""], throw: bool = True
) -> LowRankConditional:
    """The field given the rows in the span of some functions: O(D r²) time, O(D r) memory.

    Raises:
        RuntimeError: the least squares have no solution to rounding. AttributeError: energies of a
            structure without potential.
    """
    check_potential(span.kernel, rows)
    conditional = _least_squares(span, rows, rows.count * regularization)
    field = conditional.field
    cause = singular(field.offset.dtype)
    arrays, rest = eqx.partition(field, eqx.is_inexact_array)
    failed = require.not_finite(field.norm)
    arrays = require.value(arrays, failed, cause, RuntimeError, throw)
    return eqx.tree_at(lambda c: c.field, conditional, eqx.combine(arrays, rest))


@eqx.filter_jit
def _least_squares(span, rows, ridge):
    F, y = span.of_rows(rows), rows.y
    start = jnp.sqrt(ridge) * jnp.eye(F.shape[1], dtype=F.dtype)
    return _conditional(span, rows, ridge, *_below(start, jnp.zeros_like(F[0]), F, y))


def _below(R, rotated, F, y):
    """The triangular factor of [R; F], and the right-hand side beside it."""
    both = jnp.concatenate(
        [jnp.column_stack([R, rotated]), jnp.column_stack([F, y])],
    )
    Q = jnp.linalg.qr(both, mode="r")
    return Q[: len(R), :-1], Q[: len(R), -1]


def _conditional(span, rows, ridge, R, rotated):
    w = solve_triangular(R, rotated)
    left = rows.y - span.of_rows(rows) @ w
    field = span.field(w, rows.residual(left), ridge, rows.count)
    return LowRankConditional(field, rows, ridge, span, R, rotated)


def landmark_span(K: AbstractMatrixKernel, landmarks: Landmarks) -> LandmarkSpan:
    """The span of the kept columns of landmarks."""
    return LandmarkSpan(K, landmarks, whitening(K, landmarks))
