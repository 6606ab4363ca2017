"""Regularised least squares by a dense factorisation: (G + NλI) a = y."""

import abc

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._field import AbstractField, KernelField, SolverInfo
from hamkernel._gram import assemble
from hamkernel._structured import AbstractMatrixKernel


class AbstractSolver(eqx.Module):
    """How `fit` finds the field."""

    @abc.abstractmethod
    def fit(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
    ) -> AbstractField:
        """The field for data that has been checked."""


class Cholesky(AbstractSolver):
    """The dense Gram and its Cholesky factor: exact, O((N n)³) time and O((N n)²) memory."""

    def fit(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
    ) -> KernelField:
        A, residual, norm = _representer(K, X, Y, regularization)

        def message() -> str:
            known = require.is_concrete(regularization)
            number = f" = {len(X) * float(regularization):.3g}" if known else ""
            return (
                f"the Gram plus the ridge N * regularization{number} is not positive definite to "
                f"rounding in {X.dtype}. Likely causes, in order: the regularization is too small "
                "for this Gram (points that coincide or lie close together for the lengthscale "
                "make it singular): raise it; float32 where float64 is needed: "
                "jax.config.update('jax_enable_x64', True); a kernel that is not positive "
                "definite or not finite: hk.check_kernel(k, X) tells."
            )

        A = require.value(A, require.not_finite(A), message, RuntimeError)
        return KernelField(
            kernel=K,
            points=X,
            coefficients=A,
            residual=residual,
            norm=norm,
            regularization=regularization,
            offset=jnp.zeros((), X.dtype),
            info=SolverInfo("Cholesky"),
        )


@eqx.filter_jit
def _representer(K, X, Y, regularization):
    """Coefficients, residual y − Ga = Nλa, and the norm ‖f‖ with ‖f‖² = aᵀGa = aᵀ(y − Nλa)."""
    N, n = X.shape
    G = assemble(K, X, X).reshape(N * n, N * n)
    ridge = N * regularization
    A = solve_positive(G, ridge, Y.reshape(N * n)).reshape(N, n)
    residual = ridge * A
    square = jnp.sum(A * (Y - residual))
    return A, residual, jnp.sqrt(jnp.maximum(square, jnp.zeros_like(square)))


def solve_positive(
    G: Float[Array, "D D"], ridge: Float[Array, ""], y: Float[Array, " D"]
) -> Float[Array, " D"]:
    """(G + ridge I)⁻¹ y by Cholesky; NaN where the matrix is not positive definite.

    Differentiated implicitly, by one more solve with the same factor.
    """
    diagonal = jnp.arange(len(G))
    matrix = G.at[diagonal, diagonal].add(ridge)
    operator = lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)
    return lx.linear_solve(operator, y, lx.Cholesky(), throw=False).value
