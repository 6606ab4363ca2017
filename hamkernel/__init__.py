"""Learn Hamiltonian dynamics with structured kernels, by automatic differentiation in JAX.

    field = hk.fit(hk.Symplectic(hk.Gaussian(2.0)), X, Y)    # from states and velocities
    learned = hk.learn(K, hk.Runs(times, states))            # from noisy states alone
    tuned = hk.tune(K, X, Y)                                 # with its hyperparameters
    posterior = hk.condition(K, X, Y, 1e-4)                  # with error bars
    orbit = hk.simulate(field, x0, ts).ys

Data flows from kernels to fields through these folders and files. Each imports only from itself and
from the ones above:

    _kernels      scalar kernels k(x, z), and any callable as one
    _structures   matrix-valued kernels B [∂x ∂zᵀ k] Bᵀ, sums, symmetries; tensors in `poisson`
    _observations measurements, as rows of linear functionals
    _gram         the Gram as a matrix, its parts, and its derivatives
    _gram_operator
                  products with the Gram, tile by tile
    _features     random Fourier features
    _fields       learned fields f with their potentials
    _solvers      solvers: dense, conjugate gradients, low rank, streams; factors of G + ridge I
    _posterior    a field with its uncertainty
    _closed_forms held-out residuals and the likelihood, from any factor of G + ridge I
    _validation   validation losses, each by one factorisation
    _tuning       hyperparameters, by gradients
    _runs         logs: their faults, smoothing, and flows along them
    _learned      results of learning, their diagnostics and scores: may the field be used?
    _trajectories, _weak, _learn
                  from logs to a field, by iterations or by weak rows
    _discovery    a formula for the potential, and tests of which physics the data obey
    _symplectic, _simulate
                  symplectic integrators, and trajectories of any field
    _save         fields and results in files
    systems, plot, paper
                  example systems, pictures, the paper's experiments
    _report, _command
                  a result as a page of HTML, and a program from CSV files to such a page

`_require` checks arguments, `_show` prints objects, `_machine` handles devices, memory, precision
and threads, and `_sizes` sets the sizes of tiles and batches.
"""

import importlib
from typing import TYPE_CHECKING, Any

from hamkernel import poisson, systems
from hamkernel._discovery.compare import compare
from hamkernel._discovery.formula import Formula
from hamkernel._discovery.readout import readout
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.expansions import FeatureField, KernelField
from hamkernel._fields.joined import ControlledField, FamilyField
from hamkernel._fields.kinetic import kinetic
from hamkernel._fields.lagrangian import LagrangianField
from hamkernel._gram import gram
from hamkernel._gram_operator import gram_operator
from hamkernel._kernels.built_in import Gaussian, Matern, Periodic, Polynomial, RationalQuadratic
from hamkernel._kernels.check import check_kernel
from hamkernel._kernels.parts import Shared, neighbours, pairs, sites
from hamkernel._kernels.transforms import Select, Warp
from hamkernel._learn import learn
from hamkernel._learned.result import Learned
from hamkernel._learned.score import Score
from hamkernel._observations.kinds import Energies, Equilibria, Functionals, Velocities
from hamkernel._posterior import Posterior, condition
from hamkernel._report import report
from hamkernel._runs.runs import Runs
from hamkernel._save import load, save
from hamkernel._solvers.conjugate_gradient import ConjugateGradient
from hamkernel._solvers.dense import Cholesky
from hamkernel._solvers.fit import fit
from hamkernel._solvers.nystrom import LandmarkFit, Nystrom
from hamkernel._solvers.random_features import FeatureFit, RandomFeatures
from hamkernel._structures.base import Even, Invariant, Odd, Reversible, Sum
from hamkernel._structures.custom_operator import Poisson, Structured
from hamkernel._structures.family import Family
from hamkernel._structures.friction import Friction, PortHamiltonian
from hamkernel._structures.joined import Controlled, InputMatrix
from hamkernel._structures.lagrangian import Lagrangian
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import CurlFree, DivergenceFree, Separable, Symplectic
from hamkernel._tuning.tune import Tuned, tune
from hamkernel._validation import (
    cross_validation_loss,
    cross_validation_residuals,
    generalized_cross_validation,
    log_marginal_likelihood,
)
from hamkernel._weak.lagrangian import LearnedLagrangian

if TYPE_CHECKING:
    from hamkernel import paper, plot
    from hamkernel._simulate import simulate
    from hamkernel._symplectic import (
        GaussLegendre4,
        GaussLegendre6,
        ImplicitMidpoint,
        StormerVerlet,
        Yoshida4,
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
    "Shared",
    "pairs",
    "neighbours",
    "sites",
    "check_kernel",
    # Structured kernels.
    "Separable",
    "CurlFree",
    "DivergenceFree",
    "Symplectic",
    "PortHamiltonian",
    "Friction",
    "Poisson",
    "Structured",
    "poisson",
    "Odd",
    "Even",
    "Reversible",
    "Invariant",
    "Controlled",
    "Family",
    "InputMatrix",
    "UnknownMasses",
    "Lagrangian",
    "Sum",
    # Observations.
    "Velocities",
    "Energies",
    "Equilibria",
    "Functionals",
    # Learning.
    "gram",
    "fit",
    "condition",
    "Posterior",
    "KernelField",
    "FeatureField",
    "ControlledField",
    "FamilyField",
    "LagrangianField",
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
    # Logged runs.
    "Runs",
    "kinetic",
    "learn",
    "Learned",
    "LearnedLagrangian",
    "Score",
    "report",
    # Discovery.
    "compare",
    "readout",
    "Formula",
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

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # Loaded when first asked for, so that `import hamkernel` loads neither diffrax nor matplotlib.
    if name in ("plot", "paper"):
        return importlib.import_module(f"hamkernel.{name}")
    if name in __all__:  # `simulate` and the integrators, which are not loaded yet
        file = "_simulate" if name == "simulate" else "_symplectic"
        return getattr(importlib.import_module(f"hamkernel.{file}"), name)
    raise AttributeError(f"module 'hamkernel' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
