"""Regularised least squares in the span of landmarks: O(N r²) time, O(N n + r²) memory.

With S the landmarks, L the Cholesky factor of their Gram and F = G_XS L⁻ᵀ, the Gram is nearly
Ĝ = F Fᵀ, and the field Σⱼ K(x, sⱼ) αⱼ with α = L⁻ᵀw minimises ‖y − F w‖² + Nλ‖w‖². F is seen tile
by tile and only the sums FᵀF and Fᵀy stay.

The matrix FᵀF + NλI has the condition of G + NλI, not its square: these are no normal equations in
α, which would lose twice the digits. What the sums round off is given back by one step of
refinement with the residual of the data (Björck's corrected seminormal equations).

A stream is seen once and leaves no residual; `stream_sums.py` says how its sums keep digits.
"""

import numbers
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Key, Num, UInt32

from hamkernel import _require as require
from hamkernel._fields.base import root
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.dense import trace
from hamkernel._gram.observed import components
from hamkernel._gram.operator import product
from hamkernel._machine import as_given, rows_of, split
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers import landmark_fit, stream_sums
from hamkernel._solvers.landmark_field import (
    CHOOSE,
    Solution,
    landmark_field,
    warn_if_truncated,
)
from hamkernel._solvers.landmark_fit import LandmarkFit
from hamkernel._solvers.landmark_gram import Columns, factor, truncated, whitening
from hamkernel._solvers.landmarks import (
    Landmarks,
    choose_landmarks,
    choose_rows,
    given_landmarks,
    landmarks_of,
)
from hamkernel._solvers.low_rank_conditional import LowRankConditional, low_rank_conditional
from hamkernel._solvers.spans import LandmarkBasis, landmark_span
from hamkernel._solvers.streaming import AbstractStreamingSolver, thinned
from hamkernel._structures.base import AbstractMatrixKernel


class Nystrom(AbstractStreamingSolver[KernelField, LandmarkFit]):
    """A low-rank fit: the field lives on a few landmarks, chosen from the data.

    Landmarks are drawn by randomly pivoted Cholesky until trace(G − Ĝ) ≤ tolerance · Nλ. Then the
    fitted values ŷ differ from those of the exact fit by at most tolerance · ‖y − ŷ‖, since the
    difference is Nλ (G + NλI)⁻¹ (G − Ĝ) (Ĝ + NλI)⁻¹ y. So more noise and a larger λ need fewer
    landmarks, and N does not matter. Smooth kernels in few dimensions need tens to hundreds. The
    result carries `field.info.landmarks`, `.rank` and the `.truncation` that was reached.

    Under jit, vmap and grad the number of landmarks cannot depend on values: buffers have the size
    of `max_points`. Outside of them it is rounded up to a multiple of 16, and each such number
    compiles anew: for a sweep over hyperparameters give `points`. Derivatives hold the landmarks
    fixed.

    Args:
        tolerance: the bound on trace(G − Ĝ)/(Nλ), dimensionless.
        max_points: the largest number of landmarks m. In float64 at most 8 m n² `candidates` bytes
            while they are chosen, and 16 (m n)² after that.
        candidates: landmarks are chosen from the data, or from a random part of this size.
        key: for the draws; `jax.random.key(0)` if None, so that a fit can be repeated.
        points: the landmarks, shape (m, n), if they are not to be chosen; columns of theirs that
            depend on others are left out. `max_points`, `candidates` and `key` have no effect.

    Raises:
        ValueError: an argument is not positive, `points` is not of shape (m, n), or the tolerance
            is a whole number above 1, which looks like `max_points`; write 10.0 if it is meant.
            TypeError: a number of points is not whole, or `key` no key.

    Warns:
        UserWarning: the landmarks do not reach the tolerance.

    Source: Chen, Epperly, Tropp & Webber (2023), arXiv 2207.06503; Björck (1987) for the solve.
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
                f"most {tolerance} landmarks say hk.Nystrom(max_points={tolerance}); for that "
                f"tolerance write {tolerance}.0."
            )
        self.max_points = require.count(max_points, "max_points")
        self.candidates = require.count(candidates, "candidates")
        self.key = None if key is None else require.key(key)
        self.points = None if points is None else require.points(points, "points")

    def landmarks(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> Landmarks:
        """The points given, or the rows that reach the tolerance, or as many as there may be."""
        if self.points is not None:
            d = rows.blocks[0].points.shape[1]
            if self.points.shape[1] != d:
                m = self.points.shape[1]
                raise ValueError(f"the landmarks have {m} coordinates and X {d}.")
            points = self.points.astype(rows.targets.dtype)
            return given_landmarks(K, landmarks_of(components(K, points)))
        key = jax.random.key(0) if self.key is None else self.key
        left, most = self.tolerance * regularization, self.max_points
        if rows.states is not None:
            return choose_landmarks(K, rows.states[0], left, most, self.candidates, key)
        left, most = left * (rows.count / len(rows.targets)), most * rows.dimension
        return choose_rows(K, rows, left, most, self.candidates, key)

    def _basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> LandmarkBasis:
        return LandmarkBasis(self.landmarks(K, rows, regularization))

    def _fitted(self, problem, throw=True, progress=False) -> KernelField:
        if problem.states is None:
            return self._given(problem, throw).field
        K, (X, Y), regularization = problem.kernel, problem.states, problem.regularization
        landmarks = self.landmarks(K, problem.rows, regularization)
        spread = rows_of(X)
        X, Y = split(spread, X), split(spread, Y)
        solution = _fit(K, X, Y, regularization, landmarks, spread)
        solution = solution._replace(residual=as_given(spread, solution.residual))
        return landmark_field(K, landmarks, solution, regularization, self.tolerance, CHOOSE, throw)

    def _given(self, problem, throw=True, progress=False) -> LowRankConditional:
        problem = problem.on_one_device()
        K, rows, regularization = problem.kernel, problem.rows, problem.regularization
        landmarks = self.landmarks(K, rows, regularization)
        given = low_rank_conditional(landmark_span(K, landmarks), rows, regularization, throw)
        truncation = given.field.info.truncation
        warn_if_truncated(truncation, landmarks.count, self.tolerance, CHOOSE)
        return given

    def _started(self, K, sample, regularization) -> LandmarkFit:
        landmarks = self.landmarks(K, sample, regularization)
        some = thinned(K, sample, self.candidates)
        return landmark_fit.start(K, some, regularization, landmarks, self.tolerance)


@eqx.filter_jit
def _fit(K, X, Y, regularization, landmarks, spread):
    S, ridge = landmarks.points, len(X) * regularization
    T = whitening(K, landmarks)
    total = stream_sums.normal(Columns(K, landmarks), T, X, Y, spread)
    R = factor(total.square, ridge)

    def step(w, residual):
        """One step of refinement, from w and y − F w."""
        slope = T.T @ product(K, S, X, residual, None, spread).reshape(-1) - ridge * w
        correction = jax.scipy.linalg.cho_solve((R, True), slope)
        change = product(K, X, S, (T @ correction).reshape(len(S), -1), spread)
        return w + correction, residual - change

    w = jax.scipy.linalg.cho_solve((R, True), total.moment)
    A = (T @ w).reshape(len(S), -1)
    w, residual = step(w, Y - product(K, X, S, A, spread))
    truncation = truncated(trace(K, X, spread), jnp.trace(total.square), ridge)
    # ‖f‖² = αᵀ G_SS α = ‖w‖²
    return Solution(T @ w, residual, root(w @ w), truncation)
