"""The exact fit by conjugate gradients: products with the Gram only, O((N + m) n + r²) memory.

The unknown is the residual of the fit, c = y − f(X) = Nλ a, so the system is (I + G/ρ) c = y with
ρ = Nλ: both sides are in units of y. The preconditioner is the inverse for the low-rank Gram
Ĝ = F Fᵀ of a Nyström fit,

    (I + Ĝ/ρ)⁻¹ = I − F (FᵀF + ρI)⁻¹ Fᵀ,

whose F = G_XS T is applied as a product with the Gram, so that it needs no memory of its own. If
trace(G − Ĝ) ≤ τρ the condition is at most 1 + τ and the iterations do not depend on N.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo, root
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.dense import trace
from hamkernel._gram.derivatives import constant
from hamkernel._gram.operator import product
from hamkernel._machine import as_given, rows_of, split
from hamkernel._solvers.base import AbstractSolver
from hamkernel._solvers.conditional import field_of_rows, gram_product, relative
from hamkernel._solvers.landmark_gram import Columns, checked, factor, truncated, whitening
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._solvers.spans import landmark_span
from hamkernel._solvers.stream_sums import normal

# Nλ in units of ε trace(G) below which a failure is one of rounding. On 87 points of an orbit they
# converged at 3e4 and did not at 3e2, where Cholesky left a residual of 4e-12.
_DIGITS = 1e4


class _Found(NamedTuple):
    learned: tuple[Array, Array, Array]  # coefficients, residual and norm
    iterations: Int[Array, ""]
    left: Float[Array, ""]  # the relative residual of the system
    truncation: Float[Array, ""]  # of the preconditioner


class ConjugateGradient(AbstractSolver[KernelField]):
    """The exact fit without the Gram: preconditioned conjugate gradients on its products.

    For N where the dense Gram does not fit in memory, and kernels for which `Nystrom` alone is not
    exact enough. Each iteration costs one product with the Gram, O(N² n). The result carries
    `field.info.iterations` and `.relative_residual`, computed anew at the end.

    Args:
        tolerance: the largest ‖y − (G + NλI)a‖/‖y‖, dimensionless; 1e-8 if None, and 1e-5 for data
            in float32.
        max_iterations: the largest number of iterations; the solve fails beyond it.
        preconditioner: the low-rank Gram that preconditions. Its tolerance may be large, since the
            condition is at most 1 + truncation; more landmarks mean fewer iterations.

    Raises:
        ValueError: an argument is not positive. TypeError: `max_iterations` is not whole, or the
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
        own = tolerance is not None
        self.tolerance = require.positive_number(tolerance, "tolerance") if own else None
        self.max_iterations = require.count(max_iterations, "max_iterations")
        if preconditioner is None:
            preconditioner = Nystrom(tolerance=10.0, max_points=256)
        if not isinstance(preconditioner, Nystrom):
            raise TypeError(
                f"the preconditioner must be an instance of hk.Nystrom, got {preconditioner!r}."
            )
        self.preconditioner = preconditioner

    def _fitted(self, problem, throw=True) -> KernelField:
        K, rows, ridge = problem.kernel, problem.rows, problem.ridge
        X, spread = rows.points, rows_of(rows.points)
        landmarks = self.preconditioner.landmarks(K, rows, problem.regularization)
        limits = landmarks, self._tolerance(rows.targets.dtype), self.max_iterations
        if problem.states is None:
            found = _solve_rows(K, rows, ridge, *limits)
        else:
            X, Y = (split(spread, each) for each in problem.states)
            found = _solve(K, X, Y, ridge, *limits, spread)
        (c, left, norm), info = self._converged(K, X, ridge, landmarks, found, throw)
        left = as_given(spread, rows.residual(left.reshape(-1)))
        return field_of_rows(K, rows, c.reshape(-1), left, norm, problem.regularization, info)

    def _tolerance(self, dtype: jnp.dtype) -> Float[Array, ""]:
        own = self.tolerance
        default = 1e-8 if dtype == jnp.float64 else 1e-5
        # As a Python float it would compile anew.
        return jnp.asarray(default if own is None else own, dtype)

    def _converged(self, K, X, ridge, landmarks, found: _Found, throw: bool):
        """What was learned, if the iterations converged, and how."""
        learned, iterations, left, truncation = found
        tolerance = self._tolerance(X.dtype)

        def message() -> str:
            reached = ""
            if require.is_concrete(left, iterations, truncation):
                cut = "" if truncation is None else f", truncation {float(truncation):.1e}"
                reached = (
                    f" after {int(iterations)} iterations: the relative residual is "
                    f"{float(left):.1e} and the tolerance {tolerance:.1e} "
                    f"({int(landmarks.count)} landmarks{cut})"
                )
                rounding = float(jnp.finfo(X.dtype).eps * trace(K, X, rows_of(X)))
                if ridge < _DIGITS * rounding:
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

        failed = ~(require.on_host(left) <= require.on_host(tolerance))
        info = SolverInfo(
            "ConjugateGradient",
            landmarks=landmarks.count,
            rank=landmarks.kept.sum(),
            truncation=truncation,
            iterations=iterations,
            relative_residual=left,
        )
        return checked(learned, landmarks, truncation, failed, message, throw), info


@eqx.filter_jit
def _solve(K, X, Y, ridge, landmarks, tolerance, max_iterations, spread):
    S = landmarks.points
    # The preconditioner changes how fast the answer is found, not the answer.
    K_, X_, S_, ridge_, marks = constant((K, X, S, ridge, landmarks))
    T = whitening(K_, marks)
    square = normal(Columns(K_, marks), T, X_, jnp.zeros_like(Y), spread).square
    R = factor(square, ridge_)

    def preconditioned(c):
        moment = T.T @ product(K_, S_, X_, c, None, spread).reshape(-1)
        w = jax.scipy.linalg.cho_solve((R, True), moment)
        return c - product(K_, X_, S_, (T @ w).reshape(len(S), -1), spread)

    def gram(c):
        return product(K, X, X, c, spread, spread)

    truncation = truncated(trace(K_, X_, spread), jnp.trace(square), ridge_)
    return _iterated(gram, preconditioned, Y, ridge, tolerance, max_iterations, truncation)


@eqx.filter_jit
def _solve_rows(K, rows, ridge, landmarks, tolerance, max_iterations):
    """`_solve` of rows of observations, whose product is that of their field with their rows."""
    y = rows.y
    K_, rows_, ridge_ = constant((K, rows, ridge))
    span = landmark_span(K_, landmarks)
    all_rows = span.of_rows(rows_)
    truncation, F = span.truncation(rows_, all_rows, ridge_), rows_.contrast(all_rows)
    R = factor(F.T @ F, ridge_)

    def gram(c):
        return gram_product(K, rows, c)

    def preconditioned(c):
        return c - F @ jax.scipy.linalg.cho_solve((R, True), F.T @ c)

    return _iterated(gram, preconditioned, y, ridge, tolerance, max_iterations, truncation)


def _iterated(gram, preconditioned, y, ridge, tolerance, max_iterations, truncation) -> _Found:
    """The solution of (I + G/ridge) c = y."""
    structure = jax.ShapeDtypeStruct(y.shape, y.dtype)
    positive = lx.positive_semidefinite_tag
    system = lx.FunctionLinearOperator(lambda c: c + gram(c) / ridge, structure, positive)
    preconditioner = lx.FunctionLinearOperator(preconditioned, structure, positive)
    # lineax asks of the change of c what it asks of the residual; both are in units of y. Half of
    # the tolerance leaves room for what the recursion of the residual rounds off.
    scale = jnp.linalg.norm(jax.lax.stop_gradient(y))
    solver = lx.CG(
        rtol=0.0,
        atol=0.5 * tolerance * scale,
        norm=jnp.linalg.norm,
        stabilise_every=None,
        max_steps=max_iterations,
    )
    options = {"preconditioner": preconditioner}
    solution = lx.linear_solve(system, y, solver, options=options, throw=False)
    c = solution.value
    values = gram(c) / ridge  # f(X)
    norm = root(jnp.sum(c * values) / ridge)  # ‖f‖² = aᵀGa
    learned = c / ridge, y - values, norm
    return _Found(learned, solution.stats["num_steps"], relative(y - c - values, y), truncation)
