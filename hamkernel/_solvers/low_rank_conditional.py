"""The field given observations in a space of r functions: landmarks' columns, or random features.

The prior there is f(x) = Φ(x) w, w ~ N(0, I). With F the rows of the data and RᵀR = FᵀF + σ²I, the
weights are N(R⁻¹R⁻ᵀFᵀy, σ² R⁻¹R⁻ᵀ), so that a covariance given the data is σ² Φ₁ R⁻¹R⁻ᵀ Φ₂ᵀ. What
landmarks do not span, K − ΦΦᵀ, is not told by the data and stays as it was before, so that far from
them nothing is claimed to be known. R comes from a QR of F below σI, not from FᵀF; new rows go on
with it.

Source: Quiñonero-Candela & Rasmussen (2005), section 5, the deterministic training conditional.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.conditional import AbstractConditional
from hamkernel._solvers.landmark_gram import checked, singular
from hamkernel._solvers.spans import AbstractSpan, LandmarkSpan


class LowRankConditional(AbstractConditional):
    """By R with RᵀR = FᵀF + σ²I; the weights are w = R⁻¹ `rotated`."""

    field: AbstractField
    rows: Measurements
    ridge: Float[Array, ""]
    span: AbstractSpan
    R: Float[Array, "r r"]
    rotated: Float[Array, " r"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        own = self._whitened_covariance(left)
        other = own if right is left else self._whitened_covariance(right)
        return self.span.missing(left, right) + self.ridge * own.T @ other

    def _whitened_covariance(self, block: AbstractBlock) -> Float[Array, "r d"]:
        return solve_triangular(self.R, self.span.of(block).T, trans="T")

    def updated(self, new: Measurements) -> "LowRankConditional":
        rows = self.rows.joined(new)
        beside, fresh = self.rows.with_previous(new), rows.size - self.rows.size
        new_rows = beside.contrast(self.span.of_rows(beside))[-fresh:]
        R, rotated = _below(self.R, self.rotated, new_rows, rows.y[-fresh:])
        return _conditional(self.span, rows, self.ridge, R, rotated)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        of_weights, rest = jax.random.split(key)
        z = jax.random.normal(of_weights, (len(self.R), count), self.R.dtype)
        w = solve_triangular(self.R, self.rotated[:, None] + jnp.sqrt(self.ridge) * z)
        return self.span.draws(w.T, self.rows, rest, region)


def low_rank_conditional(
    span: AbstractSpan, rows: Measurements, regularization: Float[Array, ""], throw: bool = True
) -> LowRankConditional:
    """The field given the rows in the span of some functions: O(D r²) time, O(D r) memory.

    Raises:
        RuntimeError: the least squares have no solution to rounding.
    """
    conditional = _least_squares(span, rows, rows.count * regularization)
    field = conditional.field
    cause = singular(field.offset.dtype)
    arrays, rest = eqx.partition(field, eqx.is_inexact_array)
    failed = require.not_finite(field.norm)
    if isinstance(span, LandmarkSpan):
        truncation = field.info.truncation
        arrays = checked(arrays, span.landmarks, truncation, failed, cause, throw)
    else:
        arrays = require.value(arrays, failed, cause, RuntimeError, throw)
    return eqx.tree_at(lambda c: c.field, conditional, eqx.combine(arrays, rest))


@eqx.filter_jit
def _least_squares(span, rows, ridge):
    F = rows.contrast(span.of_rows(rows))
    start = jnp.sqrt(ridge) * jnp.eye(F.shape[1], dtype=F.dtype)
    return _conditional(span, rows, ridge, *_below(start, jnp.zeros_like(F[0]), F, rows.y))


def _below(R, rotated, F, y):
    """The triangular factor of [R; F], and the right-hand side beside it."""
    both = jnp.concatenate(
        [jnp.column_stack([R, rotated]), jnp.column_stack([F, y])],
    )
    Q = jnp.linalg.qr(both, mode="r")
    return Q[: len(R), :-1], Q[: len(R), -1]


def _conditional(span, rows, ridge, R, rotated):
    w, F = solve_triangular(R, rotated), span.of_rows(rows)
    left = rows.y - rows.contrast(F @ w)
    truncation = span.truncation(rows, F, ridge)
    field = span.field(w, rows.residual(left), ridge, rows.count, truncation)
    return LowRankConditional(field, rows, ridge, span, R, rotated)
