"""Validation losses in closed form, each at the price of one factorisation."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel._machine import one_blas_thread, refuse_beyond_memory
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.problem import problem
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._validation.folds import Folds
from hamkernel._validation.of_rows import (
    generalized_loss,
    held_out_rows,
    log_likelihood,
    partition_loss,
    partition_of_rows,
)


@one_blas_thread
def cross_validation_loss(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    folds: Folds = 5,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """The mean over folds of the mean squared error of a fit that has not seen the fold.

    The mean squared error is itself the mean over the fold's points and components. Exact: equal
    to refitting without each fold, with the ridge that such a fit has, (N − N/F) λ for F folds.
    With folds of unequal size every refit has this same ridge, that of the average fold.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.
        folds: a number of folds, made of consecutive points as equal in size as possible; "loo"
            for one point per fold; or an integer label for each point, shape (N,), to hold out,
            say, one trajectory at a time. A fold always holds out whole points: leaving out
            single components would leak their siblings. Labels must be concrete under jit. Of
            observations N is the number of all: points, energies, functionals, in their order. A
            fold with all energies is compared up to their constant.
        inputs: of a `Controlled` kernel, shape (N, m).
        parameters: of a `Family`, shape (N, p).

    Returns:
        The loss, in squared units of Y, and of observations in those of the rows over their
        relative noise; inf where the matrix is not positive definite to rounding. Differentiable
        in reverse mode: `jax.jacrev(jax.grad(loss))` is the Hessian, for there is no `jax.jvp`.
        Vmappable, compiled once per shape and partition. O((N n)³) time,
        three matrices of (N n)² numbers, with the gradient over K too.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data, folds, or regularization, or
            matrices that do not fit in memory.
    """
    K, rows, regularization = _checked_problem(K, X, Y, regularization, inputs, parameters)
    return partition_loss(K, rows, regularization, partition_of_rows(rows, folds))


@one_blas_thread
def cross_validation_residuals(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    folds: Folds = 5,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, "N n"]:
    """The residual yᵢ − f(xᵢ) of each point under the fit that has not seen its fold.

    Args and errors are those of `cross_validation_loss`, which is the mean over folds of their mean
    squares: with unequal folds not the mean of all squares.

    Returns:
        Shape (N, n), in units of Y; of observations one for each row, in its units; inf where the
        matrix is not positive definite to rounding.
    """
    K, rows, regularization = _checked_problem(K, X, Y, regularization, inputs, parameters)
    left = held_out_rows(K, rows, regularization, partition_of_rows(rows, folds))[0]
    return rows.in_units(left)


@one_blas_thread
def generalized_cross_validation(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """Generalised cross-validation: the training error over the squared share of free residuals.

    With the smoother y -> Sy, S = G A⁻¹, and D = N n rows, it is (‖y − Sy‖²/D) / (tr(I − S)/D)²
    = D ‖a‖² / (tr A⁻¹)². It needs no folds and does not depend on the order of the data, and is
    leave-one-out with every leverage replaced by the mean one. For independent noise.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.
        inputs: of a `Controlled` kernel, shape (N, m).
        parameters: of a `Family`, shape (N, p).

    Returns:
        The loss, in squared units of Y; inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Golub, Heath & Wahba (1979), Technometrics 21.
    """
    return generalized_loss(*_checked_problem(K, X, Y, regularization, inputs, parameters))


@one_blas_thread
def log_marginal_likelihood(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """The log density of Y under f ~ GP(0, K) and independent noise of variance Nλ.

    −½ yᵀA⁻¹y − ½ log det A − ½ N n log 2π with A = G + NλI. The best objective when the model is
    believed (the truth resembles a draw of the prior); cross-validation trusts it less. A kernel of
    a descriptor, `Warp(k, fn)`, may have directions along which no field of it points, such as
    translations of a molecule: the density is that of the components of Y along all others.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0; the noise variance is Nλ.
        inputs: of a `Controlled` kernel, shape (N, m).
        parameters: of a `Family`, shape (N, p).

    Returns:
        The log density; −inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Rasmussen & Williams (2006), eq. 2.30.
    """
    return log_likelihood(*_checked_problem(K, X, Y, regularization, inputs, parameters))


def _checked_problem(
    K, X, Y, regularization, inputs, parameters
) -> tuple[Any, Measurements, Float[Array, ""]]:
    """Kernel, rows and λ."""
    # LAPACK on every device at once was seen to stall, see `_solvers/factors.py`.
    given = problem(K, X, Y, regularization, inputs=inputs, parameters=parameters).on_one_device()
    check_memory(given.rows, LOSS_COPIES)
    return given.kernel, given.rows, given.regularization


LOSS_COPIES = 3  # matrices of the size of the Gram that a loss holds, with its gradient


def check_memory(rows: Measurements, copies: int) -> None:
    """Refuse a dense loss that does not fit in memory."""
    M = len(rows.targets)
    cure = (
        "Use hk.tune(..., solver=hk.Nystrom()) or solver=hk.RandomFeatures(count, key), whose loss "
        "is of low rank too, or a part of the data."
    )
    refuse_beyond_memory(f"the loss of {M} rows", M, M, rows.targets.dtype, copies, cure)
