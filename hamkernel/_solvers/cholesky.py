"""Regularised least squares by a dense factorisation: (G + NλI) a = y."""

import abc
from typing import ClassVar, Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from hamkernel._fields.base import AbstractField
from hamkernel._fields.kernel_field import KernelField
from hamkernel._machine.devices import on_one_device
from hamkernel._observations.rows import Rows
from hamkernel._solvers.conditional import (
    AbstractConditional,
    DenseConditional,
    dense_conditional,
    dense_field,
)
from hamkernel._solvers.spans import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel

Learned = TypeVar("Learned", bound=AbstractField, covariant=True)


class AbstractSolver(eqx.Module, Generic[Learned]):
    """How `fit` finds the field."""

    no_factor: ClassVar[str | None] = None  # why it cannot say how far the field may be off
    is_low_rank: ClassVar[bool] = False  # whether `tune` is to judge by the loss in its `_basis`

    def _basis(
        self, K: AbstractMatrixKernel, X: Float[Array, "N n"], regularization: Float[Array, ""]
    ) -> AbstractBasis | None:
        """The features of a fit of low rank, as functions of the hyperparameters."""
        del K, X, regularization
        return None

    @abc.abstractmethod
    def _fitted(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> Learned:
        """The field for data that has been checked; of NaN if it fails and does not `throw`."""

    def _fitted_rows(
        self,
        K: AbstractMatrixKernel,
        rows: Rows,
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> AbstractField:
        """The same for any observations."""
        return self._given(K, rows, regularization, throw).field

    def _given(
        self,
        K: AbstractMatrixKernel,
        rows: Rows,
        regularization: Float[Array, ""],
        throw: bool = True,
    ) -> AbstractConditional:
        """The same with what the solver keeps, to say how far the field may be off."""
        del K, rows, regularization, throw
        raise TypeError(self.no_factor)


class Cholesky(AbstractSolver[KernelField]):
    """The dense Gram and its Cholesky factor: exact, O((N n)³) time and O((N n)²) memory.

    `field.info.relative_residual` is the error that rounding leaves in the linear system; a fit in
    which it is more than one per cent of the velocities is refused.

    Raises:
        ValueError, from `fit`: the matrices do not fit in memory. RuntimeError, from `fit`: the
            ridge is too small for this Gram (the text says what to do).
    """

    def _fitted(self, K, X, Y, regularization, throw=True) -> KernelField:
        X, Y = on_one_device("X", X), on_one_device("Y", Y)
        return dense_field(K, X, Y, regularization, throw)

    def _given(self, K, rows, regularization, throw=True) -> DenseConditional:
        return dense_conditional(K, rows, regularization, throw)
