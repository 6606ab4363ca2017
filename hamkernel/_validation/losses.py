"""Validation losses in closed form, each at the price of one Cholesky factorisation.

Write A = G + ridge I and a = A⁻¹y for the system with ALL points, and let S be the rows of a
held-out fold. Eliminating the other rows from A a = y by block inversion gives the residual that
a fit WITHOUT S would have on S,

    r_S = y_S − f₋S(X_S) = (C_SS)⁻¹ a_S,    C = A⁻¹,

so no fold is ever refitted.

The derivatives are written down as well, since differentiating the factorisation costs several
times its price. From dC = −C dA C, and with v_S = (C_SS)⁻¹ r̄_S for a cotangent r̄,

    r̄·dr = Σ_S v_Sᵀ[(dC y)_S − dC_SS r_S]   so   Ā = Σ_S (C_:S v_S)(C_:S r_S)ᵀ − (C v) aᵀ.

Source: for scalar outputs and single points, Rasmussen & Williams (2006), section 5.4.2; for
folds, Ginsbourger & Schärer (2021), arXiv:2101.03108.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from hamkernel import _require as require
from hamkernel._gram.dense import assemble, plus_ridge
from hamkernel._gram.derivatives import trained
from hamkernel._machine.devices import on_one_device
from hamkernel._machine.memory import refuse_beyond_memory
from hamkernel._solvers.inverse import inverse
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._validation.folds import Folds, Partition


def cross_validation_loss(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    regularization: ArrayLike,
    folds: Folds = 5,
) -> Float[Array, ""]:
    """The mean over folds of the mean squared error of a fit that has not seen the fold.

    The mean squared error is itself the mean over the fold's points and components. Exact: equal
    to refitting without each fold, with the ridge that such a fit has, (N − N/F) λ for F folds.
    With folds of unequal size every refit has this same ridge, that of the average fold.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n).
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.
        folds: a number of folds, made of consecutive points as equal in size as possible; "loo"
            for one point per fold; or an integer label for each point, shape (N,), to hold out,
            say, one trajectory at a time. A fold always holds out whole points: leaving out
            single components would leak their siblings. Labels must be concrete under jit.

    Returns:
        The loss, in squared units of Y; inf where the matrix is not positive definite to
        rounding. Differentiable in reverse mode: `jax.jacrev(jax.grad(loss))` is the Hessian, for
        there is no `jax.jvp`. Vmappable, compiled once per shape and partition. O((N n)³) time,
        three matrices of (N n)² numbers, with the gradient over K too.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data, folds, or regularization, or
            matrices that do not fit in memory.
    """
    K, X, Y, regularization = _checked(K, X, Y, regularization)
    return partition_loss(K, X, Y, regularization, Partition(len(X), folds))


def cross_validation_residuals(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    regularization: ArrayLike,
    folds: Folds = 5,
) -> Float[Array, "N n"]:
    """The residual yᵢ − f(xᵢ) of each point under the fit that has not seen its fold.

    Args and errors are those of `cross_validation_loss`, which is the mean over folds of their mean
    squares: with unequal folds not the mean of all squares.

    Returns:
        Shape (N, n), in units of Y; inf where the matrix is not positive definite to rounding.
    """
    K, X, Y, regularization = _checked(K, X, Y, regularization)
    return _residuals(K, X, Y, regularization, Partition(len(X), folds))


def generalized_cross_validation(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    regularization: ArrayLike,
) -> Float[Array, ""]:
    """Generalised cross-validation: the training error over the squared share of free residuals.

    With the smoother y -> Sy, S = G A⁻¹, and D = N n rows, it is (‖y − Sy‖²/D) / (tr(I − S)/D)²
    = D ‖a‖² / (tr A⁻¹)². It needs no folds and does not depend on the order of the data, and is
    leave-one-out with every leverage replaced by the mean one. For independent noise.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n).
        Y: measured velocities, shape (N, n).
        regularization: λ > 0.

    Returns:
        The loss, in squared units of Y; inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Golub, Heath & Wahba (1979), Technometrics 21.
    """
    K, X, Y, regularization = _checked(K, X, Y, regularization)
    return generalized_loss(K, X, Y, regularization)


def log_marginal_likelihood(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    regularization: ArrayLike,
) -> Float[Array, ""]:
    """The log density of Y under f ~ GP(0, K) and independent noise of variance Nλ.

    −½ yᵀA⁻¹y − ½ log det A − ½ N n log 2π with A = G + NλI. The best objective when the model is
    believed (the truth resembles a draw of the prior); cross-validation trusts it less.

    Args:
        K: a matrix-valued kernel.
        X: states, shape (N, n).
        Y: measured velocities, shape (N, n).
        regularization: λ > 0; the noise variance is Nλ.

    Returns:
        The log density; −inf where the factorisation fails. Differentiable as
        `cross_validation_loss` is.

    Raises:
        TypeError: K is not matrix-valued. ValueError: bad data or regularization, or a matrix
            that does not fit in memory.

    Source: Rasmussen & Williams (2006), eq. 2.30.
    """
    K, X, Y, regularization = _checked(K, X, Y, regularization)
    return log_likelihood(K, X, Y, regularization)


def _checked(K, X, Y, regularization):
    K = matrix_kernel(K)
    X, Y = require.data(X, Y)
    # LAPACK on every device at once was seen to stall, see `_solvers/inverse.py`.
    X, Y = on_one_device("X", X), on_one_device("Y", Y)
    K.check_dimension(X.shape[1])
    regularization = require.ridge(regularization, X.dtype)
    check_memory(X, LOSS_COPIES)
    return K, X, Y, regularization


LOSS_COPIES = 3  # matrices of the size of the Gram that a loss holds, with its gradient


def check_memory(X: Float[Array, "N n"], copies: int) -> None:
    """Refuse a dense loss that does not fit in memory."""
    what = f"the loss of N = {len(X)} points with n = {X.shape[1]} coordinates"
    cure = (
        "Use hk.tune(..., solver=hk.Nystrom()) or solver=hk.RandomFeatures(count, key), whose loss "
        "is of low rank too, or a part of the data."
    )
    refuse_beyond_memory(what, X.size, X.size, X.dtype, copies, cure)


@eqx.filter_jit
def partition_loss(K, X, Y, regularization, partition):
    squares = jnp.mean(_residuals(K, X, Y, regularization, partition) ** 2, axis=1)
    return jnp.asarray(partition.weights, squares.dtype) @ squares


@eqx.filter_jit
def _residuals(K, X: Array, Y: Array, regularization: Array, partition: Partition) -> Array:
    N, n = X.shape
    A = _regularised(K, X, (N - N / len(partition.folds)) * regularization)
    r: Any = held_out(A, Y.reshape(N * n), partition)
    return r.reshape(N, n)


@eqx.filter_jit
def generalized_loss(K, X, Y, regularization, least_free=0.0):
    ridge = len(X) * regularization
    squares, trace = free_residuals(_regularised(K, X, ridge), Y.reshape(Y.size))
    enough = ridge * trace >= least_free * Y.size  # tr(I − S) = ridge tr A⁻¹
    return jnp.where(enough, squares * Y.size / trace**2, jnp.inf)


@eqx.filter_jit
def log_likelihood(K, X, Y, regularization):
    A = _regularised(K, X, len(X) * regularization)
    return log_density(A, Y.reshape(Y.size))


def _regularised(K, X: Array, ridge: Array) -> Float[Array, "D D"]:
    G = trained((K, X), _rows_of_gram, rowwise=True)
    return plus_ridge(G.reshape(X.size, X.size), ridge)


def _rows_of_gram(K, X: Float[Array, "N n"]) -> Callable[[Array], Float[Array, "t n N n"]]:
    return lambda x: assemble(K, x, X)


# What each loss needs of A and y, with its derivative.


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def held_out(
    A: Float[Array, "D D"], y: Float[Array, " D"], partition: Partition
) -> Float[Array, " D"]:
    """r_S = (C_SS)⁻¹ a_S for each fold, in the order of y; inf where A has no factor."""
    return _held_out_forward(A, y, partition)[0]


def _held_out_forward(A, y, partition):
    C, _ = inverse(A)
    a = C @ y
    r, factors = jnp.zeros_like(a), []
    for group in partition.groups:
        blocks, r = jax.lax.optimization_barrier((group.diagonal_blocks(C), r))  # not side by side
        factors.append(jax.lax.linalg.cholesky(blocks, symmetrize_input=False))
        r = group.scattered(_solve_blocks(factors[-1], group.gather(a)), into=r)
    ok = jnp.isfinite(r).all()
    return jnp.where(ok, r, jnp.full_like(r, jnp.inf)), (C, a, factors, r, ok)


def _held_out_backward(partition, saved, r_bar):
    C, a, factors, r, ok = saved
    P, Q = [], []  # C_:S v_S and C_:S r_S, a column for each fold
    for group, own in zip(partition.groups, factors, strict=True):
        v = _solve_blocks(own, group.gather(r_bar))
        rows = group.gather(C)  # whose sums are three times faster than those of columns
        P.append(jnp.einsum("fid,fi->fd", rows, v).T)
        Q.append(jnp.einsum("fid,fi->fd", rows, group.gather(r)).T)
        r_bar = jax.lax.optimization_barrier((r_bar, P[-1], Q[-1]))[0]
    w = jnp.concatenate(P, axis=1).sum(axis=1)  # C v
    left, right = jnp.column_stack([*P, -w]), jnp.column_stack([*Q, a])
    # Else XLA computes these sums again for every entry of the product: 10 times slower.
    left, right, w = jax.lax.optimization_barrier(_or_zero(ok, left, right, w))
    return left @ right.T, w


held_out.defvjp(_held_out_forward, _held_out_backward)


@jax.custom_vjp
def free_residuals(
    A: Float[Array, "D D"], y: Float[Array, " D"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """‖A⁻¹y‖² and tr A⁻¹; inf and 1 where A has no factor."""
    return _free_residuals_forward(A, y)[0]


def _free_residuals_forward(A, y):
    C, _ = inverse(A)
    a = C @ y
    squares, trace = a @ a, jnp.trace(C)
    ok = jnp.isfinite(squares) & jnp.isfinite(trace)
    value = jnp.where(ok, squares, jnp.inf), jnp.where(ok, trace, jnp.ones_like(trace))
    return value, (C, a, ok)


def _free_residuals_backward(saved, bars):
    C, a, ok = saved
    squares_bar, trace_bar = bars
    w = 2 * squares_bar * (C @ a)
    return _or_zero(ok, -trace_bar * (C @ C) - w[:, None] * a[None, :], w)


free_residuals.defvjp(_free_residuals_forward, _free_residuals_backward)


@jax.custom_vjp
def log_density(A: Float[Array, "D D"], y: Float[Array, " D"]) -> Float[Array, ""]:
    """The log density of y under N(0, A); −inf where A has no factor."""
    return _log_density_forward(A, y)[0]


def _log_density_forward(A, y):
    C, R = inverse(A)
    a = C @ y
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(R)))
    value = -0.5 * (y @ a + log_det + len(y) * jnp.log(2 * jnp.pi).astype(y.dtype))
    ok = jnp.isfinite(value)
    return jnp.where(ok, value, -jnp.inf), (C, a, ok)


def _log_density_backward(saved, bar):
    C, a, ok = saved
    return _or_zero(ok, 0.5 * bar * (a[:, None] * a[None, :] - C), -bar * a)


log_density.defvjp(_log_density_forward, _log_density_backward)


def _solve_blocks(factors: Float[Array, "F b b"], b: Float[Array, "F b"]) -> Float[Array, "F b"]:
    return jax.scipy.linalg.cho_solve((factors, True), b[..., None])[..., 0]


def _or_zero(ok: Bool[Array, ""], *arrays: Array) -> tuple[Array, ...]:
    """Derivatives, zero in place of NaN where the value is infinite."""
    return tuple(jnp.where(ok, array, jnp.zeros_like(array)) for array in arrays)
