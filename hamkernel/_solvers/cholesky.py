"""Regularised least squares by a dense factorisation: (G + NλI) a = y."""

import abc
from typing import ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._factors.dense import DenseFactor
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.dense import assemble, plus_ridge
from hamkernel._gram.operator import product
from hamkernel._machine.devices import on_one_device
from hamkernel._machine.memory import refuse_beyond_memory
from hamkernel._observations.rows import Rows
from hamkernel._solvers.conditional import AbstractConditional, dense_conditional
from hamkernel._solvers.spans import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel

Learned = TypeVar("Learned", bound=AbstractField, covariant=True)


class AbstractSolver(eqx.Module, Generic[Learned]):
    """How `fit` finds the field."""

    no_factor: ClassVar[str | None] = None  # why it cannot say how far the field may be off
    is_low_rank: ClassVar[bool] = False  # whether `tune` is to judge by the loss in its `_basis`

    def _basis(
        self, K: AbstractMatrixKernel, X: Float[Array, "N n"], regularization: Float[Array, ""]
    ) -> AbstractBasis | None:
        """The features of a fit of low rank, as functions of the hyperparameters."""
        del K, X, regularization
        return None

    @abc.abstractmethod
    def _fitted(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> Learned:
        """The field for data that has been checked; of NaN if it fails and does not `throw`."""

    def _given(
        self,
        K: AbstractMatrixKernel,
        rows: Rows,
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> AbstractConditional:
        """The field given any observations, with what the solver keeps of them."""
        del K, rows, regularization, throw
        raise TypeError(f"{type(self).__name__} learns from velocities X and Y alone.")


# ‖y − (G + NλI)a‖/‖y‖ up to which a factorisation counts as a solution. The fitted values were
# measured to be wrong by 1 to 10 times this number, from full accuracy down to none.
_SOLVED = 1e-2


# Matrices of the size of the Gram that a dense fit holds: Gram, Gram with ridge, factor.
COPIES = 3


class Cholesky(AbstractSolver[KernelField]):
    """The dense Gram and its Cholesky factor: exact, O((N n)³) time and O((N n)²) memory.

    `field.info.relative_residual` is the error that rounding leaves in the linear system; a fit in
    which it is more than one per cent of the velocities is refused.

    Raises:
        ValueError, from `fit`: the matrices do not fit in memory. RuntimeError, from `fit`: the
            ridge is too small for this Gram (the text says what to do).
    """

    def _fitted(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> KernelField:
        _check_memory(X)
        X, Y = on_one_device("X", X), on_one_device("Y", Y)
        A, residual, norm, left, zero = _representer(K, X, Y, regularization)

        def message() -> str:
            known = require.is_concrete(regularization, left)
            number = f" = {len(X) * float(regularization):.3g}" if known else ""
            solved = known and jnp.isfinite(left)
            share = f" (its solution leaves a relative residual of {left:.2g})" if solved else ""
            return (
                f"the Gram plus the ridge N * regularization{number} is not positive definite to "
                f"rounding in {X.dtype}{share}. Likely causes, in order: the regularization is too "
                "small for this Gram (points that coincide or lie close together for the "
                "lengthscale make it singular): raise it; float32 where float64 is needed: "
                "jax.config.update('jax_enable_x64', True); a kernel that is not positive "
                "definite or not finite: hk.check_kernel(k, X) finds out."
            )

        failed = ~(require.on_host(left) <= _SOLVED)
        learned = A, residual, norm
        A, residual, norm = require.value(learned, failed, message, RuntimeError, throw)
        return KernelField(
            kernel=K,
            points=X,
            coefficients=A,
            residual=residual,
            norm=norm,
            regularization=regularization,
            offset=zero,
            info=SolverInfo("Cholesky", relative_residual=left),
        )

    def _given(
        self,
        K: AbstractMatrixKernel,
        rows: Rows,
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> AbstractConditional:
        return dense_conditional(K, rows, regularization, throw)


def _check_memory(X: Float[Array, "N n"]) -> None:
    cure = (
        "Use solver=hk.ConjugateGradient(), which is exact, or solver=hk.Nystrom(), which is "
        "faster and approximate to a stated tolerance."
    )
    what = f"a dense fit of N = {len(X)} points with n = {X.shape[1]} coordinates"
    refuse_beyond_memory(what, X.size, X.size, X.dtype, COPIES, cure)


@eqx.filter_jit
def _representer(K, X, Y, regularization):
    """Coefficients, residual y − Ga = Nλa, the norm with ‖f‖² = aᵀGa, the relative residual, 0."""
    N, n = Y.shape
    G = assemble(K, X, X).reshape(N * n, N * n)
    ridge = N * regularization
    A = solve_positive(G, ridge, Y.reshape(N * n)).reshape(N, n)
    values = product(K, X, X, A)  # without the Gram, which the factor has overwritten
    residual = ridge * A
    left = relative(Y - values - residual, Y)
    return A, residual, root(jnp.sum(A * values)), left, jnp.zeros((), X.dtype)


def relative(error: Array, of: Array) -> Float[Array, ""]:
    """‖error‖/‖of‖, and ‖error‖ where there is nothing to compare it with. Not differentiated."""
    error, of = jax.lax.stop_gradient((error, of))
    scale = jnp.linalg.norm(of)
    return jnp.linalg.norm(error) / jnp.where(scale > 0, scale, jnp.ones_like(scale))


def solve_positive(
    G: Float[Array, "D D"], ridge: Float[Array, ""], y: Float[Array, " D"]
) -> Float[Array, " D"]:
    """(G + ridge I)⁻¹ y by Cholesky; NaN where the matrix is not positive definite.

    Differentiated implicitly, by one more solve with the same factor.
    """
    A = plus_ridge(G, ridge)
    factor = DenseFactor(jax.lax.stop_gradient(A))
    solve = jax.lax.custom_linear_solve
    return solve(lambda x: A @ x, y, lambda _, b: factor.solve(b), symmetric=True)
