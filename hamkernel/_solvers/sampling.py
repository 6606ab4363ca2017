"""Whole fields drawn from the prior, with which draws from a posterior begin.

By Matheron's rule a draw f₀ of the prior and a draw ε of the noise would have given the rows
L f₀ + ε, and a fit to the difference from the data corrects it:

    f = f₀ + Σ K(·, x_j) a_j,     a = A⁻¹ (y − L f₀ − ε),

so every draw is one function with one Hamiltonian, whose orbits keep their own energy.

f₀ lives on landmarks s of a region: α = T w with w ~ N(0, I) and G_SS⁻¹ = T Tᵀ. It has the
covariance of the part of f that the landmarks tell. Of random Fourier features alone the error of
Cov(H) was .33 for 512 of them, of 100 landmarks it was 6e-8. Outside of the region landmarks tell
little. The rest, g(x) − K(x, S) G_SS⁻¹ g(S), is drawn in features g where the kernel has a spectrum
in frequencies of its own for every draw, so that the covariance over draws has no error of theirs.

Source: Wilson, Borovitskiy, Terenin, Mostowsky & Deisenroth (2020), arXiv 2002.09309.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel._features import AbstractFeatures, features
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.expansions import FeatureField, KernelField, feature_field
from hamkernel._gram.dense import between, block_traces, components
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.landmarks import Landmarks, choose_landmarks, whitening
from hamkernel._structures.base import AbstractMatrixKernel


class Prior(eqx.Module):
    """Draws f₀: coefficients at points that all share, and weights of features or None."""

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
        at = components(self.kernel, self.points)
        across = jnp.concatenate([between(self.kernel, each, at) for each in rows.blocks])
        own = across @ self.coefficients.reshape(len(self.coefficients), -1).T
        if self.features is None:
            return own

        def of_features(basis, w):
            field = jax.vmap(lambda x: basis.field(x, w))
            return rows.of(field, jax.vmap(lambda x: basis.potential(x, w)))

        return own + jax.vmap(of_features, out_axes=1)(self.features, self.weights)

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

        def one(A, b, own, basis, w) -> KernelField:
            return KernelField(
                kernel=K,
                points=points,
                coefficients=jnp.concatenate([A, own]),
                residual=unknown,
                norm=jnp.full_like(zero, jnp.inf),  # a draw of a Gaussian field has no finite norm
                regularization=zero,
                offset=zero,
                info=info,
                value_points=S,
                value_coefficients=b,
                mean=None if basis is None else feature_draw(K, basis, w, Z.shape[1]),
            )

        return jax.vmap(one)(A, b, self.coefficients, self.features, self.weights)


def feature_draw(
    K: AbstractMatrixKernel, basis: AbstractFeatures, w: Float[Array, " r"], n: int
) -> FeatureField:
    """The field of one draw of features, at points of n coordinates."""
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
    """Draws from GP(0, K) that are right in the region and at the points X.

    A draw with inputs is affine in u, and right for every u if it is for those of the region.
    """
    of_region, of_landmarks, of_draws = jax.random.split(key, 3)
    low, high = region
    share = jax.random.uniform(of_region, (2048, len(low)), X.dtype)
    X = jnp.concatenate([X, low[None] + (high - low)[None] * share])
    # Until they leave 1e-6 of tr K(x, x) over the region, or 192 are chosen: 100 in the plane for a
    # region of a few lengthscales; the features do the rest.
    left = 1e-6 * jnp.mean(block_traces(K, X))
    landmarks = choose_landmarks(K, X, left, 192, len(X), of_landmarks)
    return _drawn(K, landmarks, of_draws, count)


@eqx.filter_jit
def _drawn(K, landmarks: Landmarks, key, count: int) -> Prior:
    S, T = landmarks.points, whitening(K, landmarks)
    m, d = S.shape
    n = K.outputs(d)
    on_landmarks, of_frequencies, of_weights = jax.random.split(key, 3)
    w = jax.random.normal(on_landmarks, (count, m * n), S.dtype)

    def basis(key):
        return features(K, d, 256, key, S.dtype)

    try:
        columns = eqx.filter_eval_shape(basis, key).columns
    except TypeError:  # no spectral density is known
        return Prior(K, S, (w @ T.T).reshape(count, m, n), None, None)
    waves = jax.vmap(basis)(jax.random.split(of_frequencies, count))
    weights = jax.random.normal(of_weights, (count, columns), S.dtype)

    def at_landmarks(draw):
        basis, weights = draw
        return jax.vmap(lambda x: basis.field(x, weights))(S).reshape(-1)

    # Four draws at once: 400 together took 1.5 GB and half as long again.
    g = jax.lax.map(at_landmarks, (waves, weights), batch_size=4)  # (count, m n)
    return Prior(K, S, ((w - g @ T) @ T.T).reshape(count, m, n), waves, weights)
