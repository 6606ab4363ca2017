"""Learn Hamiltonian dynamics with structured kernels, by automatic differentiation in JAX."""

from hamkernel._field import KernelField
from hamkernel._fit import fit
from hamkernel._gram import gram
from hamkernel._scalar_product import Periodic, Polynomial
from hamkernel._scalar_radial import Gaussian, Matern, RationalQuadratic
from hamkernel._scalar_transform import Select, Warp
from hamkernel._solve import Cholesky
from hamkernel._structured import (
    CurlFree,
    DivergenceFree,
    Even,
    Odd,
    Separable,
    Sum,
    Symplectic,
)

__all__ = [  # noqa: RUF022 - in reading order
    # Scalar kernels.
    "Gaussian",
    "Matern",
    "RationalQuadratic",
    "Polynomial",
    "Periodic",
    "Warp",
    "Select",
    # Structured kernels.
    "Separable",
    "CurlFree",
    "DivergenceFree",
    "Symplectic",
    "Odd",
    "Even",
    "Sum",
    # Learning.
    "gram",
    "fit",
    "Cholesky",
    "KernelField",
]
