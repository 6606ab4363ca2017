"""What every solver offers: the field, and where it can, what says how far that may be off."""

import abc
from typing import ClassVar, Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from hamkernel._fields.base import AbstractField
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.conditional import AbstractConditional
from hamkernel._solvers.problem import Problem
from hamkernel._solvers.spans import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel

Learned = TypeVar("Learned", bound=AbstractField, covariant=True)


class AbstractSolver(eqx.Module, Generic[Learned]):
    """How `fit` finds the field."""

    no_factor: ClassVar[str | None] = None  # why it cannot say how far the field may be off
    is_low_rank: ClassVar[bool] = False  # whether `tune` is to judge by the loss in its `_basis`

    def _basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> AbstractBasis | None:
        """The features of a fit of low rank, as functions of the hyperparameters."""
        del K, rows, regularization
        return None

    @abc.abstractmethod
    def _fitted(self, problem: Problem, throw: bool = True, progress: bool = False) -> Learned:
        """The field; of NaN if the solve fails and does not `throw`."""

    def _given(
        self, problem: Problem, throw: bool = True, progress: bool = False
    ) -> AbstractConditional:
        """The same with what the solver keeps, to say how far the field may be off."""
        del problem, throw, progress
        raise TypeError(self.no_factor)
