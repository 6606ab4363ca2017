"""What every factor of A = G + ridge I offers: each loss and posterior is written once on top.

A *system* says what A is; its cotangent has the same type. Its *factor* solves with it, and the
*inverse* C = A⁻¹, which need not be a matrix, has what validation losses and their derivatives
need.
"""

import abc
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hamkernel._factors.groups import Group

System = TypeVar("System", bound="AbstractSystem")

# A result is refused where ε cond(A) is larger, cond(A) above 9e13. At 1e13 the worst value and
# gradient of `tests/benchmarks/accuracy.py` were 2e-3 and 6e-3 off, at 1e14 2e-2 and 0.13, and at
# 1e16 by factors.
_TRUSTED = 2e-2


class AbstractBlocks(eqx.Module):
    """The blocks C_SS of some folds S, factored."""

    @abc.abstractmethod
    def solve(self, b: Float[Array, "F s"]) -> Float[Array, "F s"]:
        """(C_SS)⁻¹ b_S for each fold."""


class AbstractInverse(eqx.Module, Generic[System]):
    """C = A⁻¹, with the cotangents of A that the losses need."""

    @abc.abstractmethod
    def blocks(self, group: Group) -> AbstractBlocks:
        """The diagonal blocks of the folds of a group."""

    @abc.abstractmethod
    def pulled(
        self,
        u: Float[Array, " D"],
        w: Float[Array, " D"],
        inverse: Float[Array, ""] | None = None,
        square: Float[Array, ""] | None = None,
    ) -> System:
        """The cotangent of the system for Ā = u wᵀ + inverse · C + square · C²."""

    @abc.abstractmethod
    def pulled_folds(
        self,
        a: Float[Array, " D"],
        groups: list[Group],
        V: list[Float[Array, "F s"]],
        R: list[Float[Array, "F s"]],
        bars: tuple[Float[Array, " D"], Float[Array, " D"]],
    ) -> tuple[System, Float[Array, " D"]]:
        """The cotangent for Ā = Σ_S (C_:S v_S)(C_:S r_S)ᵀ − w aᵀ, and w = C (v + ā).

        Args:
            a: A⁻¹y.
            groups: of the folds S.
            V: v_S = (C_SS)⁻¹ r̄_S.
            R: r_S = (C_SS)⁻¹ a_S.
            bars: r̄ and ā.
        """


class AbstractFactor(eqx.Module, Generic[System]):
    """A, factored; NaN where it is not positive definite to rounding."""

    size: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def solve(self, b: Float[Array, "D *m"]) -> Float[Array, "D *m"]:
        """A⁻¹ b."""

    @abc.abstractmethod
    def solved(self, y: Float[Array, " D"]) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """The coefficients a = A⁻¹y, and yᵀA⁻¹y as a sum of squares."""

    @property
    @abc.abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Log det A."""

    @property
    @abc.abstractmethod
    def inverse_trace(self) -> Float[Array, ""]:
        """The trace of A⁻¹."""

    @abc.abstractmethod
    def inverse(self) -> AbstractInverse[System]:
        """C = A⁻¹."""

    def trusted(self, y: Float[Array, " D"]) -> Bool[Array, ""]:
        """Whether ε cond(A) leaves digits, with ‖A⁻¹‖ from two steps of the power method.

        They do not start from y, which may be an eigenvector.
        """
        b = jnp.cos(jnp.arange(len(y), dtype=y.dtype) ** 2)
        c = self.solve(b / jnp.linalg.norm(b))
        c = self.solve(c / jnp.linalg.norm(c))
        condition = jax.lax.stop_gradient(self.size * jnp.linalg.norm(c))
        return condition * jnp.finfo(y.dtype).eps <= _TRUSTED


class AbstractSystem(eqx.Module):
    """A = G + ridge I, before it is factored."""

    @abc.abstractmethod
    def factor(self) -> AbstractFactor:
        """Its factor."""


class CholeskyBlocks(AbstractBlocks):
    """Blocks by their own lower Cholesky factors."""

    lower: Float[Array, "F s s"]

    def __init__(self, blocks: Float[Array, "F s s"]):
        self.lower = jax.lax.linalg.cholesky(blocks, symmetrize_input=False)

    def solve(self, b: Float[Array, "F s"]) -> Float[Array, "F s"]:
        return jax.scipy.linalg.cho_solve((self.lower, True), b[..., None])[..., 0]
