"""Validation losses in closed form, each for the cost of one factorisation.

The public functions check their arguments and make the rows of the observations. The functions of
rows compute the same losses, for the dense fit or, with a `basis`, for the low-rank fit. Their
residuals are divided by the relative noise of the row.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel._closed_forms import Folds, Partition, free_residuals, held_out, log_density
from hamkernel._fields.base import Mean
from hamkernel._gram import between_all, forward_differentiated, gram_of_rows, plus_ridge
from hamkernel._machine import entry_point, precise_jit, refuse_beyond_memory
from hamkernel._observations.blocks import AbstractBlock, Combinations
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.factors import AbstractSystem, DenseSystem
from hamkernel._solvers.low_rank import AbstractBasis
from hamkernel._solvers.low_rank_factor import LowRankSystem
from hamkernel._solvers.problem import AbstractSolver, check_solver, make_problem
from hamkernel._structures.base import AbstractMatrixKernel


@entry_point
def cross_validation_loss(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    folds: Folds = 5,
    *,
    mean: Mean | None = None,
    solver: AbstractSolver | None = None,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """The cross-validation loss: the mean over folds of the mean squared error of a held-out fold.

    (1/F) Σ_S (1/(|S| n)) Σ_{i ∈ S} ‖yᵢ − f₋S(xᵢ)‖², with f₋S the fit without the fold S. The loss
    equals that of a refit without each of the F folds, with the ridge (N − N/F) λ for all folds.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, without Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.
        folds: the number of folds, of consecutive points and nearly equal size. Or "loo" for one
            point per fold. Or a label for each point, shape (N,), such as the name of its run, to
            hold out one run at a time. A fold contains complete points, since the other components
            of a point would reveal a held-out component. Labels must be concrete under jit. For
            observations N counts all points, energies and functionals, in their order. If a fold
            contains all energies, we compare them up to their constant.
        mean: the known part of the field, as in `fit`.
        solver: a low-rank solver, for the loss of its fit as in `tune`; None for the exact loss.
        inputs: u at each state for a `Controlled` kernel, shape (N, m).
        parameters: θ at each state for a `Family`, shape (N, p).

    Returns:
        The loss, shape (), in squared units of Y, or of rows divided by their relative noise; inf
        if G + NλI is not positive definite to rounding. Loss and gradient take O((N n)³) time and
        three matrices of (N n)² numbers. The loss is differentiable in reverse mode only:
        `jax.jacrev(jax.grad(loss))` is the Hessian. It works under vmap, and compiles once for each
        shape and partition.

    Raises:
        TypeError: K is not matrix-valued.
        ValueError: data, folds or regularization are invalid, or matrices do not fit in memory.
    """
    checked = _check_problem(K, X, Y, regularization, mean, solver, inputs, parameters)
    K, rows, regularization, basis = checked
    return partition_loss(K, rows, regularization, partition_of_rows(rows, folds), basis)


@entry_point
def cross_validation_residuals(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    folds: Folds = 5,
    *,
    mean: Mean | None = None,
    solver: AbstractSolver | None = None,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, "N n"]:
    """The held-out residuals yᵢ − f₋S(xᵢ), with f₋S the fit without the fold S of the point i.

    The cross-validation loss is the mean over folds of the mean square of these residuals. For
    arguments and errors see `cross_validation_loss`.

    Returns:
        The residuals, shape (N, n), in units of Y. For observations one residual for each row,
        shape (D,), in the units of the row. All are inf if G + NλI is not positive definite to
        rounding.
    """
    checked = _check_problem(K, X, Y, regularization, mean, solver, inputs, parameters)
    K, rows, regularization, basis = checked
    residuals = held_out_rows(K, rows, regularization, partition_of_rows(rows, folds), basis)[0]
    return rows.to_units(residuals)


@entry_point
def generalized_cross_validation(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    mean: Mean | None = None,
    solver: AbstractSolver | None = None,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """The generalised cross-validation loss, (‖y − Sy‖²/D) / (tr(I − S)/D)² = D ‖a‖² / (tr A⁻¹)².

    S = G A⁻¹ is the smoother of the fit, A = G + NλI, a = A⁻¹y, and D = N n the number of rows. The
    loss is the leave-one-out loss with every leverage replaced by the mean leverage. It needs no
    folds, does not depend on the order of the data, and assumes independent noise.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.
        mean: the known part of the field, as in `fit`.
        solver: a low-rank solver, for the loss of its fit as `tune` minimises it; exact if None.
        inputs: u at each state, for a `Controlled` kernel, shape (N, m).
        parameters: θ at each state, for a `Family`, shape (N, p).

    Returns:
        The loss, shape (), in squared units of Y; inf if the factorisation fails. Derivatives are
        available as for `cross_validation_loss`.

    Raises:
        TypeError: K is not matrix-valued.
        ValueError: data or regularization are invalid, or matrices do not fit in memory.

    Source: Golub, Heath & Wahba (1979), Technometrics 21.
    """
    return generalized_loss(
        *_check_problem(K, X, Y, regularization, mean, solver, inputs, parameters)
    )


@entry_point
def log_marginal_likelihood(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-4,
    *,
    mean: Mean | None = None,
    solver: AbstractSolver | None = None,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Float[Array, ""]:
    """The log density of Y under f ~ GP(mean, K) and independent noise of variance Nλ.

    log p(Y) = −½ yᵀA⁻¹y − ½ log det A − ½ N n log 2π with A = G + NλI and y = Y − mean(X). This is
    the best objective of `tune` if the true field resembles a draw from the prior. Otherwise
    cross-validation is safer. With `Warp(k, fn)` fields may have no component along some
    directions, such as translations of a molecule. The result is then the density of the components
    of Y along all other directions.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n); or observations, and then there is no Y.
        Y: measured velocities, shape (N, n).
        regularization: λ > 0; the noise variance is Nλ.
        mean: the known part of the field, as in `fit`.
        solver: a low-rank solver, for the loss of its fit as `tune` minimises it; exact if None.
        inputs: u at each state, for a `Controlled` kernel, shape (N, m).
        parameters: θ at each state, for a `Family`, shape (N, p).

    Returns:
        The log density, shape (); −inf if the factorisation fails. Derivatives are available as for
        `cross_validation_loss`.

    Raises:
        TypeError: K is not matrix-valued.
        ValueError: data or regularization are invalid, or matrices do not fit in memory.

    Source: Rasmussen & Williams (2006), eq. 2.30.
    """
    return log_likelihood(
        *_check_problem(K, X, Y, regularization, mean, solver, inputs, parameters)
    )


def _check_problem(
    K, X, Y, regularization, mean, solver, inputs, parameters
) -> tuple[Any, Measurements, Float[Array, ""], AbstractBasis | None]:
    """The checked kernel, rows and λ, and the basis of a low-rank solver."""
    check_solver(solver)
    # LAPACK calls on several devices at once can deadlock, see `_solvers/factors.py`.
    problem = make_problem(K, X, Y, regularization, mean, inputs, parameters).to_one_device()
    checked = problem.kernel, problem.rows, problem.regularization
    basis = None if solver is None else solver.low_rank_basis(*checked)
    if basis is None:
        check_memory(problem.rows, 3)  # three matrices of the size of the Gram, with the gradient
    return *checked, basis


def check_memory(rows: Measurements, copies: int) -> None:
    """Raise a ValueError if the matrices of a dense loss do not fit in memory."""
    M = len(rows.targets)
    cure = (
        "Use hk.tune(..., solver=hk.Nystrom()) or solver=hk.RandomFeatures(count, key), whose loss "
        "is of low rank too, or a part of the data."
    )
    refuse_beyond_memory(f"the loss of {M} rows", M, M, rows.targets.dtype, copies, cure)


# The losses of rows.


def partition_of_rows(rows: Measurements, folds: Folds) -> Partition:
    """The folds of the rows, from the folds of their observations."""
    labels = Partition(rows.count, folds).labels
    return Partition(len(rows.targets), labels[rows.labels()])


# Losses with the ending `_and_square` also return ‖a‖², from which `tune` bounds rounding errors.


def partition_loss(K, rows: Measurements, regularization, partition: Partition, basis=None):
    """The loss of `cross_validation_loss`: the mean over folds of the mean over their rows."""
    return partition_loss_and_square(K, rows, regularization, partition, basis)[0]


@precise_jit
def partition_loss_and_square(
    K, rows: Measurements, regularization, partition: Partition, basis=None
):
    residuals, a = held_out_rows(K, rows, regularization, partition, basis)
    return jnp.asarray(partition.weights, residuals.dtype) @ residuals**2, a @ a


@precise_jit
def held_out_rows(K, rows: Measurements, regularization, partition: Partition, basis=None):
    """The residual of each row under the fit without its fold, over its relative noise, and A⁻¹y.

    If a fold contains all energies, we compute their residuals up to the best constant.
    """
    energies, F = rows.energies, len(partition.folds)
    ridge = (rows.count - rows.count / F) * regularization
    y, p = rows.targets, rows.constant
    contrasted = any(len(energies) and np.isin(energies, fold).all() for fold in partition.folds)
    if contrasted:  # no other fold determines the constant, so we hold out contrasts
        y, p = rows.y, None
        partition = Partition(rows.size, np.delete(partition.labels, energies[0]))
    features = None if basis is None else features_of_rows(K, rows, basis, contrasted)
    result: Any
    if features is None:
        result = _dense_held_out(gram_matrix(K, rows, contrasted), ridge, y, p, rows, partition)
    elif features.shape[1] > len(y) - max(map(len, partition.folds)):
        # With fewer training rows than features the fit interpolates, and the low-rank gradient
        # loses digits like cond(A)²: at cond(A) = 1e10 its relative error was 5. There are then few
        # rows, so a dense factor is affordable.
        result = _dense_held_out(features @ features.T, ridge, y, p, rows, partition)
    else:
        result = held_out(LowRankSystem(features, ridge, p), y, partition)
    return tuple(map(rows.contrast_transpose, result)) if contrasted else result


def _dense_held_out(G, ridge, y, p, rows: Measurements, partition: Partition):
    A = plus_ridge(G, ridge)
    if p is None:
        return held_out(DenseSystem(A), y, partition)
    # Let U = diag(units), A′ = UAU and y′ = Uy. Then C′ = U⁻¹CU⁻¹ and a′ = C′y′ = U⁻¹a, so
    # r′_S = (C′_SS)⁻¹a′_S = U r_S. With p ∝ 1/s and U = diag(s) all energies have the same entry of
    # Up. This direction of the constant does not depend on the noise, and needs no derivative.
    units = jnp.where(p == 0, jnp.ones_like(p), rows.scale)
    equal = jnp.where(p == 0, p, len(rows.energies) ** -0.5)
    system = DenseSystem(units[:, None] * A * units[None], equal)
    y = units * y
    result: Any = held_out(system, y - equal * (equal @ y), partition)
    return result[0] / units, units * result[1]


def generalized_loss(K, rows: Measurements, regularization, basis=None, least_free=0.0):
    """The loss of `generalized_cross_validation`."""
    return generalized_loss_and_square(K, rows, regularization, basis, least_free)[0]


@precise_jit
def generalized_loss_and_square(K, rows: Measurements, regularization, basis=None, least_free=0.0):
    # The loss is infinite if tr(I − S)/D, the fraction of free residuals, is below `least_free`.
    ridge = rows.count * regularization
    squares, trace = free_residuals(_contrasted_system(K, rows, ridge, basis), rows.y)
    enough = ridge * trace >= least_free * rows.size  # tr(I − S) = ridge tr A⁻¹
    return jnp.where(enough, squares * rows.size / trace**2, jnp.inf), squares


@precise_jit
def log_likelihood(K, rows: Measurements, regularization, basis=None, projected=None):
    """The log marginal likelihood of rows, with a flat prior for the constant of energies.

    `projected` is the result of `project_silent_directions(K, rows)`; None to compute it.
    """
    # Rows are y_r = (measurement)_r / s_r, so log p(measurements) = log p(y) − Σ log s_r. The
    # constant of the energies enters y along s⁻¹ = ‖s⁻¹‖ p. A flat prior for the constant
    # integrates the density over this direction: log p(y) = log N(Ty; 0, TATᵀ) − log ‖s⁻¹‖ with the
    # contrasts Ty, and log ‖s⁻¹‖ = ½ log Σ_e s_e⁻² (restricted likelihood: Harville (1974),
    # Biometrika 61; Rasmussen & Williams (2006), eq. 2.45). The k silent directions of y are zeros
    # of variance ρ = Nλ. We subtract their log density −½ k log 2πρ.
    ridge = rows.count * regularization
    y, silent = project_silent_directions(K, rows) if projected is None else projected
    # The barrier keeps two LAPACK calls from running at once, see `_solvers/factors.py`.
    y, silent, ridge = jax.lax.optimization_barrier((y, silent, ridge))
    density = log_density(_contrasted_system(K, rows, ridge, basis), y)
    density = density + 0.5 * silent * jnp.log(2 * jnp.pi * ridge)
    density = density - jnp.sum(jnp.log(rows.scale))
    if not len(rows.energies):
        return density
    return density - 0.5 * jnp.log(jnp.sum(rows.scale[rows.energies] ** -2))


def project_silent_directions(
    K: AbstractMatrixKernel, rows: Measurements
) -> tuple[Float[Array, " D"], Float[Array, ""]]:
    """The targets, projected on the directions of fields of K, and the number of other directions.

    If K has a descriptor d, its fields point along the rows of the Jacobian of d. The other
    directions are silent. Forces from a potential of distances, for example, have six silent
    directions for each molecule. The likelihood would treat the zeros there as measurements without
    noise and drive λ to its bound. Each silent direction is an eigenvector of A with the eigenvalue
    Nλ.
    """
    y, none = rows.y, jnp.zeros((), rows.targets.dtype)
    if rows.states is None:
        return y, none
    X, Y = rows.states
    descriptor = K.through_descriptor(X.shape[1])
    if descriptor is None:
        return y, none

    def project(pair):
        x, v = pair
        J = jax.jacfwd(descriptor.point_data or descriptor.map)(x)  # (m, n)
        J = J @ descriptor.directions(x)
        J = jax.lax.stop_gradient(J)  # the projection is constant for a map of constant rank
        squares, V = jnp.linalg.eigh(J.T @ J)
        # Zero eigenvalues are rounded to ε times the largest. A visible direction has more than
        # ε^(1/3) of the largest singular value, whose square is ε^(2/3).
        is_visible = squares > jnp.finfo(x.dtype).eps ** (2 / 3) * squares[-1]
        return V @ jnp.where(is_visible, V.T @ v, jnp.zeros_like(v)), jnp.sum(~is_visible)

    projected, counts = jax.lax.map(project, (X, Y))
    return projected.reshape(-1), jnp.sum(counts).astype(y.dtype)


def _contrasted_system(K, rows: Measurements, ridge, basis: AbstractBasis | None) -> AbstractSystem:
    """The system of the contrasts of the rows, which do not contain the constant of energies."""
    if basis is not None:
        return LowRankSystem(features_of_rows(K, rows, basis, contrasted=True), ridge)
    return DenseSystem(plus_ridge(gram_matrix(K, rows, contrasted=True), ridge))


# The Gram and the features of the rows, with cheap derivatives with respect to K.


def features_of_rows(
    K, rows: Measurements, basis: AbstractBasis, contrasted: bool = False
) -> Float[Array, "M r"]:
    """The features Φ of all rows, before or after the contrast."""
    like = rows.blocks[0].points

    def rows_in_basis(K, basis):
        return basis.span(K, like.shape[1], like.dtype).rows_of

    features = jnp.concatenate(
        [_rows_by_points(K, block, basis, rows_in_basis) for block in rows.blocks]
    )
    return rows.contrast(features) if contrasted else features


def gram_matrix(
    K: AbstractMatrixKernel, rows: Measurements, contrasted: bool = False
) -> Float[Array, "M M"]:
    """The Gram G of all rows, before or after the contrast."""

    def gram_of_block(K, blocks):
        return lambda block: between_all(K, block, blocks)

    def gram_by_points(K, block, blocks):
        return _rows_by_points(K, block, blocks, gram_of_block)

    return gram_of_rows(K, rows, contrasted, gram_by_points)


def _rows_by_points(K, block: AbstractBlock, data, make_rows) -> Float[Array, "d e"]:
    """The matrix `make_rows(K, data)(block)`, with one row for each row of the block.

    We compute the matrix point by point, so that derivatives need the memory of one point. For
    `Combinations`, which have more points than rows, we compute it at once.
    """
    if isinstance(block, Combinations):
        return forward_differentiated(
            (K, (block, data)), lambda K, both: make_rows(K, both[1])(both[0])
        )

    def make(K, both):
        rows = make_rows(K, both[1])

        def rows_at_point(x):
            moved = block.with_points(x)
            return rows(moved).reshape(*moved.values_shape, -1)

        return rows_at_point, both[0]

    return block.rows(forward_differentiated((K, (block.points, data)), make, rowwise=True))
