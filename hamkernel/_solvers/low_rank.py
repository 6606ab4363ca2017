"""Fits in a span of r functions, the columns of landmarks or random features; draws of the prior.

The span of landmarks consists of the columns K(·, s), orthonormalised in the RKHS. The span of
random features defines a kernel of its own. A basis is a rule that makes the span of any kernel:
while `tune` changes the kernel, the landmarks or the random key stay the same.

The prior in a span is f(x) = Φ(x) w, w ~ N(0, I). With F the rows of the data and
RᵀR = FᵀF + σ²I, the weights are N(R⁻¹R⁻ᵀFᵀy, σ² R⁻¹R⁻ᵀ), so that a covariance given the data is
σ² Φ₁ R⁻¹R⁻ᵀ Φ₂ᵀ. The remainder K − ΦΦᵀ of the prior lies outside the span of the landmarks, and the
data do not reduce it. It is added to the posterior covariance, which therefore returns to the prior
covariance far from the landmarks. R comes from a QR of σI above F, not from FᵀF, and new rows
update R by another QR.

**Draws of the posterior** start from draws of the prior (Matheron's rule). A draw f₀ of the prior
and a draw ε of the noise predict the rows L f₀ + ε. A fit to the difference from the data corrects
the draw:

    f = f₀ + Σ K(·, x_j) a_j,     a = A⁻¹ (y − L f₀ − ε),

so every draw is one function with one Hamiltonian, whose orbits keep their own energy.

f₀ = K(·, S) T w + g − K(·, S) G_SS⁻¹ g(S) with w ~ N(0, I), G_SS⁻¹ = T Tᵀ, and landmarks S of a
region. The first term has the covariance of the part of f that its values at the landmarks
determine. The error of Cov(H) was 6e-8 with 100 landmarks, and .33 with 512 random Fourier features
alone. Outside the region the landmarks determine little; the other two terms add the rest, with
random features g if the kernel has a spectrum. The frequencies differ between draws, so the
features add no error to the covariance over draws.

Source: Quiñonero-Candela & Rasmussen (2005), section 5, the deterministic training conditional;
Wilson, Borovitskiy, Terenin, Mostowsky & Deisenroth (2020), arXiv 2002.09309.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Bool, Float, Key

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.expansions import FeatureField, KernelField, feature_field, kernel_field
from hamkernel._gram import between, block_traces, components, plus_ridge, trace_of_rows
from hamkernel._machine import RowSharding, precise_jit
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.landmarks import Landmarks, choose_landmarks, given_landmarks, whitening
from hamkernel._solvers.least_squares import Normal, normal
from hamkernel._solvers.problem import AbstractConditional, Field, check_field
from hamkernel._solvers.triangle import append_rows, no_rows
from hamkernel._structures.base import AbstractMatrixKernel


class Prior(eqx.Module):
    """Draws f₀ of the prior: coefficients at common points, and weights of features or None."""

    kernel: AbstractMatrixKernel
    points: Float[Array, "m d"]
    coefficients: Float[Array, "count m n"]
    features: AbstractFeatures | None
    weights: Float[Array, "count r"] | None

    def rows(self, rows: Measurements) -> Float[Array, "D count"]:
        """The rows of all draws."""
        return rows.contrast(self.raw_rows(rows))

    def raw_rows(self, rows: Measurements) -> Float[Array, "M count"]:
        """The rows of all draws before the contrast of the energies."""
        landmark_block = components(self.kernel, self.points)
        across = jnp.concatenate(
            [between(self.kernel, block, landmark_block) for block in rows.blocks]
        )
        landmark_rows = across @ self.coefficients.reshape(len(self.coefficients), -1).T
        if self.features is None:
            return landmark_rows

        def rows_of_features(basis, w):
            field = jax.vmap(lambda x: basis.field(x, w))
            return rows.evaluate(field, jax.vmap(lambda x: basis.potential(x, w)))

        return landmark_rows + jax.vmap(rows_of_features, out_axes=1)(self.features, self.weights)

    def plus(
        self,
        Z: Float[Array, "P d"],
        A: Float[Array, "count P n"],
        S: Float[Array, "E d"] | None = None,
        b: Float[Array, "count E"] | None = None,
    ) -> KernelField:
        """The fields f₀ + Σ K(·, z) a + Σ b k(·, s), with coefficients of each draw."""
        K, points = self.kernel, jnp.concatenate([Z, self.points])
        zero, unknown = jnp.zeros((), A.dtype), jnp.zeros((0, A.shape[-1]), A.dtype)
        info = SolverInfo("draw")

        def one(A, b, landmark_coefficients, basis, w) -> KernelField:
            return KernelField(
                kernel=K,
                points=points,
                coefficients=jnp.concatenate([A, landmark_coefficients]),
                residual=unknown,
                norm=jnp.full_like(zero, jnp.inf),  # a draw of a Gaussian field has no finite norm
                regularization=zero,
                offset=zero,
                info=info,
                value_points=S,
                value_coefficients=b,
                mean=None if basis is None else feature_draw(K, basis, w, A.shape[-1]),
            )

        return jax.vmap(one)(A, b, self.coefficients, self.features, self.weights)


def feature_draw(
    K: AbstractMatrixKernel, basis: AbstractFeatures, w: Float[Array, " r"], n: int
) -> FeatureField:
    """The field of one draw of features, with n components."""
    zero, unknown = jnp.zeros((), w.dtype), jnp.zeros((0, n), w.dtype)
    field = feature_field(K, basis, w, unknown, zero, SolverInfo("draw"))
    return dataclasses.replace(field, norm=jnp.full_like(zero, jnp.inf))


def prior_draws(
    K: AbstractMatrixKernel,
    X: Float[Array, "P d"],
    region: Float[Array, "2 d"],
    key: Key[Array, ""],
    count: int,
) -> Prior:
    """Draws from GP(0, K) whose covariance is accurate in the region and at the points X.

    A draw with inputs is affine in u, so it is accurate for every u if it is for the u of the
    region.
    """
    region_key, landmark_key, draw_key = jax.random.split(key, 3)
    low, high = region
    share = jax.random.uniform(region_key, (2048, len(low)), X.dtype)
    X = jnp.concatenate([X, low[None] + (high - low)[None] * share])
    # Landmarks are chosen until the residual trace is 1e-6 of tr K(x, x) on average over the
    # region, or there are 192. In the plane 100 suffice for a region of a few lengthscales.
    target_trace = 1e-6 * jnp.mean(block_traces(K, X))
    landmarks = choose_landmarks(K, X, target_trace, 192, len(X), landmark_key)
    return _draw_prior(K, landmarks, draw_key, count)


@precise_jit
def _draw_prior(K, landmarks: Landmarks, key, count: int) -> Prior:
    S, T = landmarks.points, whitening(K, landmarks)
    m, d = S.shape
    n = K.outputs(d)
    landmark_key, frequency_key, weight_key = jax.random.split(key, 3)
    w = jax.random.normal(landmark_key, (count, m * n), S.dtype)

    def basis(key):
        return features(K, d, 256, key, S.dtype)

    try:
        columns = eqx.filter_eval_shape(basis, key).columns
    except TypeError:  # no spectral density is known
        return Prior(K, S, (w @ T.T).reshape(count, m, n), None, None)
    waves = jax.vmap(basis)(jax.random.split(frequency_key, count))
    weights = jax.random.normal(weight_key, (count, columns), S.dtype)

    def values_at_landmarks(draw):
        basis, weights = draw
        return jax.vmap(lambda x: basis.field(x, weights))(S).reshape(-1)

    # Four draws at a time: all 400 together took 1.5 GB and 1.5 times as long.
    g = jax.lax.map(values_at_landmarks, (waves, weights), batch_size=4)  # (count, m n)
    # f₀ = K(·, S)Tw + g − K(·, S)TTᵀg(S), so the coefficients at S are α = T(w − Tᵀg(S)).
    return Prior(K, S, ((w - g @ T) @ T.T).reshape(count, m, n), waves, weights)


def factor(square: Float[Array, "r r"], ridge: Float[Array, ""]) -> Float[Array, "r r"]:
    """The lower Cholesky factor of FᵀF + ridge I; NaN where the ridge is below rounding."""
    return jnp.linalg.cholesky(plus_ridge(square, ridge))


def truncation_of(
    trace: Float[Array, ""], covered: Float[Array, ""], ridge: Float[Array, ""]
) -> Float[Array, ""]:
    """trace(G − Ĝ)/ridge from trace G and trace Ĝ; NaN if Ĝ is larger than G.

    If the kernel is positive definite, trace Ĝ exceeds trace G only by rounding, 1e-16; for kernels
    that were not, by 4 % and more.
    """
    difference = jnp.where(covered - trace > 1e-3 * jnp.abs(trace), jnp.nan, trace - covered)
    return jnp.maximum(difference, jnp.zeros_like(difference)) / ridge


def check_low_rank(
    field: Field,
    throw: bool,
    failed: Bool[ArrayLike, ""] | None = None,
    message: str | Callable[[], str] = "",
) -> Field:
    """The field; RuntimeError with `message`, or NaN without `throw`, if its solve `failed`.

    If `failed` is None, a field with a norm that is not finite failed. A fit without landmarks
    counts as failed, unless the Gram, and with it the field, is zero.
    """
    info = field.info
    if failed is None:
        failed = require.not_finite(field.norm)
        assert failed is not None
        message = (
            "the low-rank system plus the ridge N * regularization is not positive definite to "
            f"rounding in {field.norm.dtype}. Likely causes, in order: the regularization is too "
            "small: raise it; float32 where float64 is needed: jax.config.update("
            "'jax_enable_x64', True); a kernel that is not positive definite or not finite: "
            "hk.check_kernel(k, X) finds out."
        )
    if info.truncation is None or info.landmarks is None:
        return check_field(field, failed, message, throw)
    truncation, none = require.host_array(info.truncation), require.host_array(info.landmarks) == 0
    field = check_field(field, failed | (none & (truncation != 0)), message, throw)
    indefinite = (
        "the low-rank Gram of the landmarks is larger than the Gram itself, so the kernel is not "
        "positive definite: hk.check_kernel(k, X) finds out."
    )
    return check_field(field, require.not_finite(info.truncation), indefinite, throw)


class AbstractFunctions(eqx.Module):
    """Functions φ_1 … φ_r and the rows of observations of them."""

    kernel: AbstractMatrixKernel

    @abc.abstractmethod
    def rows_of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        """The rows of a block, for each of the r functions."""

    def __call__(self, X: Float[Array, "t d"]) -> Float[Array, "t n r"]:
        """The values at points, a design of `least_squares.py`."""
        rows = self.rows_of(components(self.kernel, X))
        return rows.reshape(len(X), -1, rows.shape[1])

    def all_rows(self, rows: Measurements) -> Float[Array, "M r"]:
        """The rows of all observations for each function, before the contrast of the energies."""
        return jnp.concatenate([self.rows_of(block) for block in rows.blocks])

    def normal_equations(
        self, rows: Measurements, basis: Float[Array, "r r"], spread: RowSharding | None = None
    ) -> Normal:
        """The normal equations of the rows times `basis`; velocities are seen tile by tile."""
        if rows.states is not None:
            return normal(self, basis, *rows.states, spread)
        return Normal.from_rows(self.all_rows(rows) @ basis, rows.targets)


class Columns(AbstractFunctions):
    """The columns K(·, s) of landmarks."""

    landmarks: Landmarks

    def rows_of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        return self.landmarks.columns(self.kernel, block)


class AbstractSpan(AbstractFunctions):
    """Functions φ_1 … φ_r with Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z)."""

    @abc.abstractmethod
    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """The prior covariance of the rows of two blocks minus Φ₁Φ₂ᵀ."""

    @abc.abstractmethod
    def truncation(
        self, rows: Measurements, F: Float[Array, "M r"], ridge: Float[Array, ""]
    ) -> Float[Array, ""] | None:
        """The truncation trace(G − FFᵀ)/ridge for M rows; None if Σ φφᵀ is the kernel itself."""

    @abc.abstractmethod
    def field(
        self,
        w: Float[Array, " r"],
        residual: Array,
        regularization: Float[Array, ""],
        truncation: Float[Array, ""] | None,
    ) -> AbstractField:
        """The field Σ_r w_r φ_r."""

    @abc.abstractmethod
    def draws(
        self,
        weights: Float[Array, "count r"],
        rows: Measurements,
        key: Key[Array, ""],
        region: Float[Array, "2 n"],
    ) -> AbstractField:
        """A batch of fields: Σ_r w_r φ_r plus draws of the remainder of the prior."""


def landmark_field(
    K: AbstractMatrixKernel,
    landmarks: Landmarks,
    regularization: Float[Array, ""],
    c: Float[Array, " r"],
    residual: Float[Array, "..."],
    norm: Float[Array, ""],
    truncation: Float[Array, ""] | None,
    residual_norm: Float[Array, ""] | None = None,
) -> KernelField:
    """The field Σ c_r L_r K of the functionals L_r that are the landmarks."""
    info = SolverInfo(
        "Nystrom",
        landmarks=landmarks.count,
        rank=landmarks.kept.sum(),
        truncation=truncation,
        residual_norm=residual_norm,
    )
    return kernel_field(K, landmarks.representer(c), residual, norm, regularization, info)


class LandmarkSpan(AbstractSpan):
    """The columns K(·, s) of landmarks, orthonormalised by T with T Tᵀ = G_SS⁻¹."""

    landmarks: Landmarks
    T: Float[Array, "r r"]

    def rows_of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        return self.landmarks.columns(self.kernel, block) @ self.T

    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        return between(self.kernel, left, right) - self.rows_of(left) @ self.rows_of(right).T

    def truncation(self, rows, F, ridge) -> Float[Array, ""]:
        return truncation_of(trace_of_rows(self.kernel, rows), jnp.sum(F**2), ridge)

    def field(self, w, residual, regularization, truncation) -> KernelField:
        c, norm = self.T @ w, root(w @ w)  # ‖f‖² = αᵀ G_SS α = ‖w‖²
        return landmark_field(
            self.kernel, self.landmarks, regularization, c, residual, norm, truncation
        )

    def draws(self, weights, rows, key, region) -> KernelField:
        everywhere = jnp.concatenate([self.landmarks.rows.points, rows.points])
        prior = prior_draws(self.kernel, everywhere, region, key, len(weights))
        return _landmark_draws(self, weights, prior)


@precise_jit
def _landmark_draws(span: LandmarkSpan, weights, prior: Prior) -> KernelField:
    landmarks = span.landmarks
    # f = Φw̃ + f₀ − K(·, L)TTᵀ L f₀: weights w̃ in the span plus the draw f₀ minus its projection
    # on the span, so the coefficients of the landmarks L are T(w̃ − Tᵀ L f₀).
    prior_rows = prior.raw_rows(landmarks.rows)
    prior_rows = prior_rows if landmarks.index is None else prior_rows[landmarks.index]
    c = (weights - prior_rows.T @ span.T) @ span.T.T
    Z, A, S, b = jax.vmap(landmarks.representer, out_axes=(None, 0, None, 0))(c)
    return prior.plus(Z, A, S, b) if len(S) else prior.plus(Z, A)


class FeatureSpan(AbstractSpan):
    """Random Fourier features, whose kernel is Σ φφᵀ itself."""

    features: AbstractFeatures
    dimension: int = eqx.field(static=True)

    def rows_of(self, block: AbstractBlock) -> Float[Array, "d r"]:
        if not block.of_values:
            return block.rows(self.features(block.points))
        none = jnp.zeros(self.features.columns, block.points.dtype)
        values = jax.vmap(lambda x: jax.grad(lambda w: self.features.potential(x, w))(none))
        return block.rows(values(block.points))

    def missing(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        return jnp.zeros((left.size, right.size), left.points.dtype)

    def truncation(self, rows, F, ridge) -> None:
        return None

    def field(
        self, w, residual, regularization, truncation=None, residual_norm=None
    ) -> FeatureField:
        if residual.ndim == 1:  # of other rows than velocities, which the field does not keep
            residual_norm = jnp.linalg.norm(residual)
            residual = jnp.zeros((0, self.dimension), w.dtype)
        info = SolverInfo("RandomFeatures", rank=jnp.asarray(len(w)), residual_norm=residual_norm)
        return feature_field(self.kernel, self.features, w, residual, regularization, info)

    def draws(self, weights, rows, key, region) -> FeatureField:
        def one(w):
            return feature_draw(self.kernel, self.features, w, self.dimension)

        return jax.vmap(one)(weights)


def landmark_span(K: AbstractMatrixKernel, landmarks: Landmarks) -> LandmarkSpan:
    """The span of the kept columns of landmarks."""
    return LandmarkSpan(K, landmarks, whitening(K, landmarks))


class AbstractBasis(eqx.Module):
    """A rule that makes the span of any kernel."""

    @abc.abstractmethod
    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> AbstractSpan:
        """The span of K at points of n coordinates."""


class LandmarkBasis(AbstractBasis):
    """The kernel's columns of fixed landmarks."""

    landmarks: Landmarks

    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> LandmarkSpan:
        span = landmark_span(K, given_landmarks(K, self.landmarks))
        # Without a column the losses would silently be those of the zero field; NaN makes them
        # fail.
        T = jnp.where(span.landmarks.count == 0, jnp.nan, span.T)
        return eqx.tree_at(lambda span: span.T, span, T)


class LowRankConditional(AbstractConditional):
    """The posterior from R with RᵀR = FᵀF + σ²I; the mean weights are w = R⁻¹ `rotated`."""

    span: AbstractSpan
    R: Float[Array, "r r"]
    rotated: Float[Array, " r"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        whitened = self._whitened_covariance(left)
        whitened_right = whitened if right is left else self._whitened_covariance(right)
        return self.span.missing(left, right) + self.ridge * whitened.T @ whitened_right

    def _whitened_covariance(self, block: AbstractBlock) -> Float[Array, "r d"]:
        return solve_triangular(self.R, self.span.rows_of(block).T, trans="T")

    def law_variance(self, r: Any, r0: Any, which: int) -> Float[Array, ""]:
        """The variance of w(r) − w(r₀) of a shared law w."""
        laws = self.span.features.laws() if isinstance(self.span, FeatureSpan) else []
        if not laws:
            raise AttributeError("the posterior has no law: its kernel is no hk.Shared(k, parts).")
        waves, place = laws[which]
        r, r0 = require.floating(r, "r"), require.floating(r0, "r0")
        return _law_variance(self.R, self.ridge, waves, jnp.asarray(place.start), r, r0)

    def update(self, new: Measurements) -> "LowRankConditional":
        rows = self.rows.append(new)
        extended_rows, new_count = self.rows.with_previous(new), rows.size - self.rows.size
        new_rows = extended_rows.contrast(self.span.all_rows(extended_rows))[-new_count:]
        above = jnp.column_stack([self.R, self.rotated])
        F = append_rows(above, new_rows, rows.y[-new_count:])
        return _conditional(self.span, rows, self.ridge, F)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        weight_key, rest = jax.random.split(key)
        z = jax.random.normal(weight_key, (len(self.R), count), self.R.dtype)
        w = solve_triangular(self.R, self.rotated[:, None] + jnp.sqrt(self.ridge) * z)
        return self.span.draws(w.T, self.rows, rest, region)


@precise_jit
def _law_variance(R, ridge, waves, start, r, r0) -> Float[Array, ""]:
    features = (waves.law_values(r) - waves.law_values(r0)).astype(R.dtype)
    difference = jax.lax.dynamic_update_slice(jnp.zeros_like(R[0]), features, (start,))
    rest = waves.kernel.missing(waves.kernel.point(r), waves.kernel.point(r0)).astype(R.dtype)
    whitened = solve_triangular(R, difference, trans="T")
    return ridge * whitened @ whitened + waves.scale.astype(R.dtype) * rest


def low_rank_conditional(
    span: AbstractSpan, rows: Measurements, regularization: Float[Array, ""], throw: bool = True
) -> LowRankConditional:
    """The posterior given the rows, in a span of r functions: O(D r²) time, O(D r) memory.

    Raises:
        RuntimeError: the least squares have no solution to rounding.
    """
    conditional = _low_rank_conditional(span, rows, rows.count * regularization)
    return dataclasses.replace(conditional, field=check_low_rank(conditional.field, throw))


@precise_jit
def _low_rank_conditional(span, rows, ridge):
    F = rows.contrast(span.all_rows(rows))
    start = no_rows(F.shape[1], F.dtype, ridge)
    return _conditional(span, rows, ridge, append_rows(start, F, rows.y))


def _conditional(span, rows, ridge, triangle):
    R, rotated = triangle[:-1, :-1], triangle[:-1, -1]
    w, F = solve_triangular(R, rotated), span.all_rows(rows)
    residual = rows.y - rows.contrast(F @ w)
    truncation = span.truncation(rows, F, ridge)
    field = span.field(w, rows.residual(residual), ridge / rows.count, truncation)
    return LowRankConditional(field, rows, ridge, span, R, rotated)
