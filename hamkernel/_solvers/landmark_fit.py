"""A fit on landmarks to a stream of data."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.dense import trace
from hamkernel._gram.observed import trace_of_rows
from hamkernel._machine import rows_of, split
from hamkernel._observations.measurements import Measurements
from hamkernel._show import text
from hamkernel._solvers import stream_sums
from hamkernel._solvers.landmark_field import START_ANEW, Solution, landmark_field
from hamkernel._solvers.landmark_gram import Columns, truncated, whitening
from hamkernel._solvers.landmarks import Landmarks
from hamkernel._solvers.stream_sums import Sums
from hamkernel._solvers.streaming import AbstractStreamingFit
from hamkernel._structures.base import AbstractMatrixKernel


class LandmarkFit(AbstractStreamingFit[KernelField]):
    """A fit on landmarks to the data added so far, made by `Nystrom.start`.

    It has a fixed size, 3r² numbers for r columns. `add` returns a new one, and `field` solves
    for any λ:

        model = hk.Nystrom().start(K, X, 1e-4).add(X, Y)
        field = model.field()
        better = model.add(X_new, Y_new).field()

    `field.info.truncation` is that of all the data added: it shows whether the landmarks are still
    enough.

    Attributes:
        kernel: K.
        landmarks: the points that carry the field.
        sums: what the least squares need of the points added.
        trace: the trace of their Gram, shape ().
        count: N, the number of points added, shape ().
        regularization: the λ of `start`, shape ().
        dimension: n, the number of coordinates of a state.
        tolerance: of the solver, for its warning.
    """

    kernel: AbstractMatrixKernel
    landmarks: Landmarks
    sums: Sums
    trace: Float[Array, ""]
    count: Int[Array, ""]
    regularization: Float[Array, ""]
    dimension: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def _size(self) -> str:
        return f"landmarks={text(self.landmarks.count)}"

    def _added(self, X: Float[Array, "N n"], Y: Float[Array, "N n"]) -> "LandmarkFit":
        spread = rows_of(X)
        return _with_data(self, split(spread, X), split(spread, Y), spread)

    @eqx.filter_jit
    def _added_rows(self, rows: Measurements) -> "LandmarkFit":
        K = self.kernel
        design = [self.landmarks.columns(K, block) for block in rows.blocks]
        new = (
            stream_sums.add_rows(self.sums, jnp.concatenate(design), rows.targets),
            self.trace + trace_of_rows(K, rows),
            self.count + rows.count,
        )
        return eqx.tree_at(lambda f: (f.sums, f.trace, f.count), self, new)

    def _solved(self, count: Int[Array, ""], regularization: Float[Array, ""]) -> KernelField:
        solution = _solution(self, count, regularization)
        landmarks, tolerance = self.landmarks, self.tolerance
        return landmark_field(
            self.kernel, landmarks, solution, regularization, tolerance, START_ANEW
        )


@eqx.filter_jit
def start(K, sample, regularization, landmarks, tolerance):
    T = whitening(K, landmarks)
    if sample.states is None:
        design = [landmarks.columns(K, block) for block in sample.blocks]
        seen = stream_sums.Normal.zero(T).plus(jnp.concatenate(design) @ T, sample.targets)
    else:
        seen = stream_sums.normal(Columns(K, landmarks), T, *sample.states)
    return LandmarkFit(
        kernel=K,
        landmarks=landmarks,
        sums=stream_sums.start(seen, T, sample.count, regularization),
        trace=jnp.zeros((), T.dtype),
        count=jnp.zeros((), int),
        regularization=regularization,
        dimension=sample.dimension,
        tolerance=tolerance,
    )


@eqx.filter_jit
def _with_data(fit, X, Y, spread):
    K = fit.kernel
    new = (
        stream_sums.add(fit.sums, Columns(K, fit.landmarks), X, Y, spread),
        fit.trace + trace(K, X, spread),
        fit.count + len(X),
    )
    return eqx.tree_at(lambda f: (f.sums, f.trace, f.count), fit, new)


@eqx.filter_jit
def _solution(fit, count, regularization):
    ridge = count.astype(regularization.dtype) * regularization
    weights, norm, residual_norm = stream_sums.solve(fit.sums, ridge)
    return Solution(
        coefficients=weights,
        residual=jnp.zeros((0, fit.dimension), weights.dtype),
        norm=norm,
        truncation=truncated(fit.trace, stream_sums.trace(fit.sums), ridge),
        residual_norm=residual_norm,
    )
