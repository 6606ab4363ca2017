"""The features of a low-rank fit as functions of the hyperparameters, which `tune` moves."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel._features.structured import features
from hamkernel._gram.dense import assemble
from hamkernel._gram.derivatives import constant
from hamkernel._solvers.landmark_gram import Columns, whitening
from hamkernel._solvers.landmarks import given_landmarks
from hamkernel._structures.base import AbstractMatrixKernel

Features = Callable[[Float[Array, "t n"]], Float[Array, "t n r"]]


class AbstractBasis(eqx.Module):
    """Features that follow the hyperparameters of a kernel, Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z)."""

    @abc.abstractmethod
    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        """The features of K, at points such as X."""


class WaveBasis(AbstractBasis):
    """Random Fourier features of one key: the frequencies scale with the kernel."""

    key: Key[Array, ""]
    count: int = eqx.field(static=True)

    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        return features(K, X.shape[1], self.count, self.key, X.dtype)


class LandmarkBasis(AbstractBasis):
    """The kernel's columns at fixed points, made orthonormal in its RKHS."""

    points: Float[Array, "m n"]

    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        S = self.points
        landmarks = given_landmarks(K, S)
        # Without a column a fit fails; its features would be those of the zero field.
        T = jnp.where(landmarks.count == 0, jnp.nan, whitening(constant(K), landmarks))
        # Only F Fᵀ = G_XS T Tᵀ G_SX matters, and TTᵀ = G_SS⁻¹: dF = dG_XS T − ½ F (Tᵀ dG_SS T)
        # changes it as the derivative of T would, which rounds by the condition of G_SS.
        own = T.T @ assemble(K, S, S).reshape(S.size, S.size) @ T
        T = T - 0.5 * T @ (own - jax.lax.stop_gradient(own))
        columns = Columns(K, S)
        return lambda x: (columns(x).reshape(x.size, S.size) @ T).reshape(*x.shape, S.size)
