"""The experiments of the paper, and the numbers that it published."""

import dataclasses
import math
from collections.abc import Callable, Mapping

from hamkernel._kernels.radial import Gaussian
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.structure import Separable, Symplectic
from hamkernel._structures.symmetry import Odd
from hamkernel.systems import AbstractHamiltonianSystem, HarmonicOscillator, Pendulum

# The regularization for which the ridge of `fit`, N · regularization, is the ridge that is meant.
READINGS: Mapping[str, Callable[[float, int], float]] = {
    "lambda": lambda regularization, N: regularization / N,
    "N*lambda": lambda regularization, N: regularization,
}

STRUCTURES: Mapping[str, Callable[[Gaussian], AbstractMatrixKernel]] = {
    "separable": Separable,
    "symplectic": Symplectic,
    "odd_symplectic": lambda k: Odd(Symplectic(k)),
}


@dataclasses.dataclass(frozen=True)
class Model:
    """A structure on a Gaussian, with the hyperparameters that the paper found for it.

    Attributes:
        structure: a key of `STRUCTURES`.
        lengthscale: σ of the Gaussian.
        regularization: λ.
    """

    structure: str
    lengthscale: float
    regularization: float

    @property
    def kernel(self) -> AbstractMatrixKernel:
        """The matrix-valued kernel."""
        return STRUCTURES[self.structure](Gaussian(self.lengthscale))


@dataclasses.dataclass(frozen=True)
class Published:
    """Tables I and II of the paper for one system: each came from a single noise seed."""

    odd_error_mean: float
    odd_error_variance: float
    true_hamiltonian_mean: float
    true_hamiltonian_variance: float
    learned_hamiltonian_mean: float
    learned_hamiltonian_variance: float


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A system, the data taken from it, the models learned and their test.

    Attributes:
        title: for people.
        system: the true system.
        initial_states: of the trajectories in the data.
        step: time between two data points [s].
        count: data points on each trajectory.
        noise: standard deviation on states and velocities.
        test_state: where the test trajectory starts.
        horizon: how long it runs [s].
        box: (q limits, p limits) of the portraits; its right half is sampled for the odd error.
        units: of q and p.
        models: the models by name.
        published: the paper's tables.
    """

    title: str
    system: AbstractHamiltonianSystem
    initial_states: tuple[tuple[float, float], ...]
    step: float
    count: int
    noise: float
    test_state: tuple[float, float]
    horizon: float
    box: tuple[tuple[float, float], tuple[float, float]]
    units: tuple[str, str]
    models: Mapping[str, Model]
    published: Published

    @property
    def size(self) -> int:
        """N, the number of data points."""
        return len(self.initial_states) * self.count


def experiments() -> dict[str, Experiment]:
    """Return the paper's experiments by name, the pendulum with both masses.

    Source: Smith & Egeland (2023), section Experiments. The symplectic kernel without the odd
        symmetry is not evaluated there; it takes σ and λ of the odd symplectic one.
    """
    oscillator = Experiment(
        title="Harmonic oscillator",
        system=HarmonicOscillator(mass=0.5, stiffness=1.0),
        initial_states=((1.0, 0.0), (2.25, 0.0), (3.5, 0.0)),
        step=0.25,
        count=5,
        noise=0.1,
        test_state=(2.0, 0.0),
        horizon=4.0,
        box=((-4.0, 4.0), (-4.0, 4.0)),
        units=("m", "kg m/s"),
        models=_models(separable=(19.5, 1e-4), odd_symplectic=(12.1, 1e-4)),
        published=Published(0.65, 0.08, 1.99, 5.43e-9, -108.54, 6.24e-9),
    )
    return {"harmonic_oscillator": oscillator} | {
        f"pendulum_m{mass:g}": _pendulum(mass) for mass in (0.5, 1.0)
    }


def _pendulum(mass: float) -> Experiment:
    return Experiment(
        title=f"Pendulum, m = {mass:g} kg",
        system=Pendulum(mass=mass, length=1.0, gravity=9.81),
        initial_states=((0.4 * math.pi, 0.0), (0.8 * math.pi, 0.0), (0.95 * math.pi, -4.0)),
        step=0.1,
        count=8,
        noise=0.01,
        test_state=(math.pi / 2, 0.0),
        horizon=2.0,
        box=((-math.pi, math.pi), (-8.0, 8.0)),
        units=("rad", "kg m²/s"),
        models=_models(separable=(12.3, 0.1), odd_symplectic=(3.0, 1e-4)),
        published=Published(7.87, 1.49, 9.81, 2.2e-6, -16.85, 1.34e-6),
    )


def _models(
    separable: tuple[float, float], odd_symplectic: tuple[float, float]
) -> dict[str, Model]:
    return {
        "separable": Model("separable", *separable),
        "symplectic": Model("symplectic", *odd_symplectic),
        "odd_symplectic": Model("odd_symplectic", *odd_symplectic),
    }
