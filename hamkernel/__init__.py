"""Learn Hamiltonian dynamics with structured kernels, by automatic differentiation in JAX.

Where things are, in the order of the data; a file imports from its own line and those above it:

    _scalar*                     scalar kernels k(x, z)
    _structured*                 matrix-valued kernels B [∂x ∂zᵀ k] Bᵀ, sums, odd and even ones
    _check*, _features*, _gram*  the test of a kernel; random features; the Gram and its products
    _field*                      what is learned: f and its potential
    _solve*, _least_squares, _streaming_sums
                                 how it is found
    _fit                         from data to a field
    _validation*, _folds, _inverse
                                 the losses in closed form
    _tune, _search*, _bounds, _objective
                                 hyperparameters by their gradients
    _simulate, _integrators*, _save*, systems, plot, paper
                                 what is done with fields

`_require` says what is wrong with an argument; `_devices`, `_memory`, `_trained`, `_callable` and
`_show` are used everywhere.
"""

import importlib
from typing import TYPE_CHECKING, Any

from hamkernel import systems
from hamkernel._check import check_kernel
from hamkernel._field import KernelField, SolverInfo
from hamkernel._field_features import FeatureField
from hamkernel._fit import fit
from hamkernel._gram import gram
from hamkernel._gram_operator import gram_operator
from hamkernel._save import load, save
from hamkernel._scalar_product import Periodic, Polynomial
from hamkernel._scalar_radial import Gaussian, Matern, RationalQuadratic
from hamkernel._scalar_transform import Select, Warp
from hamkernel._simulate import simulate
from hamkernel._solve import Cholesky
from hamkernel._solve_cg import ConjugateGradient
from hamkernel._solve_features import FeatureFit, RandomFeatures
from hamkernel._solve_nystrom import LandmarkFit, Nystrom
from hamkernel._structured import Even, Odd, Sum
from hamkernel._structured_operators import CurlFree, DivergenceFree, Separable, Symplectic
from hamkernel._tune import Tuned, tune
from hamkernel._validation import (
    cross_validation_loss,
    cross_validation_residuals,
    generalized_cross_validation,
    log_marginal_likelihood,
)

if TYPE_CHECKING:
    from hamkernel import paper, plot
    from hamkernel._integrators_gauss import GaussLegendre4, GaussLegendre6, ImplicitMidpoint
    from hamkernel._integrators_splitting import StormerVerlet, Yoshida4

__all__ = [  # noqa: RUF022 - in reading order
    # Scalar kernels.
    "Gaussian",
    "Matern",
    "RationalQuadratic",
    "Polynomial",
    "Periodic",
    "Warp",
    "Select",
    "check_kernel",
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
    "KernelField",
    "FeatureField",
    "LandmarkFit",
    "FeatureFit",
    "SolverInfo",
    "save",
    "load",
    # Fast and large: products without the Gram, and how `fit` finds the field.
    "gram_operator",
    "Cholesky",
    "Nystrom",
    "ConjugateGradient",
    "RandomFeatures",
    # Hyperparameters.
    "cross_validation_loss",
    "cross_validation_residuals",
    "generalized_cross_validation",
    "log_marginal_likelihood",
    "tune",
    "Tuned",
    # Simulation.
    "simulate",
    "ImplicitMidpoint",
    "GaussLegendre4",
    "GaussLegendre6",
    "StormerVerlet",
    "Yoshida4",
    # Doors: example systems, pictures, the paper's experiments.
    "systems",
    "plot",
    "paper",
]

# Loaded when first asked for, so that `import hamkernel` loads neither diffrax nor matplotlib.
_LAZY = {
    "ImplicitMidpoint": "_integrators_gauss",
    "GaussLegendre4": "_integrators_gauss",
    "GaussLegendre6": "_integrators_gauss",
    "StormerVerlet": "_integrators_splitting",
    "Yoshida4": "_integrators_splitting",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"hamkernel.{_LAZY[name]}"), name)
    if name in ("plot", "paper"):
        return importlib.import_module(f"hamkernel.{name}")
    raise AttributeError(f"module 'hamkernel' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
