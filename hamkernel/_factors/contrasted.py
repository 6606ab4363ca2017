"""A dense A of rows some of which see an unknown constant, in the direction p with ‖p‖ = 1.

With the constant estimated as well, C = A⁻¹ becomes

    C = A⁻¹ − A⁻¹p (pᵀA⁻¹p)⁻¹ pᵀA⁻¹ = Tᵀ (T A Tᵀ)⁻¹ T,

the rows of T an orthonormal basis of the complement of p. dC = −C dA C still holds, and so do the
residuals of held-out rows, (C_SS)⁻¹ (C y)_S, and their derivatives: each fit without a fold finds
the constant anew. T is the reflection of p to the first axis, without its first row.

Source: Dubrule (1983), Mathematical Geology 15, for held-out points with an unknown trend.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hamkernel._factors.base import AbstractBlocks, AbstractFactor, AbstractInverse, AbstractSystem
from hamkernel._factors.dense import DenseFactor, DenseInverse, DenseSystem, dense_factor
from hamkernel._factors.groups import Group


class ContrastedSystem(AbstractSystem):
    """A before the contrast, and p, with no negative entry, which is not differentiated."""

    matrix: Float[Array, "M M"]
    constant: Float[Array, " M"]

    def factor(self) -> "ContrastedFactor":
        p = jax.lax.stop_gradient(self.constant)
        inner = dense_factor(_contrast(p, _contrast(p, self.matrix).T))
        return ContrastedFactor(inner=inner, constant=p, size=inner.size)


class ContrastedFactor(AbstractFactor[ContrastedSystem]):
    """C = Tᵀ(T A Tᵀ)⁻¹T in the place of A⁻¹."""

    inner: DenseFactor
    constant: Float[Array, " M"]
    size: Float[Array, ""]

    def solve(self, b: Float[Array, "M *m"]) -> Float[Array, "M *m"]:
        return _spread(self.constant, self.inner.solve(_contrast(self.constant, b)))

    def solved(self, y: Float[Array, " M"]) -> tuple[Float[Array, " M"], Float[Array, ""]]:
        a, square = self.inner.solved(_contrast(self.constant, y))
        return _spread(self.constant, a), square

    @property
    def log_det(self) -> Float[Array, ""]:
        return self.inner.log_det

    @property
    def inverse_trace(self) -> Float[Array, ""]:
        return self.inner.inverse_trace

    def inverse(self) -> "ContrastedInverse":
        p = self.constant
        return ContrastedInverse(DenseInverse(_spread(p, _spread(p, self.inner.inverse().C).T)))

    def trusted(self, y: Float[Array, " M"]) -> Bool[Array, ""]:
        return self.inner.trusted(_contrast(self.constant, y))


class ContrastedInverse(AbstractInverse[ContrastedSystem]):
    """C as a matrix."""

    dense: DenseInverse

    def blocks(self, group: Group) -> AbstractBlocks:
        return self.dense.blocks(group)

    def pulled(self, u, w, inverse=None, square=None) -> ContrastedSystem:
        return _cotangent(self.dense.pulled(u, w, inverse, square))

    def pulled_folds(self, a, groups, V, R, bars) -> tuple[ContrastedSystem, Float[Array, " M"]]:
        dense, w = self.dense.pulled_folds(a, groups, V, R, bars)
        return _cotangent(dense), w


def _cotangent(dense: DenseSystem) -> ContrastedSystem:
    return ContrastedSystem(dense.matrix, jnp.zeros_like(dense.matrix[0]))


def _contrast(p: Float[Array, " M"], b: Float[Array, "M *m"]) -> Float[Array, "D *m"]:
    """T b."""
    return _reflected(p, b)[1:]


def _spread(p: Float[Array, " M"], c: Float[Array, "D *m"]) -> Float[Array, "M *m"]:
    """Tᵀ c."""
    return _reflected(p, jnp.concatenate([jnp.zeros_like(c[:1]), c]))


def _reflected(p: Float[Array, " M"], b: Float[Array, "M *m"]) -> Float[Array, "M *m"]:
    v = p.at[0].add(1.0)  # the reflection is I − vvᵀ/(1 + p₀)
    return b - jnp.tensordot(v / (1 + p[0]), v @ b, axes=0)
