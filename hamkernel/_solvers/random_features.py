"""Least squares in random Fourier features, in memory independent of the number of points."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, UInt32

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.expansions import FeatureField, feature_field
from hamkernel._machine import (
    precise_jit,
    refuse_beyond_memory,
    row_sharding,
    shard,
    to_caller_sharding,
)
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.least_squares import Normal, Sums, first_sums, ridge_regression, solve_sums
from hamkernel._solvers.low_rank import (
    FeatureSpan,
    LowRankConditional,
    WaveBasis,
    low_rank_conditional,
    singular_message,
)
from hamkernel._solvers.stream import (
    AbstractStreamingFit,
    AbstractStreamingSolver,
    thin,
)
from hamkernel._structures.base import AbstractMatrixKernel


class RandomFeatures(AbstractStreamingSolver[FeatureField, "FeatureFit"]):
    """The solver of ridge regression in r random Fourier features.

    The structure of the field is exact for every count. The kernel is approximate, with an error of
    order count^(−1/2), or smaller for fields that the features can represent. A fit takes O(N n r²)
    time and O(r²) memory beside the data, by a QR of tiles of rows. The scalar kernels must be
    shift-invariant: Gaussian, Matern, RationalQuadratic and Periodic, and their sums, products,
    multiples and Select. Every structure and parity is allowed.

    How to choose: start with 500 frequencies in the plane. Short lengthscales and rough kernels
    need more: with Matern(1.5) the error falls slowly, since the fourth moment of the frequencies
    is infinite. If N n is a few thousands, `Cholesky()` is exact and as fast. `Nystrom()` needs
    fewer columns for the same accuracy.

    Args:
        count: the number of frequencies for each term of each scalar kernel. A frequency has a
            cosine and a sine, or one of these for an odd or even kernel. A divergence-free field
            has a set of frequencies for each of the n(n − 1)/2 planes, a separable field a set for
            each component.
        key: the random key, `jax.random.key(0)`. The same key draws the same features.

    Raises:
        ValueError: count is not positive; or, from `fit` and `start`, the matrices do not fit in
            memory. TypeError: count is no integer, or key is no key.

    Source: Rahimi & Recht (2007).
    """

    is_low_rank: ClassVar[bool] = True
    count: int = eqx.field(static=True)
    key: Key[Array, ""]

    def __init__(self, count: int, key: Key[Array, ""] | UInt32[Array, "..."]):
        self.count = require.count(count, "count")
        self.key = require.key(key)

    def low_rank_basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> WaveBasis:
        return WaveBasis(self.key, self.count)

    def fit(self, problem, throw=True, progress=False) -> FeatureField:
        if problem.states is None:
            field: Any = self.condition(problem, throw).field
            return field
        spread = row_sharding(problem.rows.points)
        X, Y = (shard(spread, array) for array in problem.states)
        field = _feature_fit(problem.kernel, self, X, Y, problem.regularization, spread)
        field = _check_field(field, throw)
        if spread is None:
            return field
        residual = to_caller_sharding(spread, field.residual)
        return eqx.tree_at(lambda f: f.residual, field, residual)

    def condition(self, problem, throw=True, progress=False) -> LowRankConditional:
        problem = problem.to_one_device()
        K, rows, regularization = problem.kernel, problem.rows, problem.regularization
        basis = self._features(K, rows.points.shape[1], rows.targets.dtype)
        span = FeatureSpan(K, basis, rows.dimension)
        return low_rank_conditional(span, rows, regularization, throw)

    def _features(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> AbstractFeatures:
        """The features of K for points of n coordinates; ValueError if a fit exceeds the memory."""

        def features_of(K, key):
            return features(K, n, self.count, key, dtype)

        r = eqx.filter_eval_shape(features_of, K, self.key).columns
        what, cure = f"a fit with count = {self.count}", "Take fewer features."
        # Eight matrices of r² numbers: the triangle (1), the tile of 3r rows below it (3), and
        # their QR factorisation (4).
        refuse_beyond_memory(what, r, r, dtype, 8, cure)
        return features_of(K, self.key)

    def _start_fit(self, K, sample, regularization) -> "FeatureFit":
        basis = self._features(K, sample.points.shape[1], sample.targets.dtype)
        # 4096 points set the basis of the sums, the default number of candidates of `Nystrom`.
        return _start(K, basis, thin(K, sample, 4096), regularization)


@precise_jit
def _feature_fit(K, solver, X, Y, regularization, spread):
    basis = solver._features(K, X.shape[1], X.dtype)
    ridge = len(X) * regularization
    weights, residual = ridge_regression(basis, basis.columns, X, Y, ridge, spread)
    return _field_of_weights(K, basis, weights, residual, regularization)


def _field_of_weights(K, basis, w, residual, regularization, residual_norm=None):
    rank = jnp.asarray(len(w))
    info = SolverInfo("RandomFeatures", rank=rank, residual_norm=residual_norm)
    return feature_field(K, basis, w, residual, regularization, info)


def _check_field(field: FeatureField, throw: bool = True) -> FeatureField:
    """The field; RuntimeError, or NaN without `throw`, if the least squares have no solution."""

    def learned_arrays(f: FeatureField):
        return f.weights, f.residual, f.norm

    failed = require.not_finite(field.weights)
    cause = singular_message(field.weights.dtype)
    values = require.value(learned_arrays(field), failed, cause, RuntimeError, throw)
    return eqx.tree_at(learned_arrays, field, values)


class FeatureFit(AbstractStreamingFit[FeatureField]):
    """A fit in random features to the data added so far, made by `RandomFeatures.start`.

    The fit has a fixed size, 4r² numbers for r columns. `add` returns a new fit, and `field` solves
    for any λ:

        model = hk.RandomFeatures(500, key).start(K, X, 1e-4).add(X, Y)
        field = model.field()
        better = model.add(X_new, Y_new).field()

    Attributes:
        kernel: K.
        features: the features of K.
        sums: the normal equations of the rows added.
        compensation: the rounding errors of the sums.
        count: N, the number of points added, shape ().
        regularization: the λ of `start`, shape ().
        dimension: n, the number of coordinates of a state.
    """

    kernel: AbstractMatrixKernel
    features: AbstractFeatures
    sums: Sums
    compensation: tuple[Normal]
    count: Int[Array, ""]
    regularization: Float[Array, ""]
    dimension: int = eqx.field(static=True)

    def _columns(self) -> tuple[str, Any, Any]:
        return "features", len(self.sums.basis), self.features

    @property
    def _functions(self) -> FeatureSpan:
        return FeatureSpan(self.kernel, self.features, self.dimension)

    @property
    def _totals(self) -> tuple[Any, ...]:
        return (self.sums.normal_equations,)

    def _solve(self, count: Int[Array, ""], regularization: Float[Array, ""]) -> FeatureField:
        return _check_field(_feature_solution(self, count, regularization))


@precise_jit
def _start(K, basis, sample, regularization):
    one = jnp.eye(basis.columns, dtype=sample.targets.dtype)
    span = FeatureSpan(K, basis, sample.dimension)
    sums = first_sums(span.normal_equations(sample, one), one, sample.count, regularization)
    return FeatureFit(
        kernel=K,
        features=basis,
        sums=sums,
        compensation=(sums.normal_equations,),
        count=jnp.zeros((), int),
        regularization=regularization,
        dimension=sample.dimension,
    )


@precise_jit
def _feature_solution(fit, count, regularization):
    ridge = count.astype(regularization.dtype) * regularization
    weights, _, residual_norm = solve_sums(fit.sums, ridge)
    unseen = jnp.zeros((0, fit.dimension), weights.dtype)
    return _field_of_weights(
        fit.kernel, fit.features, weights, unseen, regularization, residual_norm
    )
