"""The fields that solvers return: sums of kernels, Σⱼ K(x, zⱼ) aⱼ, or of features, Σ_r w_r φ_r."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._features import AbstractFeatures, SumFeatures, laws_of, part_terms
from hamkernel._fields.base import AbstractField, SolverInfo, map_states, root
from hamkernel._gram import subtract_centre
from hamkernel._gram_operator import placed_product
from hamkernel._kernels.base import Point, Points
from hamkernel._machine import map_devices, precise_jit, row_sharding, shard, to_caller_sharding
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.joined import AbstractJoinedKernel
from hamkernel._structures.structure import AbstractPotentialKernel


class KernelField(AbstractField):
    """f(x) = Σⱼ K(x, zⱼ) aⱼ, the minimiser of the regularised least squares.

    If the data contain energies, the potential also has the terms Σₑ bₑ k(·, sₑ). A prior mean is
    added. Evaluating f or its potential costs O(M n) for M points.

    Attributes:
        kernel: K.
        points: zⱼ, shape (M, n): the data, or the landmarks of a low-rank solver.
        coefficients: aⱼ, shape (M, n).
        residual: yᵢ − f(xᵢ) at the training data, shape (N, n). For observations other than
            complete velocities, one residual for each row, in the units of the row, shape (D,).
            After a fit to a stream, empty, shape (0, n).
        norm: the norm of f minus its prior mean in the RKHS of K, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant of the potential, shape ().
        info: the outcome of the solver.
        value_points: sₑ, shape (E, n); None without energies.
        value_coefficients: bₑ, shape (E,); None without energies.
        mean: the prior mean, x (n,) -> (n,); None if it is zero.
    """

    kernel: AbstractMatrixKernel
    points: Float[Array, "M n"]
    coefficients: Float[Array, "M n"]
    residual: Float[Array, "..."]
    norm: Float[Array, ""]
    regularization: Float[Array, ""]
    offset: Float[Array, ""]
    info: SolverInfo = SolverInfo("none")
    value_points: Float[Array, "E n"] | None = None
    value_coefficients: Float[Array, " E"] | None = None
    mean: Callable[..., Any] | None = None

    @property
    def dimension(self) -> int:
        return self.points.shape[-1]

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        field = _expansion(self.kernel, x, self.points, self.coefficients)
        return self._add_values(field, _value_field, x)

    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        fields = placed_product(self.kernel, X, self.points, self.coefficients)
        return self._add_values(fields, _value_fields, X)

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        potential = _potential(self.kernel, x, self.points, self.coefficients)
        return self._add_values(potential, _value_potential, x)

    def _add_values(self, field: Array, contribution: Callable[..., Array], x: Array) -> Array:
        """The sum `field + contribution(K, x, s, b)` if there are energies; else `field`."""
        S, b = self.value_points, self.value_coefficients
        return field if S is None or b is None else field + contribution(self.kernel, x, S, b)

    def _laws(self) -> list[tuple[Any, Float[Array, " m"]]]:
        laws, K = [], self.kernel
        for term in K.terms if isinstance(K, Sum) else (K,):
            if not isinstance(term, AbstractPotentialKernel):
                continue
            for waves in filter(None, part_terms(term.kernel)):
                directions = jax.vmap(term.apply_transpose)(self.points, self.coefficients)
                slopes = jax.lax.map(waves.gradients, self.points)
                weights = jnp.einsum("jnm,jn->m", slopes, directions)
                laws += [(waves, weights[place]) for _, place in laws_of(waves)]
        return laws

    def _term(self, kernel: Sum, position: int) -> "KernelField":
        term, Z, A = kernel.terms[position], self.points, self.coefficients
        # Let a be the coefficients of K(·, z) and b those of k(·, s). Then
        #     ‖f‖² = aᵀG_aa a + 2 aᵀG_ab b + bᵀG_bb b.
        # With 2a in place of a the potential is u(S) = 2 G_ba a + G_bb b, so b·u(S) is the sum of
        # the last two terms.
        square = jnp.sum(A * placed_product(term, Z, Z, A))
        bare = dataclasses.replace(self, kernel=term, offset=jnp.zeros_like(self.offset), mean=None)
        S, b = self.value_points, self.value_coefficients
        if S is not None and b is not None:
            doubled = dataclasses.replace(bare, coefficients=2 * A)
            square = square + b @ map_states(doubled._learned_potential, S)
        return dataclasses.replace(bare, norm=root(square))


@precise_jit
def _expansion(K: AbstractMatrixKernel, x: Point, Z: Points, A: Points) -> Point:
    """The field Σⱼ K(x, zⱼ) aⱼ at x, from the potential, without (n, n) blocks."""
    x, Z = subtract_centre(K, x, Z)
    return K.expansion(x, Z, A)


@precise_jit
def _potential(K: AbstractMatrixKernel, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
    """The potential of the field `_expansion`."""
    x, Z = subtract_centre(K, x, Z)
    return K.potential(x, Z, A)


@precise_jit
def _value_potential(
    K: AbstractMatrixKernel, x: Float[Array, " n"], S: Float[Array, "E n"], b: Float[Array, " E"]
) -> Float[Array, ""]:
    """The potential Σₑ bₑ k(x, sₑ)."""
    x, S = subtract_centre(K, x, S)
    return b @ jax.vmap(K.potential_covariance, in_axes=(None, 0))(x, S)


@precise_jit
def _value_field(
    K: AbstractMatrixKernel, x: Float[Array, " n"], S: Float[Array, "E n"], b: Float[Array, " E"]
) -> Float[Array, " n"]:
    """The field of the potential Σₑ bₑ k(x, sₑ).

    The component along v is Cov(vᵀf(x), Σₑ bₑ u(sₑ)) = Σₑ bₑ (potential of K(·, x)v at sₑ). The
    component is linear in v, so its gradient with respect to v is the field. We need no B.
    """
    x, S = subtract_centre(K, x, S)

    def component(v):
        return b @ jax.vmap(lambda s: K.potential(s, x[None], v[None]))(S)

    return jax.grad(component)(jnp.zeros(K.outputs(len(x)), x.dtype))


_value_fields = precise_jit(lambda K, X, S, b: map_states(lambda x: _value_field(K, x, S, b), X))


def kernel_field(
    K: AbstractMatrixKernel,
    representer: tuple[Array, Array, Array, Array],
    residual: Float[Array, "..."],
    norm: Float[Array, ""],
    regularization: Float[Array, ""],
    info: SolverInfo,
) -> KernelField:
    """The field Σ K(x, z) a + Σ b k(·, s) of a representer (z, a, s, b), without an anchor."""
    Z, A, S, b = representer
    return KernelField(
        kernel=K,
        points=Z,
        coefficients=A,
        residual=residual,
        norm=norm,
        regularization=regularization,
        offset=jnp.zeros((), A.dtype),
        info=info,
        value_points=S if len(S) else None,
        value_coefficients=b if len(S) else None,
    )


class FeatureField(AbstractField):
    """f(x) = Σ_r w_r φ_r(x), where the features φ_r have the structure of the kernel.

    The features are random, or those of `hk.Shared` laws. The structure is exact: with random
    features f = B∇u for the potential u(x) = Σ_r (α_r cos ω_r·x + β_r sin ω_r·x). Evaluating f or
    its potential costs O(r n), independent of the number of data.

    Attributes:
        kernel: K, which the features approximate.
        features: φ. `F = field.features(X)`, shape (N, n, r), holds φ_r(xᵢ), and
            `jnp.einsum("iar,jbr->iajb", F, F)` is the Gram of the approximate kernel.
        weights: w, shape (r,).
        residual: yᵢ − f(xᵢ) at the training data, shape (N, n). After a fit to a stream, empty,
            shape (0, n).
        norm: ‖w‖, the norm of f in the RKHS of the approximate kernel, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant of the potential, shape ().
        info: the outcome of the solver.
        mean: the prior mean, x (n,) -> (n,); None if it is zero.
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
        K, n = self.kernel, self.residual.shape[-1]
        return n + K.input_count if isinstance(K, AbstractJoinedKernel) else n

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return _field_at(self.features, x, self.weights)

    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        spread = row_sharding(X)
        return to_caller_sharding(spread, _evaluate(self, shard(spread, X), spread))

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return _potential_at(self.features, x, self.weights)

    def _laws(self) -> list[tuple[Any, Float[Array, " m"]]]:
        return [(waves, self.weights[place]) for waves, place in self.features.laws()]

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


_field_at = precise_jit(lambda features, x, weights: features.field(x, weights))
_potential_at = precise_jit(lambda features, x, weights: features.potential(x, weights))


@precise_jit
def _evaluate(field, X, spread):
    return map_devices(
        spread, lambda field, X: map_states(field._velocity, X), field, X, joined=True
    )
