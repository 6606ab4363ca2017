"""Fits in a span of r functions: the columns of landmarks, or random features.

A span of landmarks has the columns K(·, s), made orthonormal in the RKHS; one of random features
stands for a kernel of its own. A basis makes the span of every kernel: `tune` moves the kernel, and
the landmarks, or the random key, stay.

The prior in a span is f(x) = Φ(x) w, w ~ N(0, I). With F the rows of the data and
RᵀR = FᵀF + σ²I, the weights are N(R⁻¹R⁻ᵀFᵀy, σ² R⁻¹R⁻ᵀ), so that a covariance given the data is
σ² Φ₁ R⁻¹R⁻ᵀ Φ₂ᵀ. The part K − ΦΦᵀ of the prior that landmarks do not span is not told by the data
and stays as it was before, so that far from them nothing is claimed to be known. R comes from a QR
of F below σI, not from FᵀF; new rows go on with it.

Source: Quiñonero-Candela & Rasmussen (2005), section 5, the deterministic training conditional.
"""

import abc
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Bool, Float, Key

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.expansions import FeatureField, KernelField, feature_field, kernel_field
from hamkernel._gram.dense import between, components, plus_ridge, trace_of_rows
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.landmarks import Landmarks, given_landmarks, whitening
from hamkernel._solvers.problem import AbstractConditional
from hamkernel._solvers.sampling import Prior, feature_draw, prior_draws
from hamkernel._structures.base import AbstractMatrixKernel

Arrays = TypeVar("Arrays")


class Columns(eqx.Module):
    """The columns of the Gram that belong to landmarks, at some points: (t, d) -> (t, n, r)."""

    kernel: AbstractMatrixKernel
    landmarks: Landmarks

    def __call__(self, X: Float[Array, "t d"]) -> Float[Array, "t n r"]:
        columns = self.landmarks.columns(self.kernel, components(self.kernel, X))
        return columns.reshape(len(X), -1, columns.shape[1])


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
    learned: Arrays,
    landmarks: Landmarks,
    truncation: Float[Array, ""] | None,
    failed: Bool[ArrayLike, ""],
    message: str | Callable[[], str],
    throw: bool,
) -> Arrays:
    """The arrays `learned` with landmarks; a RuntimeError with `message` where the solve `failed`.

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
    """The error text of a failed factorisation of the low-rank system."""
    return (
        f"the low-rank system plus the ridge N * regularization is not positive definite to "
        f"rounding in {dtype}. Likely causes, in order: the regularization is too small: raise "
        "it; float32 where float64 is needed: jax.config.update('jax_enable_x64', True); a kernel "
        "that is not positive definite or not finite: hk.check_kernel(k, X) finds out."
    )


class AbstractSpan(eqx.Module):
    """r functions with Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z)."""

    kernel: eqx.AbstractVar[AbstractMatrixKernel]

    @abc.abstractmethod
    def of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        """The rows of a block of each function."""

    @abc.abstractmethod
    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """The prior covariance of the rows of two blocks less Φ₁ Φ₂ᵀ of the r functions."""

    @abc.abstractmethod
    def truncation(
        self, rows: Measurements, F: Float[Array, "M r"], ridge: Float[Array, ""]
    ) -> Float[Array, ""] | None:
        """trace(G − FFᵀ)/ridge of the M rows of observations; None of a kernel of its own."""

    @abc.abstractmethod
    def field(
        self,
        w: Float[Array, " r"],
        residual: Array,
        ridge: Array,
        N: int,
        truncation: Float[Array, ""] | None,
    ) -> AbstractField:
        """The function with these weights."""

    @abc.abstractmethod
    def draws(
        self,
        weights: Float[Array, "count r"],
        rows: Measurements,
        key: Key[Array, ""],
        region: Float[Array, "2 n"],
    ) -> AbstractField:
        """The functions with these weights plus draws of the rest of the prior, as a batch."""

    def of_rows(self, rows: Measurements) -> Float[Array, "M r"]:
        """The rows of observations of each function, before the contrast of the energies."""
        return jnp.concatenate([self.of(block) for block in rows.blocks])


class LandmarkSpan(AbstractSpan):
    """The columns K(·, s) of landmarks, times T, which makes them orthonormal."""

    kernel: AbstractMatrixKernel
    landmarks: Landmarks
    T: Float[Array, "r r"]

    def of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        return self.landmarks.columns(self.kernel, block) @ self.T

    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        return between(self.kernel, left, right) - self.of(left) @ self.of(right).T

    def truncation(self, rows, F, ridge) -> Float[Array, ""]:
        return truncated(trace_of_rows(self.kernel, rows), jnp.sum(F**2), ridge)

    def field(self, w, residual, ridge, N, truncation) -> KernelField:
        landmarks = self.landmarks
        info = SolverInfo(
            "Nystrom",
            landmarks=landmarks.count,
            rank=landmarks.kept.sum(),
            truncation=truncation,
        )
        representer = landmarks.representer(self.T @ w)
        return kernel_field(self.kernel, representer, residual, root(w @ w), ridge / N, info)

    def draws(self, weights, rows, key, region) -> KernelField:
        everywhere = jnp.concatenate([self.landmarks.rows.points, rows.points])
        prior = prior_draws(self.kernel, everywhere, region, key, len(weights))
        return _on_landmarks(self, weights, prior)


@eqx.filter_jit
def _on_landmarks(span: LandmarkSpan, weights, prior: Prior) -> KernelField:
    landmarks = span.landmarks
    # A draw of the prior less its projection on the span.
    drawn = prior.raw_rows(landmarks.rows)
    drawn = drawn if landmarks.index is None else drawn[landmarks.index]
    c = (weights - drawn.T @ span.T) @ span.T.T
    Z, A, S, b = jax.vmap(landmarks.representer, out_axes=(None, 0, None, 0))(c)
    return prior.plus(Z, A, S, b) if len(S) else prior.plus(Z, A)


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
        return jnp.zeros((left.size, right.size), left.points.dtype)

    def truncation(self, rows, F, ridge) -> None:
        return None

    def field(self, w, residual, ridge, N, truncation) -> FeatureField:
        left = jnp.linalg.norm(residual)
        info = SolverInfo("RandomFeatures", rank=jnp.asarray(len(w)), residual_norm=left)
        known = residual if residual.ndim == 2 else jnp.zeros((0, self.dimension), w.dtype)
        return feature_field(self.kernel, self.features, w, known, ridge / N, info)

    def draws(self, weights, rows, key, region) -> FeatureField:
        def one(w):
            return feature_draw(self.kernel, self.features, w, self.dimension)

        return jax.vmap(one)(weights)


def landmark_span(K: AbstractMatrixKernel, landmarks: Landmarks) -> LandmarkSpan:
    """The span of the kept columns of landmarks."""
    return LandmarkSpan(K, landmarks, whitening(K, landmarks))


class AbstractBasis(eqx.Module):
    """A rule that gives every kernel its span."""

    @abc.abstractmethod
    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> AbstractSpan:
        """The span of K at points of n coordinates."""


class WaveBasis(AbstractBasis):
    """Random Fourier features of one key: the frequencies scale with the kernel."""

    key: Key[Array, ""]
    count: int = eqx.field(static=True)

    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> FeatureSpan:
        return FeatureSpan(K, features(K, n, self.count, self.key, dtype), n)


class LandmarkBasis(AbstractBasis):
    """The kernel's columns of fixed landmarks."""

    landmarks: Landmarks

    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> LandmarkSpan:
        del n, dtype
        own = landmark_span(K, given_landmarks(K, self.landmarks))
        # Without a column a fit fails; the losses would be those of the zero field.
        T = jnp.where(own.landmarks.count == 0, jnp.nan, own.T)
        return eqx.tree_at(lambda span: span.T, own, T)


class LowRankConditional(AbstractConditional):
    """The Gaussian field by R with RᵀR = FᵀF + σ²I; the weights are w = R⁻¹ `rotated`."""

    field: AbstractField
    rows: Measurements
    ridge: Float[Array, ""]
    span: AbstractSpan
    R: Float[Array, "r r"]
    rotated: Float[Array, " r"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        own = self._whitened_covariance(left)
        other = own if right is left else self._whitened_covariance(right)
        return self.span.missing(left, right) + self.ridge * own.T @ other

    def _whitened_covariance(self, block: AbstractBlock) -> Float[Array, "r d"]:
        return solve_triangular(self.R, self.span.of(block).T, trans="T")

    def updated(self, new: Measurements) -> "LowRankConditional":
        rows = self.rows.joined(new)
        beside, fresh = self.rows.with_previous(new), rows.size - self.rows.size
        new_rows = beside.contrast(self.span.of_rows(beside))[-fresh:]
        R, rotated = _below(self.R, self.rotated, new_rows, rows.y[-fresh:])
        return _conditional(self.span, rows, self.ridge, R, rotated)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        of_weights, rest = jax.random.split(key)
        z = jax.random.normal(of_weights, (len(self.R), count), self.R.dtype)
        w = solve_triangular(self.R, self.rotated[:, None] + jnp.sqrt(self.ridge) * z)
        return self.span.draws(w.T, self.rows, rest, region)


def low_rank_conditional(
    span: AbstractSpan, rows: Measurements, regularization: Float[Array, ""], throw: bool = True
) -> LowRankConditional:
    """The field given the rows in the span of some functions: O(D r²) time, O(D r) memory.

    Raises:
        RuntimeError: the least squares have no solution to rounding.
    """
    conditional = _least_squares(span, rows, rows.count * regularization)
    field = conditional.field
    cause = singular(field.offset.dtype)
    arrays, rest = eqx.partition(field, eqx.is_inexact_array)
    failed = require.not_finite(field.norm)
    if isinstance(span, LandmarkSpan):
        truncation = field.info.truncation
        arrays = checked(arrays, span.landmarks, truncation, failed, cause, throw)
    else:
        arrays = require.value(arrays, failed, cause, RuntimeError, throw)
    return eqx.tree_at(lambda c: c.field, conditional, eqx.combine(arrays, rest))


@eqx.filter_jit
def _least_squares(span, rows, ridge):
    F = rows.contrast(span.of_rows(rows))
    start = jnp.sqrt(ridge) * jnp.eye(F.shape[1], dtype=F.dtype)
    return _conditional(span, rows, ridge, *_below(start, jnp.zeros_like(F[0]), F, rows.y))


def _below(R, rotated, F, y):
    """The triangular factor of [R; F], and the right-hand side beside it."""
    both = jnp.concatenate(
        [jnp.column_stack([R, rotated]), jnp.column_stack([F, y])],
    )
    Q = jnp.linalg.qr(both, mode="r")
    return Q[: len(R), :-1], Q[: len(R), -1]


def _conditional(span, rows, ridge, R, rotated):
    w, F = solve_triangular(R, rotated), span.of_rows(rows)
    left = rows.y - rows.contrast(F @ w)
    truncation = span.truncation(rows, F, ridge)
    field = span.field(w, rows.residual(left), ridge, rows.count, truncation)
    return LowRankConditional(field, rows, ridge, span, R, rotated)
