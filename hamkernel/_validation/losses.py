"""Validation losses in closed form, each at the price of one factorisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel._factors.base import AbstractSystem
from hamkernel._factors.dense import DenseSystem
from hamkernel._factors.low_rank import LowRankSystem
from hamkernel._gram.dense import assemble, plus_ridge
from hamkernel._gram.derivatives import trained
from hamkernel._machine.devices import on_one_device
from hamkernel._machine.memory import refuse_beyond_memory
from hamkernel._machine.threads import one_blas_thread
from hamkernel._observations.base import AbstractObservations
from hamkernel._observations.data import as_states
from hamkernel._observations.rows import Rows
from hamkernel._solvers.bases import AbstractBasis
from hamkernel._solvers.given import checked_rows, checked_states
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._validation.closed_forms import free_residuals, held_out, log_density
from hamkernel._validation.folds import Folds, Partition
from hamkernel._validation.observed import (
    rows_generalized_loss,
    rows_log_likelihood,
    rows_partition,
    rows_partition_loss,
    rows_residuals,
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
            observations N is the number of all: points, energies, functionals, in their order.
        inputs: of a `Controlled` kernel, shape (N, m).

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
    K, states, Y, rows, regularization = _checked(K, X, Y, regularization, inputs)
    if rows is not None:
        return rows_partition_loss(K, rows, regularization, rows_partition(rows, folds))
    return partition_loss(K, states, Y, regularization, Partition(len(states), folds))


@one_blas_thread
def cross_validation_residuals(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    folds: Folds = 5,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
) -> Float[Array, "N n"]:
    """The residual yᵢ − f(xᵢ) of each point under the fit that has not seen its fold.

    Args and errors are those of `cross_validation_loss`, which is the mean over folds of their mean
    squares: with unequal folds not the mean of all squares.

    Returns:
        Shape (N, n), in units of Y; of observations one for each row, in its units; inf where the
        matrix is not positive definite to rounding.
    """
    K, states, Y, rows, regularization = _checked(K, X, Y, regularization, inputs)
    if rows is not None:
        left = rows_residuals(K, rows, regularization, rows_partition(rows, folds))
        return rows.scale * left
    return _held_out(K, states, Y, regularization, Partition(len(states), folds))[0]


@one_blas_thread
def generalized_cross_validation(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
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

    Returns:
        The loss, in squared units of Y; inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Golub, Heath & Wahba (1979), Technometrics 21.
    """
    K, states, Y, rows, regularization = _checked(K, X, Y, regularization, inputs)
    if rows is not None:
        return rows_generalized_loss(K, rows, regularization)
    return generalized_loss(K, states, Y, regularization)


@one_blas_thread
def log_marginal_likelihood(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    inputs: Num[ArrayLike, "N m"] | None = None,
) -> Float[Array, ""]:
    """The log density of Y under f ~ GP(0, K) and independent noise of variance Nλ.

    −½ yᵀA⁻¹y − ½ log det A − ½ N n log 2π with A = G + NλI. The best objective when the model is
    believed (the truth resembles a draw of the prior); cross-validation trusts it less.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0; the noise variance is Nλ.
        inputs: of a `Controlled` kernel, shape (N, m).

    Returns:
        The log density; −inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Rasmussen & Williams (2006), eq. 2.30.
    """
    K, states, Y, rows, regularization = _checked(K, X, Y, regularization, inputs)
    if rows is not None:
        return rows_log_likelihood(K, rows, regularization)
    return log_likelihood(K, states, Y, regularization)


def _checked(K, X, Y, regularization, inputs) -> tuple[Any, Any, Any, Rows | None, Any]:
    """Kernel, X, Y, the rows of observations, and λ; states have no rows, and shorter losses."""
    K = matrix_kernel(K)
    X, Y, inputs = as_states(X, Y, inputs)
    if isinstance(X, AbstractObservations):
        K, rows, regularization, _ = checked_rows(K, X, Y, regularization)
        check_memory(rows.targets, LOSS_COPIES)
        return K, X, Y, rows, regularization
    K, X, Y, regularization, _ = checked_states(K, X, Y, regularization, None, inputs)
    # LAPACK on every device at once was seen to stall, see `_factors/dense.py`.
    X, Y = on_one_device("X", X), on_one_device("Y", Y)
    check_memory(X, LOSS_COPIES)
    return K, X, Y, None, regularization


LOSS_COPIES = 3  # matrices of the size of the Gram that a loss holds, with its gradient


def check_memory(X: Float[Array, "..."], copies: int) -> None:
    """Refuse a dense loss that does not fit in memory."""
    what = f"the loss of {X.size} rows"
    cure = (
        "Use hk.tune(..., solver=hk.Nystrom()) or solver=hk.RandomFeatures(count, key), whose loss "
        "is of low rank too, or a part of the data."
    )
    refuse_beyond_memory(what, X.size, X.size, X.dtype, copies, cure)


# The losses of the dense fit, where `basis` is None, and of the low-rank fit in a basis.


# Where ‖a‖² comes with them it tells `tune` how far the field will round.


def partition_loss(K, X, Y, regularization, partition, basis=None):
    return partition_loss_and_square(K, X, Y, regularization, partition, basis)[0]


@eqx.filter_jit
def partition_loss_and_square(K, X, Y, regularization, partition, basis=None):
    residuals, a = _held_out(K, X, Y, regularization, partition, basis)
    squares = jnp.mean(residuals**2, axis=1)
    return jnp.asarray(partition.weights, squares.dtype) @ squares, a @ a


@eqx.filter_jit
def _held_out(K, X, Y, regularization, partition: Partition, basis=None):
    N = len(X)
    system = _system(K, X, (N - N / len(partition.folds)) * regularization, basis)
    rows_left = (N - max(map(len, partition.folds))) * (Y.size // N)
    if isinstance(system, LowRankSystem) and system.rows.shape[1] > rows_left:
        # A fold interpolates the rest, and its coefficients are the difference of those of all:
        # the gradient lost the square of the condition, 5 times itself at 1e10. Such data are few.
        A = plus_ridge(system.rows @ system.rows.T, system.ridge)
        system = DenseSystem(A)
    residuals, a = held_out(system, Y.reshape(Y.size), partition)  # pyright: ignore
    return residuals.reshape(Y.shape), a


def generalized_loss(K, X, Y, regularization, basis=None, least_free=0.0):
    return generalized_loss_and_square(K, X, Y, regularization, basis, least_free)[0]


@eqx.filter_jit
def generalized_loss_and_square(K, X, Y, regularization, basis=None, least_free=0.0):
    # Infinite where less than the share `least_free` of the residuals is free, tr(I − S)/D.
    ridge = len(X) * regularization
    squares, trace = free_residuals(_system(K, X, ridge, basis), Y.reshape(Y.size))
    enough = ridge * trace >= least_free * Y.size  # tr(I − S) = ridge tr A⁻¹
    return jnp.where(enough, squares * Y.size / trace**2, jnp.inf), squares


@eqx.filter_jit
def log_likelihood(K, X, Y, regularization, basis=None):
    return log_density(_system(K, X, len(X) * regularization, basis), Y.reshape(Y.size))


def _system(K, X: Array, ridge: Array, basis: AbstractBasis | None) -> AbstractSystem:
    if basis is None:
        G = trained((K, X), _rows_of_gram, rowwise=True)
        D = G.shape[0] * G.shape[1]
        return DenseSystem(plus_ridge(G.reshape(D, D), ridge))
    rows = trained((K, X), basis.features, rowwise=True)
    return LowRankSystem(rows.reshape(-1, rows.shape[-1]), ridge)


def _rows_of_gram(K, X: Float[Array, "N n"]) -> Callable[[Array], Float[Array, "t n N n"]]:
    return lambda x: assemble(K, x, X)
