"""Which linear maps of both arguments are known to leave a scalar kernel as it is.

What is known holds for ALL values of the hyperparameters, for training changes them: lengthscales
that happen to be equal today say nothing.
"""

import functools

import numpy as np
from jaxtyping import Float

from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Invariance,
    ScalarProduct,
    ScalarSum,
    Scaled,
)
from hamkernel._kernels.dot_products import Periodic, Polynomial
from hamkernel._kernels.groups import is_diagonal, is_orthogonal, is_permutation
from hamkernel._kernels.radial import AbstractRadialKernel


@functools.singledispatch
def known_unchanged(k: AbstractScalarKernel, S: Float[np.ndarray, "n n"]) -> bool:
    """Whether k(Sx, Sz) = k(x, z) is known to hold; False where it is not known."""
    identity = np.eye(len(S))
    if np.array_equal(S, identity):
        return True
    return np.array_equal(S, -identity) and Invariance.REFLECTION in k.invariance


@known_unchanged.register
def _(k: AbstractRadialKernel, S) -> bool:
    """A lengthscale for each coordinate allows changes of sign, one for all every rotation."""
    return is_orthogonal(S) and (k.log_lengthscale.ndim == 0 or is_diagonal(S))


@known_unchanged.register
def _(k: Polynomial, S) -> bool:
    return is_orthogonal(S)


@known_unchanged.register
def _(k: Periodic, S) -> bool:
    alike = k.log_lengthscale.ndim == k.log_period.ndim == 0
    return is_permutation(S) and (alike or is_diagonal(S))


@known_unchanged.register
def _(k: Scaled, S) -> bool:
    return known_unchanged(k.kernel, S)


@known_unchanged.register(ScalarSum)
@known_unchanged.register(ScalarProduct)
def _(k, S) -> bool:
    return all(known_unchanged(term, S) for term in k.terms)
