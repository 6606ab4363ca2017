"""The field given observations, and what a solver keeps of them to say how far it may be off.

Of two linear functionals with covariances c with the rows of the data, the covariance given the
data is that before less what the data tell, c₁ᵀ A⁻¹ c₂ with A = G + σ²I. A prediction is a linear
functional as a measurement is, so both are blocks of rows, and every variance is one function.

New rows extend a factor: with A = RᵀR the factor of all is [[R, B], [0, S]], B = R⁻ᵀK₁₂ and
SᵀS = K₂₂ + σ²I − BᵀB. The variance σ² of a row stays as it was.
"""

import abc
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._factors.dense import DenseFactor, cholesky
from hamkernel._fields.base import AbstractField, SolverInfo, root
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.dense import plus_ridge
from hamkernel._gram.observed import between, gram_of_rows, rows_between
from hamkernel._machine.memory import refuse_beyond_memory
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.rows import Rows
from hamkernel._solvers.prior import Prior, of_features, prior_draws
from hamkernel._structures.base import AbstractMatrixKernel

Own = TypeVar("Own", bound="AbstractConditional")


class AbstractConditional(eqx.Module):
    """A Gaussian field f ~ GP(0, K) given rows of observations.

    Attributes:
        field: the conditional mean.
        rows: the observations.
        ridge: σ² = Nλ, the variance of the noise of a row, shape ().
    """

    field: eqx.AbstractVar[AbstractField]
    rows: eqx.AbstractVar[Rows]
    ridge: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """The covariance of the rows of two blocks, given the data."""

    @abc.abstractmethod
    def updated(self: Own, new: Rows) -> Own:
        """The same given new rows too, with the same σ²."""

    @abc.abstractmethod
    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        """Fields drawn given the data, every leaf with a leading axis of `count`."""


class FieldAlone(AbstractConditional):
    """Of a solver that keeps no factor."""

    field: KernelField
    rows: Rows
    ridge: Float[Array, ""]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        raise TypeError(NO_FACTOR)

    def updated(self, new: Rows) -> "FieldAlone":
        raise TypeError(NO_FACTOR)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        raise TypeError(NO_FACTOR)


NO_FACTOR = (
    "conjugate gradients find a field and keep no factor, so they cannot say how far it may be "
    "off. Use hk.condition(..., solver=hk.Cholesky()), which is exact, or solver=hk.Nystrom(), "
    "whose factor is small; for the field alone hk.fit."
)


class DenseConditional(AbstractConditional):
    """By the Cholesky factor of A; `representer` is c = A⁻¹y."""

    field: KernelField
    rows: Rows
    ridge: Float[Array, ""]
    factor: DenseFactor
    representer: Float[Array, " D"]

    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        told = self._told(left)
        other = told if right is left else self._told(right)
        return between(self.field.kernel, left, right) - told.T @ other

    def _told(self, block: AbstractBlock) -> Float[Array, "D d"]:
        """R⁻ᵀ c."""
        return self.factor.whiten(rows_between(self.field.kernel, self.rows, block))

    def updated(self, new: Rows) -> "DenseConditional":
        factor, c, field = _extended(self, new)
        field = _solved(field, 0 * field.norm, "the rows that were added")
        return DenseConditional(field, self.rows.joined(new), self.ridge, factor, c)

    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> KernelField:
        before, noise = jax.random.split(key)
        prior = prior_draws(self.field.kernel, self.rows.points, region, before, count)
        return _corrected(self, prior, noise)


def dense_conditional(
    K: AbstractMatrixKernel, rows: Rows, regularization: Float[Array, ""], throw: bool = True
) -> DenseConditional:
    """The field given the rows, by the dense Gram of them: O(D³) time and O(D²) memory.

    Raises:
        ValueError: the matrices do not fit in memory. RuntimeError: A is not positive definite to
            rounding. AttributeError: energies of a structure without potential.
    """
    check_potential(K, rows)
    cure = "Use solver=hk.Nystrom(), or a part of the data."
    what = f"conditioning on {rows.size} rows of observations"
    refuse_beyond_memory(what, rows.size, rows.size, rows.targets.dtype, _COPIES, cure)
    ridge = rows.count * regularization
    factor, c, field, left = _dense(K, rows, regularization, ridge)
    field = _solved(field, left, "the data", throw)
    return DenseConditional(field, rows, ridge, factor, c)


def check_potential(K: AbstractMatrixKernel, rows: Rows) -> None:
    """AttributeError if there are energies and no potential."""
    if len(rows.energies) and K.no_potential:
        raise AttributeError(f"energies were given, and {K.no_potential}")


_COPIES = 3  # of A: itself, its factor, and rows of the contrast or of a part
_SOLVED = 1e-2  # ‖y − (G + σ²I)c‖/‖y‖ up to which it counts as solved, as in `Cholesky`


@eqx.filter_jit
def _dense(K, rows, regularization, ridge):
    G, y = gram_of_rows(K, rows), rows.y
    A = plus_ridge(G, ridge)
    factor = DenseFactor(A)
    c = jax.lax.custom_linear_solve(
        lambda v: A @ v, y, lambda _, b: factor.solve(b), symmetric=True
    )
    left = jax.lax.stop_gradient(y - A @ c)
    scale = jnp.linalg.norm(jax.lax.stop_gradient(y))
    left = jnp.linalg.norm(left) / jnp.where(scale > 0, scale, jnp.ones_like(scale))
    info = SolverInfo("Cholesky", relative_residual=left)
    residual, norm = rows.residual(ridge * c), root(c @ (G @ c))
    return factor, c, field_of_rows(K, rows, c, residual, norm, regularization, info), left


@eqx.filter_jit
def _extended(old: DenseConditional, new: Rows):
    K, R, rows = old.field.kernel, old.factor.R, old.rows.joined(new)
    # The contrasts of new energies reach back to the old ones.
    beside, fresh = old.rows.beside(new), rows.size - old.rows.size
    across = [rows_between(K, old.rows, block) for block in beside.blocks]
    across = beside.contrast(jnp.concatenate(across, axis=1).T)[-fresh:].T  # (D, fresh)
    B = old.factor.whiten(across)
    own = plus_ridge(gram_of_rows(K, beside)[-fresh:, -fresh:], old.ridge) - B.T @ B
    zero = jnp.zeros((fresh, len(R)), R.dtype)
    R = jnp.block([[R, B], [zero, cholesky(own)]])
    factor = eqx.tree_at(lambda f: f.R, old.factor, R)
    y = rows.y
    c = factor.solve(y)
    regularization = old.ridge / rows.count
    residual, norm = rows.residual(old.ridge * c), root(c @ (y - old.ridge * c))
    info = SolverInfo("Cholesky")
    return factor, c, field_of_rows(K, rows, c, residual, norm, regularization, info)


@eqx.filter_jit
def _corrected(given: DenseConditional, prior: Prior, key) -> KernelField:
    """Matheron's rule, for every draw of the prior."""
    rows, n = given.rows, given.rows.dimension
    d = rows.points.shape[1]
    would = prior.rows(rows)  # (D, count)
    noise = jnp.sqrt(given.ridge) * jax.random.normal(key, would.shape, would.dtype)
    c = given.factor.solve(rows.y[:, None] - would - noise)

    def one(c, coefficients, basis, w):
        Z, A, S, b = rows.coefficients(c)
        return KernelField(
            kernel=prior.kernel,
            points=jnp.concatenate([Z, prior.points]),
            coefficients=jnp.concatenate([A, coefficients]),
            residual=jnp.zeros((0, n), c.dtype),
            norm=jnp.full((), jnp.inf, c.dtype),
            regularization=given.field.regularization,
            offset=jnp.zeros((), c.dtype),
            info=SolverInfo("draw"),
            value_points=S if len(S) else None,
            value_coefficients=b if len(S) else None,
            mean=None if basis is None else of_features(prior.kernel, basis, w, d),
        )

    return jax.vmap(one)(c.T, prior.coefficients, prior.features, prior.weights)


def field_of_rows(
    K: AbstractMatrixKernel,
    rows: Rows,
    c: Float[Array, " D"],
    residual: Float[Array, "..."],
    norm: Float[Array, ""],
    regularization: Float[Array, ""],
    info: SolverInfo,
) -> KernelField:
    """The field Σ c_r L_r K, at the points of the rows."""
    Z, A, S, b = rows.coefficients(c)
    return KernelField(
        kernel=K,
        points=Z,
        coefficients=A,
        residual=residual,
        norm=norm,
        regularization=regularization,
        offset=jnp.zeros((), c.dtype),
        info=info,
        value_points=S if len(S) else None,
        value_coefficients=b if len(S) else None,
    )


def _solved(field: KernelField, left: Array, of: str, throw: bool = True) -> KernelField:
    """The field, if the factorisation succeeded."""
    dtype = field.offset.dtype

    def message() -> str:
        return (
            f"the Gram of {of} plus the ridge N * regularization is not positive definite to "
            f"rounding in {dtype}. Likely causes, in order: the regularization is too small for "
            "this Gram (points that coincide or lie close together for the lengthscale make it "
            "singular): raise it; noise levels that are too different; float32 where float64 is "
            "needed: jax.config.update('jax_enable_x64', True); a kernel that is not positive "
            "definite or not finite: hk.check_kernel(k, X) finds out."
        )

    def learned(f):
        return [f.coefficients, f.residual, f.norm]

    failed = ~(require.on_host(left) <= _SOLVED)
    values = require.value(learned(field), failed, message, RuntimeError, throw)
    return eqx.tree_at(learned, field, values)
