"""Regularised least squares by a dense factorisation: (G + NλI) a = y."""

from hamkernel._fields.kernel_field import KernelField
from hamkernel._solvers.base import AbstractSolver
from hamkernel._solvers.conditional import DenseConditional, dense_conditional, dense_field


class Cholesky(AbstractSolver[KernelField]):
    """The dense Gram and its Cholesky factor: exact, O((N n)³) time and O((N n)²) memory.

    `field.info.relative_residual` is the error that rounding leaves in the linear system; a fit in
    which it is more than one per cent of the velocities is refused.

    Raises:
        ValueError, from `fit`: the matrices do not fit in memory. RuntimeError, from `fit`: the
            ridge is too small for this Gram (the text says what to do).
    """

    def _fitted(self, problem, throw=True, progress=False) -> KernelField:
        return dense_field(problem.on_one_device(), throw, progress)

    def _given(self, problem, throw=True, progress=False) -> DenseConditional:
        return dense_conditional(problem.on_one_device(), throw, progress)
