"""Validation losses in closed form, each at the price of one factorisation.

The public functions check their arguments and make the rows of the observations; the functions of
rows, below, are the same losses for the dense fit and, in a `basis`, for the fit of low rank. Their
residuals count in units of the relative noise of a row. Velocities X, Y that were all measured are
the rows of one block, and pass through as they are.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel._closed_forms import (
    Folds,
    Partition,
    free_residuals,
    held_out,
    log_density,
)
from hamkernel._gram import between_all, forward_differentiated, gram_of_rows, plus_ridge
from hamkernel._machine import compiled, full_precision, one_blas_thread, refuse_beyond_memory
from hamkernel._observations.blocks import AbstractBlock, Combinations
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.factors import AbstractSystem, ContrastedSystem, DenseSystem
from hamkernel._solvers.low_rank import AbstractBasis
from hamkernel._solvers.low_rank_factor import LowRankSystem
from hamkernel._solvers.problem import problem
from hamkernel._structures.base import AbstractMatrixKernel


@one_blas_thread
@full_precision
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
            for one point per fold; or a label for each point, shape (N,), such as the name of its
            run, to hold out one run at a time. A fold always holds out whole points: leaving out
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
@full_precision
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
@full_precision
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
@full_precision
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
    check_memory(given.rows, 3)  # matrices of the size of the Gram, with the gradient
    return given.kernel, given.rows, given.regularization


def check_memory(rows: Measurements, copies: int) -> None:
    """Refuse a dense loss that does not fit in memory."""
    M = len(rows.targets)
    cure = (
        "Use hk.tune(..., solver=hk.Nystrom()) or solver=hk.RandomFeatures(count, key), whose loss "
        "is of low rank too, or a part of the data."
    )
    refuse_beyond_memory(f"the loss of {M} rows", M, M, rows.targets.dtype, copies, cure)


# The losses of rows.


def partition_of_rows(rows: Measurements, folds: Folds) -> Partition:
    """The folds of the rows from those of the observations that they belong to."""
    labels = Partition(rows.count, folds).labels
    return Partition(len(rows.targets), labels[rows.labels()])


# Some losses return ‖a‖² too, by which `tune` bounds the rounding errors of a field.


def partition_loss(K, rows: Measurements, regularization, partition: Partition, basis=None):
    """`cross_validation_loss`: the mean over folds of the mean over their rows."""
    return partition_loss_and_square(K, rows, regularization, partition, basis)[0]


@compiled
def partition_loss_and_square(
    K, rows: Measurements, regularization, partition: Partition, basis=None
):
    left, a = held_out_rows(K, rows, regularization, partition, basis)
    return jnp.asarray(partition.weights, left.dtype) @ left**2, a @ a


@compiled
def held_out_rows(K, rows: Measurements, regularization, partition: Partition, basis=None):
    """The residual of each row under the fit without its fold, in units of its noise, and A⁻¹y.

    The residuals of a fold that holds all energies are those up to the best constant.
    """
    energies, F = rows.energies, len(partition.folds)
    ridge = (rows.count - rows.count / F) * regularization
    y, p = rows.targets, rows.constant
    contrasted = any(len(energies) and np.isin(energies, fold).all() for fold in partition.folds)
    if contrasted:  # no other fold determines the constant, so contrasts are held out
        y, p = rows.y, None
        partition = Partition(rows.size, np.delete(partition.labels, energies[0]))
    features = None if basis is None else features_of_rows(K, rows, basis, contrasted)
    found: Any
    if features is None:
        found = _dense_held_out(gram_matrix(K, rows, contrasted), ridge, y, p, rows, partition)
    elif features.shape[1] > len(y) - max(map(len, partition.folds)):
        # The fit without a fold interpolates, and the low-rank gradient lost the square of the
        # condition: at 1e10 its error was 5 times itself. The data are then few enough for a dense
        # factor.
        found = _dense_held_out(features @ features.T, ridge, y, p, rows, partition)
    else:
        found = held_out(LowRankSystem(features, ridge, p), y, partition)
    return tuple(map(rows.contrast_transpose, found)) if contrasted else found


def _dense_held_out(G, ridge, y, p, rows: Measurements, partition: Partition):
    A = plus_ridge(G, ridge)
    if p is None:
        return held_out(DenseSystem(A), y, partition)
    # In the units of the energies the direction of their constant does not depend on the noise, and
    # the derivative is complete.
    units = jnp.where(p == 0, jnp.ones_like(p), rows.scale)
    equal = jnp.where(p == 0, p, len(rows.energies) ** -0.5)
    system = ContrastedSystem(units[:, None] * A * units[None], equal)
    found: Any = held_out(system, units * y, partition)
    return found[0] / units, units * found[1]


def generalized_loss(K, rows: Measurements, regularization, basis=None, least_free=0.0):
    """`generalized_cross_validation` of the rows."""
    return generalized_loss_and_square(K, rows, regularization, basis, least_free)[0]


@compiled
def generalized_loss_and_square(K, rows: Measurements, regularization, basis=None, least_free=0.0):
    # The loss is infinite where the share of free residuals, tr(I − S)/D, is below `least_free`.
    ridge = rows.count * regularization
    squares, trace = free_residuals(_of_contrasts(K, rows, ridge, basis), rows.y)
    enough = ridge * trace >= least_free * rows.size  # tr(I − S) = ridge tr A⁻¹
    return jnp.where(enough, squares * rows.size / trace**2, jnp.inf), squares


@compiled
def log_likelihood(K, rows: Measurements, regularization, basis=None, heard=None):
    """`log_marginal_likelihood` of the rows, with a flat prior for the constant of energies.

    `heard` is `without_silent_directions(K, rows)`, where that is known already.
    """
    ridge = rows.count * regularization
    y, silent = without_silent_directions(K, rows) if heard is None else heard
    y, silent, ridge = jax.lax.optimization_barrier((y, silent, ridge))  # no LAPACK side by side
    density = log_density(_of_contrasts(K, rows, ridge, basis), y)
    density = density + 0.5 * silent * jnp.log(2 * jnp.pi * ridge)
    density = density - jnp.sum(jnp.log(rows.scale))
    if not len(rows.energies):
        return density
    return density - 0.5 * jnp.log(jnp.sum(rows.scale[rows.energies] ** -2))


def without_silent_directions(
    K: AbstractMatrixKernel, rows: Measurements
) -> tuple[Float[Array, " D"], Float[Array, ""]]:
    """The targets without their components along which no field of K points, and their number.

    A kernel of a descriptor d knows the field along the rows of the Jacobian of d alone. Forces
    computed from a potential of distances have no component along the other directions, six for
    each molecule, so that the likelihood would take them for measurements without any noise, and
    drive λ to its bound. Each of them is an eigenvector of A with the eigenvalue Nλ.
    """
    y, none = rows.y, jnp.zeros((), rows.targets.dtype)
    if rows.states is None:
        return y, none
    X, Y = rows.states
    found = K.through_descriptor(X.shape[1])
    if found is None:
        return y, none

    def of_point(pair):
        x, v = pair
        J = jax.jacfwd(found.seen or found.map)(x) @ found.directions(x)  # (m, n)
        J = jax.lax.stop_gradient(J)  # the projection of a map of full rank is constant
        squares, V = jnp.linalg.eigh(J.T @ J)
        # Rounding leaves ε of the largest, and a descriptor sees distances to more than √ε.
        seen = squares > jnp.finfo(x.dtype).eps ** (2 / 3) * squares[-1]
        return V @ jnp.where(seen, V.T @ v, jnp.zeros_like(v)), jnp.sum(~seen)

    projected, counts = jax.lax.map(of_point, (X, Y))
    return projected.reshape(-1), jnp.sum(counts).astype(y.dtype)


def _of_contrasts(K, rows: Measurements, ridge, basis: AbstractBasis | None) -> AbstractSystem:
    """A of the contrasts, which do not depend on the constant of the energies."""
    if basis is not None:
        return LowRankSystem(features_of_rows(K, rows, basis, contrasted=True), ridge)
    return DenseSystem(plus_ridge(gram_matrix(K, rows, contrasted=True), ridge))


# The Gram and the features of the rows, cheap to differentiate with respect to K.


def features_of_rows(
    K, rows: Measurements, basis: AbstractBasis, contrasted: bool = False
) -> Float[Array, "M r"]:
    """Φ, before the contrast or after it."""
    like = rows.blocks[0].points

    def of(K, basis):
        return basis.span(K, like.shape[1], like.dtype).of

    features = jnp.concatenate([_by_points(K, block, basis, of) for block in rows.blocks])
    return rows.contrast(features) if contrasted else features


def gram_matrix(
    K: AbstractMatrixKernel, rows: Measurements, contrasted: bool = False
) -> Float[Array, "M M"]:
    """G, before the contrast or after it."""

    def of(K, others):
        return lambda block: between_all(K, block, others)

    def by_points(K, block, others):
        return _by_points(K, block, others, of)

    return gram_of_rows(K, rows, contrasted, by_points)


def _by_points(K, block: AbstractBlock, data, of) -> Float[Array, "d e"]:
    """The matrix that the function `of(K, data)` returns for a block, a row for each of its rows.

    The matrix is made point by point, so that only one point is differentiated at a time. That of
    `Combinations`, which have more points than rows, is made at once.
    """
    if isinstance(block, Combinations):
        return forward_differentiated((K, (block, data)), lambda K, both: of(K, both[1])(both[0]))

    def make(K, both):
        rows = of(K, both[1])

        def at_points(x):
            there = block.with_points(x)
            return rows(there).reshape(*there.values_shape, -1)

        return at_points, both[0]

    return block.rows(forward_differentiated((K, (block.points, data)), make, rowwise=True))
