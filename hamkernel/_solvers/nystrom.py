"""Regularised least squares in the span of landmarks: O(N r²) time, O(N n + r²) memory.

Let S be the landmarks, T Tᵀ = G_SS⁻¹, and F = G_XS T. The Gram is approximated by Ĝ = F Fᵀ. The
field Σⱼ K(x, sⱼ) αⱼ with α = T w minimises ‖y − F w‖² + Nλ‖w‖², the least squares of
`least_squares.py`. F is computed tile by tile. FᵀF + NλI has the condition number of G + NλI; the
normal equations in α would have its square.
"""

import numbers
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Key, Num, UInt32

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._fields.expansions import KernelField
from hamkernel._gram import components, trace, trace_of_rows
from hamkernel._machine import RowSharding, precise_jit, row_sharding, shard
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.landmarks import (
    Landmarks,
    choose_landmarks,
    choose_rows,
    given_landmarks,
    landmarks_of,
    whitening,
)
from hamkernel._solvers.least_squares import ridge_regression, trace_of_sums
from hamkernel._solvers.low_rank import (
    Columns,
    LandmarkBasis,
    LowRankConditional,
    check_low_rank,
    landmark_field,
    landmark_span,
    low_rank_conditional,
    truncation_of,
)
from hamkernel._solvers.stream import AbstractStreamingFit, AbstractStreamingSolver, start_fit, thin
from hamkernel._structures.base import AbstractMatrixKernel

REMEDY = (
    "Raise max_points, the tolerance or the regularization; let landmarks be chosen from more "
    "candidates;"
)


def warn_if_truncated(field: AbstractField, tolerance: float, cure: str = REMEDY) -> None:
    """Warn if the truncation is more than twice the tolerance.

    The landmarks reach the tolerance on the candidates, a random part of the data. On all the data
    the truncation may be larger.
    """
    truncation = field.info.truncation
    if truncation is None or not require.is_concrete(truncation):
        return
    if truncation > 2 * tolerance:
        if truncation.dtype == jnp.float32:
            cure = (
                "In float32 rounding may have ended the choice of landmarks early: "
                f"jax.config.update('jax_enable_x64', True). {cure}"
            )
        require.warn(
            f"{field.info.landmarks} landmarks leave trace(G - Ĝ)/(N λ) = {truncation:.2g}, more "
            f"than the tolerance {tolerance:.2g}. The field is the best one on these landmarks, "
            f"but may be far from the exact fit. {cure} for a rough kernel or many dimensions take "
            "hk.ConjugateGradient(), which is exact."
        )


class LandmarkFit(AbstractStreamingFit[KernelField]):
    """A fit on landmarks to the data added so far, made by `Nystrom.start`.

    The fit has a fixed size, 4r² numbers for r columns. `add` returns a new fit, and `field` solves
    for any λ:

        model = hk.Nystrom().start(K, X, 1e-4).add(X, Y)
        field = model.field()
        better = model.add(X_new, Y_new).field()

    `field.info.truncation` is the truncation for all the data added, and shows whether the
    landmarks still suffice.

    Attributes:
        kernel: K.
        landmarks: the points whose kernels span the field.
        sums: the normal equations of the rows added.
        trace: the trace of the Gram of the rows added, shape ().
        compensation: the rounding errors of the sums and the trace.
        count: N, the number of points added, shape ().
        regularization: the λ of `start`, shape ().
        dimension: n, the number of coordinates of a state.
        tolerance: the tolerance of the solver, for the warning.
    """

    landmarks: Landmarks
    trace: Float[Array, ""]
    tolerance: float = eqx.field(static=True)

    def _columns(self) -> tuple[str, Any, Any]:
        return "landmarks", self.landmarks.count, self.landmarks

    @property
    def _functions(self) -> Columns:
        return Columns(self.kernel, self.landmarks)

    @property
    def _totals(self) -> tuple[Any, ...]:
        return *super()._totals, self.trace

    def _totals_of(self, rows: Measurements, spread: RowSharding | None) -> tuple[Any, ...]:
        return *super()._totals_of(rows, spread), trace_of_rows(self.kernel, rows, spread)

    def _field(self, c, norm, residual, residual_norm, regularization, ridge) -> KernelField:
        truncation = truncation_of(self.trace, trace_of_sums(self.sums), ridge)
        return landmark_field(
            self.kernel,
            self.landmarks,
            regularization,
            c,
            residual,
            norm,
            truncation,
            residual_norm,
        )

    def _check_field(self, field: KernelField) -> KernelField:
        cure = (
            "Start anew with landmarks from a sample that looks like the data so far, and a "
            "max_points that suffices; or ask for a larger regularization;"
        )
        field = check_low_rank(field, throw=True)
        warn_if_truncated(field, self.tolerance, cure)
        return field


class Nystrom(AbstractStreamingSolver[KernelField, LandmarkFit]):
    """The solver of a low-rank fit, in the span of a few landmarks chosen from the data.

    Randomly pivoted Cholesky draws landmarks until trace(G − Ĝ) ≤ tolerance · Nλ, with Ĝ the
    Nyström approximation of the Gram G. The fitted values ŷ then differ from the exact values by at
    most tolerance · ‖y − ŷ‖, since the difference is Nλ (G + NλI)⁻¹ (G − Ĝ) (Ĝ + NλI)⁻¹ y. A larger
    λ therefore needs fewer landmarks, and their number hardly depends on N. Smooth kernels in few
    dimensions need tens to hundreds. `field.info` has the number of `landmarks`, the `rank`, and
    the `truncation` trace(G − Ĝ)/(Nλ).

    Under jit, vmap and grad the number of landmarks cannot depend on values, and buffers have the
    size of `max_points`. Otherwise the number is rounded up to a multiple of 16, and each multiple
    compiles a new program: pass `points` for a sweep over hyperparameters. Derivatives hold the
    landmarks fixed.

    Args:
        tolerance: the bound on trace(G − Ĝ)/(Nλ), dimensionless.
        max_points: the largest number of landmarks m. In float64 the choice takes at most
            8 m n² `candidates` bytes, and the fit 16 (m n)² bytes.
        candidates: the number of points from which landmarks are chosen, a random part of the data.
        key: the random key; `jax.random.key(0)` if None, so that a fit can be repeated.
        points: landmarks to use instead of choosing them, shape (m, n). Linearly dependent columns
            are dropped. `max_points`, `candidates` and `key` then have no effect.

    Raises:
        ValueError: an argument is not positive, `points` is not of shape (m, n), or the tolerance
            is a Python integer above 1, which looks like `max_points` (write 10.0 for a tolerance).
            TypeError: a number of points is no integer, or `key` no key.

    Warns:
        UserWarning: the landmarks do not reach the tolerance.

    Source: Chen, Epperly, Tropp & Webber (2023), arXiv 2207.06503.
    """

    is_low_rank: ClassVar[bool] = True
    tolerance: float = eqx.field(static=True)
    max_points: int = eqx.field(static=True)
    candidates: int = eqx.field(static=True)
    key: Key[Array, ""] | None
    points: Float[Array, "m n"] | None

    def __init__(
        self,
        tolerance: float = 0.1,
        max_points: int = 512,
        candidates: int = 4096,
        key: Key[Array, ""] | UInt32[Array, "..."] | None = None,
        points: Num[ArrayLike, "m n"] | None = None,
    ):
        self.tolerance = require.positive_number(tolerance, "tolerance")
        if isinstance(tolerance, numbers.Integral) and tolerance > 1:
            raise ValueError(
                f"got the whole number {tolerance} as the tolerance on trace(G - Ĝ)/(N λ). For at "
                f"most {tolerance} landmarks write hk.Nystrom(max_points={tolerance}); for this "
                f"tolerance write {tolerance}.0."
            )
        self.max_points = require.count(max_points, "max_points")
        self.candidates = require.count(candidates, "candidates")
        self.key = None if key is None else require.key(key)
        self.points = None if points is None else require.points(points, "points")

    def landmarks(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> Landmarks:
        """The caller's `points`, or landmarks chosen from the data.

        The choice stops when the tolerance is met or `max_points` is reached.
        """
        if self.points is not None:
            landmarks, d = "the landmarks, `points` of Nystrom, have", rows.points.shape[1]
            require.one_system(landmarks, self.points.shape[1], "X", d)
            points = self.points.astype(rows.targets.dtype)
            return given_landmarks(K, landmarks_of(components(K, points)))
        key = jax.random.key(0) if self.key is None else self.key
        target_trace, max_count = self.tolerance * regularization, self.max_points
        if rows.states is not None:
            return choose_landmarks(
                K, rows.states[0], target_trace, max_count, self.candidates, key
            )
        trace_of_row = target_trace * (rows.count / len(rows.targets))
        return choose_rows(K, rows, trace_of_row, max_count * rows.dimension, self.candidates, key)

    def low_rank_basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> LandmarkBasis:
        return LandmarkBasis(self.landmarks(K, rows, regularization))

    def fit(self, problem, throw=True, progress=False) -> KernelField:
        if problem.states is None:
            field: Any = self.condition(problem, throw).field
            return field
        K, (X, Y), regularization = problem.kernel, problem.states, problem.regularization
        landmarks = self.landmarks(K, problem.rows, regularization)
        spread = row_sharding(X)
        X, Y = shard(spread, X), shard(spread, Y)
        field = _landmark_fit(K, X, Y, regularization, landmarks, spread)
        field = check_low_rank(field, throw)
        warn_if_truncated(field, self.tolerance)
        return field

    def condition(self, problem, throw=True, progress=False) -> LowRankConditional:
        problem = problem.to_one_device()
        K, rows, regularization = problem.kernel, problem.rows, problem.regularization
        span = landmark_span(K, self.landmarks(K, rows, regularization))
        conditional = low_rank_conditional(span, rows, regularization, throw)
        warn_if_truncated(conditional.field, self.tolerance)
        return conditional

    def _start_fit(self, K, sample, regularization) -> LandmarkFit:
        landmarks = self.landmarks(K, sample, regularization)
        subset = thin(K, sample, self.candidates)
        return _start(K, subset, regularization, landmarks, self.tolerance)


@precise_jit  # so that T is bit by bit that of `_landmark_fit`
def _start(K, sample, regularization, landmarks, tolerance):
    T = whitening(K, landmarks)
    fields = {"landmarks": landmarks, "trace": jnp.zeros((), T.dtype), "tolerance": tolerance}
    return start_fit(LandmarkFit, Columns(K, landmarks), T, sample, regularization, **fields)


@precise_jit
def _landmark_fit(K, X, Y, regularization, landmarks, spread):
    span, ridge = landmark_span(K, landmarks), len(X) * regularization
    columns = Columns(K, landmarks)
    w, residual, covered = ridge_regression(columns, span.T, X, Y, ridge, spread)
    truncation = truncation_of(trace(K, X, spread), covered, ridge)
    return span.field(w, residual, regularization, truncation)
