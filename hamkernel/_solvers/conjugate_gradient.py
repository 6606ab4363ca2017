"""The exact fit by conjugate gradients, from products with the Gram: O((N + m) n + r²) memory.

The unknown is the residual of the fit, c = y − f(X) = ρ a with ρ = Nλ. The system is (I + G/ρ) c =
y, with both sides in units of y. The preconditioner is the inverse for the low-rank Gram Ĝ = F Fᵀ
of a Nyström fit,

    (I + Ĝ/ρ)⁻¹ = I − F (FᵀF + ρI)⁻¹ Fᵀ,

where F = G_XS T is applied as a product with the Gram and never stored. If trace(G − Ĝ) ≤ τρ, the
condition number is at most 1 + τ and the number of iterations does not depend on N.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.expansions import KernelField, kernel_field
from hamkernel._gram import gram_rounding, stop_gradients, trace
from hamkernel._gram_operator import product
from hamkernel._machine import precise_jit, row_sharding, shard
from hamkernel._solvers.dense import gram_product, norm_of, relative_error
from hamkernel._solvers.landmarks import whitening
from hamkernel._solvers.least_squares import normal
from hamkernel._solvers.low_rank import (
    Columns,
    check_low_rank,
    factor,
    landmark_span,
    truncation_of,
)
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._solvers.problem import AbstractSolver


class _Solution(NamedTuple):
    learned: tuple[Array, Array, Array]  # coefficients, residual and norm
    iterations: Int[Array, ""]
    relative_residual: Float[Array, ""]  # the relative residual of the system
    truncation: Float[Array, ""]  # of the preconditioner


class ConjugateGradient(AbstractSolver[KernelField]):
    """The solver of the exact fit by preconditioned conjugate gradients, without a stored Gram.

    Use this solver if the dense Gram does not fit in memory and `Nystrom` alone is not exact
    enough. Each iteration takes one product with the Gram, O(N² n) time. `field.info` has the
    number of `iterations` and the `relative_residual`, which is computed at the end.

    Args:
        tolerance: the largest ‖y − (G + NλI)a‖/‖y‖, dimensionless; 1e-8 if None, and 1e-5 for data
            in float32.
        max_iterations: the largest number of iterations, after which the solve fails.
        preconditioner: the `Nystrom` solver whose low-rank Gram is the preconditioner. The
            condition number is at most 1 + truncation, so its tolerance may be large; more
            landmarks mean fewer iterations.

    Raises:
        ValueError: an argument is not positive. TypeError: `max_iterations` is no integer, or the
            preconditioner no `Nystrom`. RuntimeError, from `fit`: no convergence (the text says
            what to do).

    Source: Frangella, Tropp & Udell (2023) for the preconditioner; Díaz et al. (2023),
        arXiv 2304.12465, for randomly pivoted Cholesky in it.
    """

    no_factor: ClassVar[str | None] = (
        "conjugate gradients find a field and keep no factor, so they cannot say how far it may be "
        "off. Use hk.condition(..., solver=hk.Cholesky()), which is exact, or solver=hk.Nystrom(), "
        "whose factor is small; for the field alone hk.fit."
    )
    tolerance: float | None = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)
    preconditioner: Nystrom

    def __init__(
        self,
        tolerance: float | None = None,
        max_iterations: int = 100,
        preconditioner: Nystrom | None = None,
    ):
        has_tolerance = tolerance is not None
        self.tolerance = require.positive_number(tolerance, "tolerance") if has_tolerance else None
        self.max_iterations = require.count(max_iterations, "max_iterations")
        if preconditioner is None:
            preconditioner = Nystrom(tolerance=10.0, max_points=256)
        if not isinstance(preconditioner, Nystrom):
            raise TypeError(
                f"the preconditioner must be an instance of hk.Nystrom, got {preconditioner!r}."
            )
        self.preconditioner = preconditioner

    def fit(self, problem, throw=True, progress=False) -> KernelField:
        if problem.states is None:
            problem = problem.to_one_device()
        K, rows, ridge = problem.kernel, problem.rows, problem.ridge
        X, spread = rows.points, row_sharding(rows.points)
        landmarks = self.preconditioner.landmarks(K, rows, problem.regularization)
        limits = self._tolerance(rows.targets.dtype), self.max_iterations
        is_shown = progress and require.is_concrete(K, rows, ridge)
        prepare: Callable[..., tuple[Products, Array]]
        if problem.states is None:
            prepare, args, y = _prepare_rows, (K, rows, ridge, landmarks), rows.y
        else:
            X, y = (shard(spread, array) for array in problem.states)
            prepare, args = _prepare_velocities, (K, X, ridge, landmarks, spread)
        with _progress_bar(is_shown, self.max_iterations):
            result = _solve(prepare, args, y, ridge, *limits, is_shown)
        (c, residual, norm), iterations, relative_residual, truncation = result
        info = SolverInfo(
            "ConjugateGradient",
            landmarks=landmarks.count,
            rank=landmarks.kept.sum(),
            truncation=truncation,
            iterations=iterations,
            relative_residual=relative_residual,
        )
        residual, representer = (
            rows.residual(residual.reshape(-1)),
            rows.coefficients(c.reshape(-1)),
        )
        field = kernel_field(K, representer, residual, norm, problem.regularization, info)
        return self._check_convergence(field, X, ridge, throw)

    def _tolerance(self, dtype: jnp.dtype) -> Float[Array, ""]:
        tolerance = self.tolerance
        default = 1e-8 if dtype == jnp.float64 else 1e-5
        # As an array: every new Python float would compile a new program.
        return jnp.asarray(default if tolerance is None else tolerance, dtype)

    def _check_convergence(self, field: KernelField, X, ridge, throw: bool) -> KernelField:
        """The field; RuntimeError without convergence, or NaN without `throw`."""
        info, tolerance = field.info, self._tolerance(X.dtype)
        iterations, relative_residual = info.iterations, info.relative_residual
        truncation = info.truncation
        assert iterations is not None
        assert relative_residual is not None

        def message() -> str:
            reached = ""
            if require.is_concrete(relative_residual, iterations, truncation):
                reached = (
                    f" after {int(iterations)} iterations: the relative residual is "
                    f"{float(relative_residual):.1e} and the tolerance {tolerance:.1e} "
                    f"({info.landmarks} landmarks, truncation {truncation:.1e})"
                )
                rounding = float(gram_rounding(trace(field.kernel, X, row_sharding(X))))
                # On 87 points of an orbit the iterations converged for a ridge of 3e4 times the
                # rounding, not for 3e2, where Cholesky left a residual of 4e-12.
                if ridge < 1e4 * rounding:
                    return (
                        f"conjugate gradients did not converge{reached}: the ridge N λ = "
                        f"{float(ridge):.2g} is {float(ridge) / rounding:.2g} times the rounding "
                        "of the Gram, ε trace(G), and products with the Gram then have too few "
                        "digits for them. Use solver=hk.Cholesky(), which needs fewer, or raise "
                        "the regularization."
                    )
            more = "a larger tolerance"
            if not require.is_concrete(iterations) or iterations >= self.max_iterations:
                more = f"max_iterations or {more}"
            return (
                f"conjugate gradients did not converge{reached}. Raise the regularization; give "
                "the preconditioner more landmarks, hk.ConjugateGradient(preconditioner="
                f"hk.Nystrom(tolerance=1.0, max_points=1000)); allow more with {more}. In float32 "
                "a tolerance below 1e-5 is out of reach, and a small regularization is lost in "
                "rounding: jax.config.update('jax_enable_x64', True). With 0 landmarks or a "
                "residual that is NaN the kernel is at fault: hk.check_kernel(k, X) finds out."
            )

        failed = ~(require.host_array(relative_residual) <= require.host_array(tolerance))
        return check_low_rank(field, throw, failed, message)


class Products(NamedTuple):
    """Products with the Gram and with the inverse of the low-rank Gram that preconditions.

    The preconditioner changes the number of iterations, not the solution, so we do not
    differentiate the preconditioner.

    Attributes:
        gram: c -> G c.
        precondition: c -> (I + Ĝ/ρ)⁻¹ c.
    """

    gram: Callable[[Array], Array]
    precondition: Callable[[Array], Array]


def _prepare_velocities(K, X, ridge, landmarks, spread):
    """The products for velocities alone, and the truncation of the preconditioner."""
    K_, X_, ridge_, marks = stop_gradients((K, X, ridge, landmarks))
    T, nothing = whitening(K_, marks), jnp.zeros((len(X), K.outputs(X.shape[1])), X.dtype)
    square = normal(Columns(K_, marks), T, X_, nothing, spread).square
    fixed = K_, X_, marks.points, T, factor(square, ridge_)
    inverse = Partial(_precondition_velocities, *fixed, spread=spread)
    gram = Partial(product, K, X, X, X_rows=spread, Z_rows=spread)
    truncation = truncation_of(trace(K_, X_, spread), jnp.trace(square), ridge_)
    return Products(gram, inverse), truncation


def _precondition_velocities(K, X, S, T, R, c, spread):
    moment = T.T @ product(K, S, X, c, None, spread).reshape(-1)
    w = jax.scipy.linalg.cho_solve((R, True), moment)
    return c - product(K, X, S, (T @ w).reshape(len(S), -1), spread)


def _prepare_rows(K, rows, ridge, landmarks):
    """The products for rows of any observations, and the truncation of the preconditioner."""
    K_, rows_, ridge_, marks = stop_gradients((K, rows, ridge, landmarks))
    span = landmark_span(K_, marks)
    all_rows = span.all_rows(rows_)
    F = rows_.contrast(all_rows)
    truncation = span.truncation(rows_, all_rows, ridge_)
    inverse = Partial(_precondition_rows, F, factor(F.T @ F, ridge_))
    return Products(Partial(gram_product, K, rows), inverse), truncation


def _precondition_rows(F, R, c):
    return c - F @ jax.scipy.linalg.cho_solve((R, True), F.T @ c)


_bars: list[Any] = []  # the progress bars of the running solves; the last one moves


@contextlib.contextmanager
def _progress_bar(is_shown: bool, max_iterations: int) -> Iterator[None]:
    """Show a progress bar that `_advance` moves until all residuals have been computed."""
    if not is_shown:
        yield
        return
    from tqdm import tqdm  # so that importing the package does not load it

    # One more than the iterations: the residual of c = 0 comes first.
    with tqdm(total=max_iterations + 1, desc="conjugate gradients", disable=None) as bar:
        _bars.append(bar)
        try:
            yield
            jax.effects_barrier()
        finally:
            _bars.remove(bar)


def _advance(relative_residual: Float[np.ndarray, ""]) -> None:
    for bar in _bars[-1:]:
        bar.set_postfix_str(f"residual {float(relative_residual):.1e}", refresh=False)
        bar.update()


@precise_jit
def _solve(prepare, args, y, ridge, tolerance, max_iterations, progress=False) -> _Solution:
    """The solution of (I + G/ridge) c = y; its derivatives solve with the same system."""
    products, truncation = prepare(*args)

    # lineax calls a step singular if pᵀAp ≤ 100 D ε rᵀMr, for D numbers in y and the preconditioner
    # M. Since A ≥ M⁻¹, the left side is at least rᵀMr, which is too little for D > 84 000 in
    # float32. A scale s of M changes no iterate; it multiplies the left side by s², the right by s.
    scale = 2.0 ** math.ceil(math.log2(1 + 200 * y.size * jnp.finfo(y.dtype).eps))

    def precondition(residual):  # called once for the residual of each iterate
        if progress:
            jax.debug.callback(_advance, relative_error(residual, y))
        return scale * products.precondition(residual)

    structure, tag = jax.eval_shape(lambda: y), lx.positive_semidefinite_tag
    system = lx.FunctionLinearOperator(lambda c: c + products.gram(c) / ridge, structure, tag)
    inverse = lx.FunctionLinearOperator(precondition, structure, tag)
    # Half of the tolerance allows for the rounding errors of the recursion for the residual.
    size = jnp.linalg.norm(jax.lax.stop_gradient(y))
    solver = lx.CG(0.0, tolerance / 2 * size, jnp.linalg.norm, None, max_iterations)
    options = {"preconditioner": inverse}
    solution = lx.linear_solve(system, y, solver, options=options, throw=False)
    c = solution.value
    # c = ρa, so f(X) = Ga = Gc/ρ and ‖f‖² = aᵀGa = c·f(X)/ρ. With the residual r = y − c − f(X) of
    # the system, aᵀr = cᵀr/ρ estimates the error of ‖f‖², as in `norm_of`.
    values = products.gram(c) / ridge
    norm = norm_of(jnp.sum(c * values) / ridge, jnp.sum(c * (y - c - values)) / ridge)
    learned = c / ridge, y - values, norm
    iterations, error = solution.stats["num_steps"], relative_error(y - c - values, y)
    return _Solution(learned, iterations, error, truncation)
