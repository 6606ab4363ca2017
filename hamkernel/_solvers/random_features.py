"""Least squares in random Fourier features, in memory independent of the number of points."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, UInt32

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features
from hamkernel._fields.expansions import FeatureField
from hamkernel._machine import precise_jit, refuse_beyond_memory, row_sharding, shard
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.least_squares import ridge_regression
from hamkernel._solvers.low_rank import (
    AbstractBasis,
    FeatureSpan,
    LowRankConditional,
    check_low_rank,
    low_rank_conditional,
)
from hamkernel._solvers.stream import AbstractStreamingFit, AbstractStreamingSolver, start_fit, thin
from hamkernel._structures.base import AbstractMatrixKernel


class RandomFeatures(AbstractStreamingSolver[FeatureField, "FeatureFit"], AbstractBasis):
    """The solver of ridge regression in r random Fourier features.

    The structure of the field is exact for every count. The kernel is approximate, with an error of
    order count^(−1/2), or smaller for fields that the features can represent. A fit takes O(N n r²)
    time and O(r²) memory beside the data. The scalar kernels must be shift-invariant: Gaussian,
    Matern, RationalQuadratic and Periodic, and their sums, products, multiples and Select. Every
    structure and parity is allowed.

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
    ) -> "RandomFeatures":
        return self

    def span(self, K: AbstractMatrixKernel, n: int, dtype: jnp.dtype) -> FeatureSpan:
        """The features of K at points of n coordinates; their frequencies scale with the kernel.

        Raises:
            ValueError: a fit exceeds the memory.
        """

        def features_of(K, key):
            return features(K, n, self.count, key, dtype)

        r = eqx.filter_eval_shape(features_of, K, self.key).columns
        what, cure = f"a fit with count = {self.count}", "Take fewer features."
        # Eight matrices of r² numbers: the sums of the sample and of all rows, the triangle, the
        # basis, the factor, and the temporaries of these products.
        refuse_beyond_memory(what, r, r, dtype, 8, cure)
        return FeatureSpan(K, features_of(K, self.key), K.outputs(n))

    def fit(self, problem, throw=True, progress=False) -> FeatureField:
        if problem.states is None:
            field: Any = self.condition(problem, throw).field
            return field
        spread = row_sharding(problem.rows.points)
        X, Y = (shard(spread, array) for array in problem.states)
        field = _feature_fit(problem.kernel, self, X, Y, problem.regularization, spread)
        return check_low_rank(field, throw)

    def condition(self, problem, throw=True, progress=False) -> LowRankConditional:
        problem = problem.to_one_device()
        K, rows, regularization = problem.kernel, problem.rows, problem.regularization
        span = self.span(K, rows.points.shape[1], rows.targets.dtype)
        return low_rank_conditional(span, rows, regularization, throw)

    def _start_fit(self, K, sample, regularization) -> "FeatureFit":
        span = self.span(K, sample.points.shape[1], sample.targets.dtype)
        one = jnp.eye(span.features.columns, dtype=sample.targets.dtype)
        # 4096 points set the basis of the sums, the default number of candidates of `Nystrom`.
        subset, basis = thin(K, sample, 4096), span.features
        return start_fit(FeatureFit, span, one, subset, regularization, features=basis)


@precise_jit
def _feature_fit(K, solver, X, Y, regularization, spread):
    span, ridge = solver.span(K, X.shape[1], X.dtype), len(X) * regularization
    one = jnp.eye(span.features.columns, dtype=X.dtype)
    weights, residual, _ = ridge_regression(span.features, one, X, Y, ridge, spread)
    return span.field(weights, residual, regularization)


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

    features: AbstractFeatures

    def _columns(self) -> tuple[str, Any, Any]:
        return "features", len(self.sums.basis), self.features

    @property
    def _functions(self) -> FeatureSpan:
        return FeatureSpan(self.kernel, self.features, self.dimension)

    def _field(self, w, norm, residual, residual_norm, regularization, ridge) -> FeatureField:
        return self._functions.field(w, residual, regularization, residual_norm=residual_norm)

    def _check_field(self, field: FeatureField) -> FeatureField:
        return check_low_rank(field, throw=True)
