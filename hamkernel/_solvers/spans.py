"""Spans of r functions in which a fit of low rank looks for the field, and how they follow K.

A span of landmarks has the columns K(·, s), made orthonormal in the RKHS; one of random features
stands for a kernel of its own. A basis makes the span of every kernel: `tune` moves the kernel, and
the landmarks, or the random key, stay.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel._features.structured import AbstractFeatures, features
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.features import FeatureField, feature_field
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.observed import between, trace_of_rows
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.landmark_gram import truncated, whitening
from hamkernel._solvers.landmarks import Landmarks, given_landmarks
from hamkernel._solvers.prior import Prior, drawn, prior_draws
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
        """The functions with these weights, and what they leave of the prior, as a batch."""

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
        Z, A, S, b = landmarks.representer(self.T @ w)
        info = SolverInfo(
            "Nystrom",
            landmarks=landmarks.count,
            rank=landmarks.kept.sum(),
            truncation=truncation,
        )
        return KernelField(
            kernel=self.kernel,
            points=Z,
            coefficients=A,
            residual=residual,
            norm=root(w @ w),
            regularization=ridge / N,
            offset=jnp.zeros((), A.dtype),
            info=info,
            value_points=S if len(S) else None,
            value_coefficients=b if len(S) else None,
        )

    def draws(self, weights, rows, key, region) -> KernelField:
        everywhere = jnp.concatenate([self.landmarks.rows.points, rows.points])
        prior = prior_draws(self.kernel, everywhere, region, key, len(weights))
        return _on_landmarks(self, weights, prior)


@eqx.filter_jit
def _on_landmarks(span: LandmarkSpan, weights, prior: Prior) -> KernelField:
    landmarks = span.landmarks
    # A draw of the prior less what it is in the span.
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
            return drawn(self.kernel, self.features, w, self.dimension)

        return jax.vmap(one)(weights)


def landmark_span(K: AbstractMatrixKernel, landmarks: Landmarks) -> LandmarkSpan:
    """The span of the kept columns of landmarks."""
    return LandmarkSpan(K, landmarks, whitening(K, landmarks))


class AbstractBasis(eqx.Module):
    """A span for every kernel."""

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
