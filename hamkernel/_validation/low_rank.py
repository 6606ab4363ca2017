"""Validation losses of low-rank fits, in closed form: O(N n r²) time, whatever the folds.

Write Φ (N n, r) for the rows of the features at the data, Ĝ = ΦΦᵀ for the Gram that they stand
for, δ for the ridge, and H_S = Φ_SᵀΦ_S, b_S = Φ_Sᵀy_S for the rows S of a fold. The fit without
the fold has the weights (H − H_S + δI)⁻¹ (b − b_S): sums over folds, and one factorisation of
size r for each of them. Where a fold has fewer rows than there are features, the inversion lemma
gives the same residual from one factorisation of H + δI = RRᵀ and one of the size of the fold,

    r_S = (I − VᵀV)⁻¹ (y_S − Vᵀ R⁻¹b),    V = R⁻¹Φ_Sᵀ,

and the losses that look at all rows at once need H alone (Weinstein & Aronszajn).

The derivative of r_S = y_S − Φ_S w, with w = A⁻¹(b − b_S) and A = H − H_S + δI, is written down,
since that of a factorisation costs several times its price. For a cotangent r̄, and with
z = −A⁻¹Φ_Sᵀr̄,

    Ā = −z wᵀ,   b̄ = z,   ȳ_S = r̄ − Φ_S z,   Φ̄_S = −ȳ_S wᵀ − r_S zᵀ   besides what H and b give.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, Key

from hamkernel._features.waves import features
from hamkernel._gram.derivatives import trained
from hamkernel._solvers.landmark_gram import Columns, factor, whitening
from hamkernel._solvers.landmarks import given_landmarks
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._validation.folds import Partition

Features = Callable[[Float[Array, "t n"]], Float[Array, "t n r"]]


class AbstractBasis(eqx.Module):
    """Features that follow the hyperparameters of a kernel, Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z)."""

    @abc.abstractmethod
    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        """The features of K, at points such as X."""


class WaveBasis(AbstractBasis):
    """Random Fourier features of one key: the frequencies scale with the kernel."""

    key: Key[Array, ""]
    count: int = eqx.field(static=True)

    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        return features(K, X.shape[1], self.count, self.key, X.dtype)


class LandmarkBasis(AbstractBasis):
    """The kernel's columns at fixed points, made orthonormal in its RKHS."""

    points: Float[Array, "m n"]

    def features(self, K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Features:
        S = self.points
        landmarks = given_landmarks(K, S)
        # Without a column a fit fails; its features would be those of the zero field.
        T = jnp.where(landmarks.count == 0, jnp.nan, whitening(K, landmarks))
        columns = Columns(K, S)
        return lambda x: (columns(x).reshape(x.size, S.size) @ T).reshape(*x.shape, S.size)


def low_rank_partition_loss(
    basis: AbstractBasis,
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    regularization: Float[Array, ""],
    partition: Partition,
) -> Float[Array, ""]:
    """`cross_validation_loss` of the low-rank fit; inf where a factorisation fails."""
    N = len(X)
    rows, y = _rows(basis, K, X), Y.reshape(-1)
    ridge = (N - N / len(partition.folds)) * regularization
    H, b = _square(rows), rows.T @ y
    few = [group.members.shape[1] * X.shape[1] <= rows.shape[1] for group in partition.groups]
    R = factor(H, ridge) if any(few) else None
    residuals = jnp.zeros_like(y)
    for group, is_few in zip(partition.groups, few, strict=True):
        own = group.gather(rows), group.gather(y)  # (F, S n, r) and (F, S n)
        own, R, residuals = jax.lax.optimization_barrier((own, R, residuals))  # not side by side
        if is_few:
            found = _by_inversion(*own, R, b)
        else:
            found = _by_downdating(*own, H, b, ridge)
        residuals = group.scattered(found, into=residuals)
    squares = jnp.mean(residuals.reshape(X.shape) ** 2, axis=1)
    return _finite(jnp.asarray(partition.weights, squares.dtype) @ squares, jnp.inf)


@jax.custom_vjp
def _by_downdating(
    folds: Float[Array, "F s r"],
    y: Float[Array, "F s"],
    H: Float[Array, "r r"],
    b: Float[Array, " r"],
    ridge: Float[Array, ""],
) -> Float[Array, "F s"]:
    return _by_downdating_forward(folds, y, H, b, ridge)[0]


def _by_downdating_forward(folds, y, H, b, ridge):
    def without(fold):
        own, target = fold
        R = factor(H - own.T @ own, ridge)
        w = cho_solve((R, True), b - own.T @ target)
        return target - own @ w, R, w

    # One after the other. Their factors, for the derivative, are no larger than the rows.
    residuals, R, w = jax.lax.map(without, (folds, y))
    return residuals, (folds, residuals, R, w)


def _by_downdating_backward(saved, bar):
    folds, residuals, R, w = saved
    moments = jnp.einsum("fsr,fs->fr", folds, bar)
    z = jax.lax.map(lambda fold: cho_solve((fold[0], True), -fold[1]), (R, moments))
    y_bar = bar - jnp.einsum("fsr,fr->fs", folds, z)
    folds_bar = -y_bar[:, :, None] * w[:, None, :] - residuals[:, :, None] * z[:, None, :]
    return folds_bar, y_bar, -z.T @ w, z.sum(axis=0), -jnp.vdot(z, w)


_by_downdating.defvjp(_by_downdating_forward, _by_downdating_backward)


@jax.custom_vjp
def _square(rows: Float[Array, "D r"]) -> Float[Array, "r r"]:
    """ΦᵀΦ, whose derivative is one product with Φ and not two."""
    return rows.T @ rows


_square.defvjp(
    lambda rows: (_square(rows), rows),
    lambda rows, bar: (rows @ (bar + bar.T),),
)


def _by_inversion(folds, y, R, b):
    b = solve_triangular(R, b, lower=True)
    rows = folds.reshape(-1, folds.shape[2])
    V = solve_triangular(R, rows.T, lower=True).T.reshape(folds.shape)  # (F, S n, r)
    held_out = jnp.eye(folds.shape[1], dtype=y.dtype)[None] - jnp.einsum("fsr,ftr->fst", V, V)
    return cho_solve((jnp.linalg.cholesky(held_out), True), (y - V @ b)[..., None])[..., 0]


def low_rank_generalized_loss(
    basis: AbstractBasis,
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    regularization: Float[Array, ""],
    least_free: float = 0.0,
) -> Float[Array, ""]:
    """`generalized_cross_validation` of the low-rank fit.

    It is inf where a factorisation fails, or where less than the share `least_free` of the
    residuals is free, tr(I − S)/D.
    """
    misfit, _, R, rows, ridge = _fitted(basis, K, X, Y, regularization)
    # tr(I − S) = D − r + δ tr (H + δI)⁻¹
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype), lower=True)
    free = Y.size - rows.shape[1] + ridge * jnp.sum(inverse**2)
    loss = jnp.where(free >= least_free * Y.size, misfit @ misfit * Y.size / free**2, jnp.inf)
    return _finite(loss, jnp.inf)


def low_rank_log_likelihood(
    basis: AbstractBasis,
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    regularization: Float[Array, ""],
) -> Float[Array, ""]:
    """`log_marginal_likelihood` of the low-rank prior; −inf where a factorisation fails."""
    misfit, w, R, rows, ridge = _fitted(basis, K, X, Y, regularization)
    # yᵀA⁻¹y = ‖y − Φw‖²/δ + ‖w‖², and det A = det(H + δI) δ^(D − r).
    square = misfit @ misfit / ridge + w @ w
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(R))) + (Y.size - rows.shape[1]) * jnp.log(ridge)
    constant = Y.size * jnp.log(2 * jnp.pi).astype(Y.dtype)
    return _finite(-0.5 * (square + log_det + constant), -jnp.inf)


def _rows(basis, K, X) -> Float[Array, "Nn r"]:
    return trained((K, X), basis.features, rowwise=True).reshape(X.size, -1)


def _fitted(basis, K, X, Y, regularization):
    rows, ridge, y = _rows(basis, K, X), len(X) * regularization, Y.reshape(-1)
    R = factor(_square(rows), ridge)
    w = cho_solve((R, True), rows.T @ y)
    return y - rows @ w, w, R, rows, ridge


def _finite(value: Float[Array, ""], otherwise: float) -> Float[Array, ""]:
    return jnp.where(jnp.isfinite(value), value, otherwise)
