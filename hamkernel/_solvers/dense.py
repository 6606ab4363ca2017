"""The exact fit by a dense factor of the Gram, and the posterior that keeps this factor.

Let c₁ and c₂ be the covariances of two linear functionals with the rows of the data. The covariance
of these functionals given the data is their prior covariance minus c₁ᵀ A⁻¹ c₂, with A = G + σ²I.
A prediction is a linear functional just as a measurement is: both are blocks of rows, and one
function computes every variance.

New rows extend the factor. If A = RᵀR, the factor of old and new rows is [[R, B], [0, S]] with
B = R⁻ᵀK₁₂ and SᵀS = K₂₂ + σ²I − BᵀB. The noise variance σ² of a row does not change.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo, map_states, root
from hamkernel._fields.expansions import KernelField, kernel_field
from hamkernel._gram import (
    between,
    gram_of_rows,
    plus_ridge,
    regularized_gram,
    rows_between,
    strips_of_gram,
)
from hamkernel._machine import dense_bytes, memory_bytes, precise_jit, refuse_beyond_memory
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.measurements import Measurements
from hamkernel._sizes import sizes
from hamkernel._solvers.factors import (
    ROWS_IN_PLACE,
    DenseFactor,
    backward,
    cholesky,
    factor_in_place,
    forward,
    solution,
)
from hamkernel._solvers.low_rank import Prior, prior_draws
from hamkernel._solvers.problem import AbstractConditional, AbstractSolver, Problem, check_field
from hamkernel._structures.base import AbstractMatrixKernel


class DenseConditional(AbstractConditional):
    """The posterior from the Cholesky factor of A; `representer` is c = A⁻¹y."""

    factor: DenseFactor
    representer: Float[Array, " D"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        whitened = self._whitened_covariance(left)
        whitened_right = whitened if right is left else self._whitened_covariance(right)
        return between(self.field.kernel, left, right) - whitened.T @ whitened_right

    def _whitened_covariance(self, block: AbstractBlock) -> Float[Array, "D d"]:
        """R⁻ᵀ c."""
        return self.factor.whiten(rows_between(self.field.kernel, self.rows, block))

    def update(self, new: Measurements) -> "DenseConditional":
        factor, c, field = _extend(self, new)
        rows = self.rows.append(new)
        field = _refuse_failure(field, require.not_finite(c).any(), rows.count)
        return DenseConditional(field, rows, self.ridge, factor, c)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> KernelField:
        before, noise = jax.random.split(key)
        prior = prior_draws(self.field.kernel, self.rows.points, region, before, count)
        return _condition_draws(self, prior, noise)


def copies(problem: Problem) -> int:
    """The number of matrices of the size of the Gram that a dense fit holds at its peak.

    A fit in place held 1.5 for all kernels. Other fits hold the Gram, its factor, the returned copy
    and strips of rows, together 3.4 (`test_the_peak_memory_of_a_dense_fit_is_what_is_planned`).
    """
    return 2 if _is_in_place(problem) else 4


def _is_in_place(problem: Problem) -> bool:
    """Whether the Gram is factored in its own memory, which is not possible under `jax.jit`."""
    D, least, memory = problem.rows.size, sizes().rows_in_place, memory_bytes()
    if least is None:
        fits = memory is None or dense_bytes(D, D, problem.rows.targets.dtype, 4) <= memory
    else:
        fits = D < least
    return not fits and problem.states is not None and require.is_concrete(problem)


def _solve(problem: Problem, throw: bool, progress: bool, keep: bool) -> Any:
    """Solve A c = y. Returns (factor, or None unless to `keep`, c, field).

    Raises:
        ValueError: the matrices do not fit in memory. RuntimeError, with `throw`: the factorisation
            failed.
    """
    K, rows, regularization = problem.kernel, problem.rows, problem.regularization
    D, dtype = rows.size, rows.targets.dtype
    cure = (
        "Use solver=hk.ConjugateGradient(), which is exact and has no error bars, or "
        "solver=hk.Nystrom(), which is faster and approximate to a stated tolerance."
    )
    refuse_beyond_memory(f"a dense fit of {D} rows", D, D, dtype, copies(problem), cure)
    if _is_in_place(problem):
        factor = factor_in_place(*_assemble(K, rows, problem.ridge, progress))
        c, field = _solve_with_factor(K, rows, regularization, factor)
    else:
        factor, c, field = _solve_in_memory(K, rows, regularization, keep)
    # The relative error of the fitted values was 1 to 10 times ‖y − (G + σ²I)c‖/‖y‖, at every
    # accuracy.
    failed = ~(require.host_array(field.info.relative_residual) <= 1e-2)
    return factor, c, _refuse_failure(field, failed, rows.count, throw)


def _assemble(K, rows: Measurements, ridge, progress: bool):
    """A, computed in slabs of rows, and the progress bar of its factorisation."""
    from tqdm import tqdm  # so that importing the package does not load it

    off = None if progress else True
    points, n = rows.points, rows.dimension
    A, slab = jnp.zeros((rows.size, rows.size), rows.targets.dtype), -(-ROWS_IN_PLACE // n)
    for first in tqdm(range(0, len(points), slab), "Gram", disable=off):
        start = jnp.asarray(min(first, len(points) - slab))
        A = jax.block_until_ready(_slab((K, points, ridge, start, slab), A))
    return A, lambda blocks: tqdm(blocks, "factor", disable=off)


_slab = precise_jit(strips_of_gram, donate="all-except-first")


@precise_jit
def _solve_in_memory(K, rows: Measurements, regularization, keep: bool):
    ridge = rows.count * regularization
    factor, c = solution(regularized_gram(K, rows, ridge), rows.y)
    return factor if keep else None, c, _field_of(K, rows, regularization, c)


@precise_jit
def _solve_with_factor(K, rows: Measurements, regularization, factor: DenseFactor):
    c = factor.solve(rows.y)
    return c, _field_of(K, rows, regularization, c)


def _field_of(K, rows: Measurements, regularization, c) -> KernelField:
    """The field of the coefficients c, with the relative residual ‖y − (G + σ²I)c‖/‖y‖."""
    y, ridge = rows.y, rows.count * regularization
    values = gram_product(K, rows, c)  # without the Gram, which the factor has overwritten
    relative_residual = relative_error(y - values - ridge * c, y)
    residual, norm = rows.residual(ridge * c), norm_of(c @ values, c @ (y - values - ridge * c))
    info = SolverInfo("Cholesky", relative_residual=relative_residual)
    return kernel_field(K, rows.coefficients(c), residual, norm, regularization, info)


def norm_of(square: Float[Array, ""], error: Float[Array, ""]) -> Float[Array, ""]:
    """The norm √(cᵀGc) of the field; NaN if rounding may be a tenth of cᵀGc or more.

    cᵀGc may be a small difference of large numbers. With the residual r = y − Ac,
    cᵀGc = cᵀ(y − σ²c) − cᵀr, so the residual changes the form by cᵀr.

    Args:
        square: cᵀGc, as computed.
        error: an estimate of the error of `square`, such as cᵀr with the residual r of A c = y.
    """
    inaccurate = ~(jnp.abs(jax.lax.stop_gradient(error)) <= 0.1 * square) & (square != 0)
    return jnp.where(inaccurate, jnp.nan, root(square)).astype(square.dtype)


def relative_error(error: Array, reference: Array) -> Float[Array, ""]:
    """The relative error ‖error‖/‖reference‖, or ‖error‖ if the reference is zero.

    Gradients are stopped.
    """
    error, reference = jax.lax.stop_gradient((error, reference))
    scale = jnp.linalg.norm(reference)
    return jnp.linalg.norm(error) / jnp.where(scale > 0, scale, jnp.ones_like(scale))


@precise_jit
def _extend(old: DenseConditional, new: Measurements):
    K, R, rows = old.field.kernel, old.factor.R, old.rows.append(new)
    # A contrast of a new energy is a difference with the old energies, so their rows are needed
    # too.
    extended_rows, new_count = old.rows.with_previous(new), rows.size - old.rows.size
    across = [rows_between(K, old.rows, block) for block in extended_rows.blocks]
    across = extended_rows.contrast(jnp.concatenate(across, axis=1).T)[-new_count:]
    across = across.T  # (D, new_count)
    B = old.factor.whiten(across)
    G = gram_of_rows(K, extended_rows)[-new_count:, -new_count:]
    D, S = len(R), cholesky(plus_ridge(G, old.ridge) - B.T @ B)
    # Writing the blocks into zeros takes a quarter of the time of `jnp.block`.
    above = jnp.zeros((D + new_count,) * 2, R.dtype).at[:D, :D].set(R).at[:D, D:].set(B)
    R = above.at[D:, D:].set(S)
    factor = eqx.tree_at(lambda f: f.R, old.factor, R)
    y = rows.y
    # Block elimination: (SᵀS) c₂ = y₂ − K₂₁ c with the old coefficients c = A⁻¹y₁, which then
    # become c₁ = c − A⁻¹K₁₂ c₂ = c − R⁻¹B c₂.
    last = backward(S, forward(S, (y[D:] - across.T @ old.representer)[:, None]))
    first = old.representer - backward(old.factor.R, B @ last)[:, 0]
    c = jnp.concatenate([first, last[:, 0]])
    regularization = old.ridge / rows.count
    rounding = jnp.finfo(c.dtype).eps * jnp.linalg.norm(c) * jnp.linalg.norm(y)
    residual = rows.residual(old.ridge * c)
    norm = norm_of(c @ (y - old.ridge * c), rounding.astype(c.dtype))
    info = SolverInfo("Cholesky")
    return factor, c, kernel_field(K, rows.coefficients(c), residual, norm, regularization, info)


@precise_jit
def _condition_draws(conditional: DenseConditional, prior: Prior, key) -> KernelField:
    """The draws of the posterior, from draws of the prior by Matheron's rule (`low_rank.py`)."""
    rows = conditional.rows
    prior_rows = prior.rows(rows)  # (D, count)
    noise = jnp.sqrt(conditional.ridge) * jax.random.normal(key, prior_rows.shape, prior_rows.dtype)
    c = conditional.factor.solve(rows.y[:, None] - prior_rows - noise)
    Z, A, S, b = jax.vmap(rows.coefficients, out_axes=(None, 0, None, 0))(c.T)
    return prior.plus(Z, A, S, b) if len(S) else prior.plus(Z, A)


def gram_product(
    K: AbstractMatrixKernel, rows: Measurements, c: Float[Array, " D"]
) -> Float[Array, " D"]:
    """G c, computed as the rows of the field with coefficients c, without forming G."""
    zero = jnp.zeros((), c.dtype)
    field = kernel_field(K, rows.coefficients(c), c, zero, zero, SolverInfo("none"))
    potential = jax.tree_util.Partial(map_states, field._learned_potential)
    return rows.contrast(rows.evaluate(field._velocities, potential))


def _refuse_failure(field: KernelField, failed: Any, N: int, throw: bool = True) -> KernelField:
    """The field; RuntimeError, or NaN without `throw`, if the factorisation `failed`."""
    regularization, relative_residual = field.regularization, field.info.relative_residual

    def message() -> str:
        is_known = require.is_concrete(regularization, relative_residual)
        number = f" = {N * float(regularization):.3g}" if is_known else ""
        share = ""
        if is_known and relative_residual is not None and jnp.isfinite(relative_residual):
            share = f" (its solution leaves a relative residual of {relative_residual:.2g})"
        return (
            f"the Gram plus the ridge N * regularization{number} is not positive definite to "
            f"rounding in {regularization.dtype}{share}. Likely causes, in order: the "
            "regularization is too small for this Gram (points that coincide or lie close together "
            "for the lengthscale make it singular): raise it; noise levels that are too different; "
            "float32 where float64 is needed: jax.config.update('jax_enable_x64', True); a kernel "
            "that is not positive definite or not finite: hk.check_kernel(k, X) finds out."
        )

    return check_field(field, failed, message, throw)


class Cholesky(AbstractSolver[KernelField]):
    """The solver by a Cholesky factor of the dense Gram: exact, O((N n)³) time, O((N n)²) memory.

    `field.info.relative_residual` is ‖y − (G + NλI)a‖/‖y‖, which is not zero because of rounding. A
    fit with a relative residual above one per cent raises a RuntimeError.

    Raises:
        ValueError, from `fit`: the matrices do not fit in memory. RuntimeError, from `fit`: the
            ridge is too small for this Gram (the text says what to do).
    """

    def fit(self, problem, throw=True, progress=False) -> KernelField:
        return _solve(problem.to_one_device(), throw, progress, keep=False)[2]

    def condition(self, problem, throw=True, progress=False) -> DenseConditional:
        problem = problem.to_one_device()
        factor, c, field = _solve(problem, throw, progress, keep=True)
        return DenseConditional(field, problem.rows, problem.ridge, factor, c)
