"""A field learned in random Fourier features."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._features.features import AbstractFeatures, SumFeatures
from hamkernel._fields.base import BATCH, AbstractField, SolverInfo, root
from hamkernel._machine import as_given, on_each, rows_of, split
from hamkernel._structures.base import AbstractMatrixKernel, Sum


class FeatureField(AbstractField):
    """f(x) = Σ_r w_r φ_r(x), φ_r random features with the structure of the kernel.

    The structure is exact: f = B∇u of the potential u(x) = Σ_r (α_r cos ω_r·x + β_r sin ω_r·x).
    Evaluating f or its potential costs O(r n), whatever the number of data.

    Attributes:
        kernel: K, which the features approximate.
        features: φ, with frequencies and amplitudes; `F = field.features(X)`, shape (N, n, r),
            holds φ_r(xᵢ), so `jnp.einsum("iar,jbr->iajb", F, F)` is the Gram of the approximation.
        weights: w, shape (r,).
        residual: yᵢ − f(xᵢ) at the training data, shape (N, n); of shape (0, n) after a fit to a
            stream, which is not kept.
        norm: ‖w‖, the norm of f in the RKHS of the approximate kernel, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant in the potential, shape ().
        info: the outcome of the solver.
        mean: the prior mean, x (n,) -> (n,), which is added; None if it is zero.
    """

    kernel: AbstractMatrixKernel
    features: AbstractFeatures
    weights: Float[Array, " r"]
    residual: Float[Array, "N n"]
    norm: Float[Array, ""]
    regularization: Float[Array, ""]
    offset: Float[Array, ""]
    info: SolverInfo
    mean: Callable[..., Any] | None = None

    @property
    def dimension(self) -> int:
        return self.residual.shape[-1]

    def _learned(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return _field_at(self.features, x, self.weights)

    def _evaluated(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        spread = rows_of(X)
        return as_given(spread, _evaluate(self, split(spread, X), spread))

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return _potential_at(self.features, x, self.weights)

    def _term(self, kernel: Sum, position: int) -> "FeatureField":
        assert isinstance(self.features, SumFeatures)
        weights = self.weights[self.features.slice(position)]
        terms = kernel.terms[position], self.features.terms[position]
        return dataclasses.replace(
            self,
            kernel=terms[0],
            features=terms[1],
            weights=weights,
            norm=root(weights @ weights),
            offset=jnp.zeros_like(self.offset),
            mean=None,
        )


def feature_field(
    K: AbstractMatrixKernel,
    features: AbstractFeatures,
    w: Float[Array, " r"],
    residual: Float[Array, "N n"],
    regularization: Float[Array, ""],
    info: SolverInfo,
) -> FeatureField:
    """The field Σ_r w_r φ_r."""
    return FeatureField(
        kernel=K,
        features=features,
        weights=w,
        residual=residual,
        norm=root(w @ w),
        regularization=regularization,
        offset=jnp.zeros((), w.dtype),
        info=info,
    )


@eqx.filter_jit
def _field_at(features, x, weights):
    return features.field(x, weights)


@eqx.filter_jit
def _potential_at(features, x, weights):
    return features.potential(x, weights)


@eqx.filter_jit
def _evaluate(field, X, spread):
    if spread is not None:
        return on_each(spread, lambda field, X: _evaluate(field, X, None), field, X, joined=True)
    return jax.lax.map(field._learned, X, batch_size=BATCH)
