"""The losses of observations of any kind: those of `losses.py` with rows in the place of points.

Residuals count in units of their relative noise. With energies among the data C = A⁻¹ becomes

    C = A⁻¹ − A⁻¹p (pᵀA⁻¹p)⁻¹ pᵀA⁻¹ = Tᵀ (T A Tᵀ)⁻¹ T,

p the direction of their unknown constant and T the contrasts without it. Then dC = −C dA C holds
still, and so do the residuals of held-out rows, (C_SS)⁻¹ (C y)_S, and their derivatives: each fit
without a fold finds the constant anew.

Source: Dubrule (1983), Mathematical Geology 15, for held-out points with an unknown trend.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from hamkernel._factors.base import AbstractBlocks, AbstractFactor, AbstractInverse, AbstractSystem
from hamkernel._factors.dense import DenseFactor, DenseInverse, DenseSystem
from hamkernel._factors.groups import Group
from hamkernel._gram.dense import plus_ridge
from hamkernel._gram.derivatives import trained
from hamkernel._gram.observed import gram_before_contrast
from hamkernel._observations.rows import Rows
from hamkernel._validation.closed_forms import free_residuals, held_out, log_density
from hamkernel._validation.folds import Folds, Partition


class ContrastedSystem(AbstractSystem):
    """A of rows that see an unknown constant, before the contrast; `rows` is not differentiated."""

    matrix: Float[Array, "M M"]
    rows: Rows

    def factor(self) -> "ContrastedFactor":
        rows = jax.lax.stop_gradient(self.rows)
        half = rows.contrast(self.matrix)
        inner = DenseFactor(rows.contrast(half.T))
        return ContrastedFactor(inner=inner, rows=rows, size=inner.size)


class ContrastedFactor(AbstractFactor[ContrastedSystem]):
    """C = Tᵀ(T A Tᵀ)⁻¹T in the place of A⁻¹."""

    inner: DenseFactor
    rows: Rows
    size: Float[Array, ""]

    def solve(self, b: Float[Array, "M *m"]) -> Float[Array, "M *m"]:
        return self.rows.uncontrasted(self.inner.solve(self.rows.contrast(b)))

    def solved(self, y: Float[Array, " M"]) -> tuple[Float[Array, " M"], Float[Array, ""]]:
        a, square = self.inner.solved(self.rows.contrast(y))
        return self.rows.uncontrasted(a), square

    @property
    def log_det(self) -> Float[Array, ""]:
        return self.inner.log_det

    @property
    def inverse_trace(self) -> Float[Array, ""]:
        return self.inner.inverse_trace

    def inverse(self) -> "ContrastedInverse":
        C = self.rows.uncontrasted(self.inner.inverse().C)
        return ContrastedInverse(DenseInverse(self.rows.uncontrasted(C.T)), self.rows)

    def trusted(self, y: Float[Array, " M"]) -> Bool[Array, ""]:
        return self.inner.trusted(self.rows.contrast(y))


class ContrastedInverse(AbstractInverse[ContrastedSystem]):
    """C as a matrix."""

    dense: DenseInverse
    rows: Rows

    def _system(self, dense: DenseSystem) -> ContrastedSystem:
        arrays, rest = eqx.partition(self.rows, eqx.is_inexact_array)
        nothing = eqx.combine(jax.tree.map(jnp.zeros_like, arrays), _no_tangent(rest))
        return ContrastedSystem(dense.matrix, nothing)

    def blocks(self, group: Group) -> AbstractBlocks:
        return self.dense.blocks(group)

    def pulled(self, u, w, inverse=None, square=None) -> ContrastedSystem:
        return self._system(self.dense.pulled(u, w, inverse, square))

    def pulled_folds(self, a, groups, V, R) -> tuple[ContrastedSystem, Float[Array, " M"]]:
        dense, w = self.dense.pulled_folds(a, groups, V, R)
        return self._system(dense), w


def _no_tangent(tree):
    """Cotangents of integers, as JAX wants them."""
    return jax.tree.map(lambda a: np.zeros(a.shape, jax.dtypes.float0), tree)


@eqx.filter_jit
def rows_partition_loss(K, rows: Rows, regularization, partition: Partition):
    """`cross_validation_loss`: the mean over folds of the mean over their rows."""
    r = rows_residuals(K, rows, regularization, partition)
    return jnp.asarray(partition.weights, r.dtype) @ r**2


@eqx.filter_jit
def rows_residuals(K, rows: Rows, regularization, partition: Partition) -> Float[Array, " M"]:
    """What a fit without their fold leaves of the rows, in units of their noise."""
    share = 1 - 1 / len(partition.folds)
    A = plus_ridge(_gram(K, rows), rows.count * share * regularization)
    system = ContrastedSystem(A, rows) if len(rows.energies) else DenseSystem(A)
    return held_out(system, rows.targets, partition)


@eqx.filter_jit
def rows_generalized_loss(K, rows: Rows, regularization, least_free=0.0):
    """`generalized_cross_validation` of the rows."""
    ridge = rows.count * regularization
    squares, trace = free_residuals(_contrasted(K, rows, ridge), rows.y)
    enough = ridge * trace >= least_free * rows.size
    return jnp.where(enough, squares * rows.size / trace**2, jnp.inf)


@eqx.filter_jit
def rows_log_likelihood(K, rows: Rows, regularization):
    """`log_marginal_likelihood`: with energies, of a flat prior of their constant."""
    density = log_density(_contrasted(K, rows, rows.count * regularization), rows.y)
    density = density - jnp.sum(jnp.log(rows.scale))
    if not len(rows.energies):
        return density
    return density - 0.5 * jnp.log(jnp.sum(rows.scale[rows.energies] ** -2))  # |p|


def _contrasted(K, rows: Rows, ridge) -> DenseSystem:
    G = _gram(K, rows)
    if len(rows.energies):
        G = rows.contrast(rows.contrast(G).T)
    return DenseSystem(plus_ridge(G, ridge))


def _gram(K, rows: Rows) -> Float[Array, "M M"]:
    arrays, rest = eqx.partition(rows, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(arrays)

    def make(rest, K, flat):
        return gram_before_contrast(K, eqx.combine(unravel(flat), rest))

    return trained((K, flat), jax.tree_util.Partial(make, rest))


def rows_partition(rows: Rows, folds: Folds) -> Partition:
    """The folds of the rows from those of the observations that they belong to."""
    labels = Partition(rows.count, folds).labels
    return Partition(len(rows.targets), labels[rows.labels()])
