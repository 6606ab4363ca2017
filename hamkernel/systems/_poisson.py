"""Systems ẋ = Π(x)∇H whose Π is not J."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._show import described
from hamkernel.poisson import charged_particle, lotka_volterra, rigid_body
from hamkernel.systems._base import (
    Numbers,
    at,
    in_precision,
    log_parameter,
    positive,
    signed_parameter,
)


class AbstractPoissonSystem(eqx.Module):
    """A Hamiltonian H(x) and an antisymmetric Π(x), and the field Π∇H that follows from them."""

    @abc.abstractmethod
    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the energy H(x) of one state, shape ()."""

    @abc.abstractmethod
    def tensor(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n n"]:
        """Return Π(x), antisymmetric, shape (n, n)."""

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """Return the velocity Π(x)∇H(x) of one state, by automatic differentiation.

        Args:
            x: one state, shape (n,); `jax.vmap(system)` takes many.

        Returns:
            The velocity, shape (n,).

        Raises:
            ValueError: x is not one state of this system.
        """
        x = require.floating(x, "x")
        return _velocity(self, x)

    def __repr__(self) -> str:
        return described(self)


@eqx.filter_jit
def _velocity(system: AbstractPoissonSystem, x: Float[Array, " n"]) -> Float[Array, " n"]:
    system = in_precision(system, x.dtype)
    return system.tensor(x) @ jax.grad(system.hamiltonian)(x)


class RigidBody(AbstractPoissonSystem):
    """A body that turns freely: H = Σᵢ Lᵢ²/(2Iᵢ), L̇ = L × ω with ω = ∇H, n = 3.

    L is the angular momentum along the principal axes of the body [kg m²/s]. |L|² is a Casimir.
    With three different moments the rotation about the middle axis is unstable.

    Args:
        inertia: the principal moments (I₁, I₂, I₃), positive [kg m²].

    Raises:
        ValueError: a moment is not positive, or there are not three.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration (2nd ed., 2006), VII.5.
    """

    log_inertia: Float[Array, "3"]
    inertia = positive("inertia", "The principal moments of inertia.")

    def __init__(self, inertia: Numbers = (1.0, 2.0, 3.0)):
        self.log_inertia = log_parameter(inertia, "inertia", (3,))

    def hamiltonian(self, x: Num[ArrayLike, "3"]) -> Float[Array, ""]:
        """Return H(L), shape (); ValueError unless L has shape (3,)."""
        self, L = at(self, x, 3)
        return jnp.sum(L**2 / (2 * self.inertia))

    def tensor(self, x: Num[ArrayLike, "3"]) -> Float[Array, "3 3"]:
        """Return the matrix of v -> L × v."""
        return rigid_body(require.point(x, 3))

    def casimir(self, x: Num[ArrayLike, "3"]) -> Float[Array, ""]:
        """Return |L|², which every field Π∇H conserves, shape ()."""
        L = require.point(x, 3)
        return L @ L


class LotkaVolterra(AbstractPoissonSystem):
    """Prey x and predators y: ẋ = αx − βxy, ẏ = δxy − γy, n = 2, both positive.

    H = δx − γ log x + βy − α log y with Π = [[0, −xy], [xy, 0]]. The equilibrium is (γ/δ, α/β).

    Args:
        growth: α > 0, of the prey [1/s].
        predation: β > 0 [1/s per predator].
        death: γ > 0, of the predators [1/s].
        reproduction: δ > 0, of the predators [1/s per prey].

    Raises:
        ValueError: a parameter is not a positive scalar.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration (2nd ed., 2006), I.1 and VII.2.
    """

    log_growth: Float[Array, ""]
    log_predation: Float[Array, ""]
    log_death: Float[Array, ""]
    log_reproduction: Float[Array, ""]
    growth = positive("growth", "The growth of the prey.")
    predation = positive("predation", "The rate at which each predator eats prey.")
    death = positive("death", "The death rate of the predators.")
    reproduction = positive("reproduction", "The growth of the predators by each prey.")

    def __init__(
        self,
        growth: ArrayLike = 1.0,
        predation: ArrayLike = 1.0,
        death: ArrayLike = 1.0,
        reproduction: ArrayLike = 1.0,
    ):
        self.log_growth = log_parameter(growth, "growth")
        self.log_predation = log_parameter(predation, "predation")
        self.log_death = log_parameter(death, "death")
        self.log_reproduction = log_parameter(reproduction, "reproduction")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x, y), shape (); NaN where a population is negative."""
        self, (prey, predators) = at(self, x, 2)
        of_prey = self.reproduction * prey - self.death * jnp.log(prey)
        return of_prey + self.predation * predators - self.growth * jnp.log(predators)

    def tensor(self, x: Num[ArrayLike, "2"]) -> Float[Array, "2 2"]:
        """Return [[0, −xy], [xy, 0]]."""
        return lotka_volterra(require.point(x, 2))


class ChargedParticle(AbstractPoissonSystem):
    """A charge in a plane, held by a spring, in a magnetic field normal to the plane: n = 4.

    q̇ = p/m, ṗ = −κq + (b/m)(p₂, −p₁) with H = |p|²/(2m) + κ|q|²/2, p = mq̇ the KINETIC momentum.
    Without a spring it circles at the angular frequency b/m.

    Args:
        mass: m > 0 [kg].
        stiffness: κ of either sign [N/m].
        magnetic_field: b = e·B of either sign [kg/s].

    Raises:
        ValueError: the mass is not a positive scalar, or another parameter not a finite one.

    Source: Landau & Lifshitz, The Classical Theory of Fields (4th ed., 1975), sections 17 and 21.
    """

    log_mass: Float[Array, ""]
    stiffness: Float[Array, ""]
    magnetic_field: Float[Array, ""]
    mass = positive("mass", "The mass m.")

    def __init__(
        self, mass: ArrayLike = 1.0, stiffness: ArrayLike = 1.0, magnetic_field: ArrayLike = 1.0
    ):
        self.log_mass = log_parameter(mass, "mass")
        self.stiffness = signed_parameter(stiffness, "stiffness")
        self.magnetic_field = signed_parameter(magnetic_field, "magnetic_field")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(q, p), shape (); ValueError unless x has shape (4,)."""
        self, x = at(self, x, 4)
        q, p = jnp.split(x, 2)
        return p @ p / (2 * self.mass) + self.stiffness * q @ q / 2

    def tensor(self, x: Num[ArrayLike, "4"]) -> Float[Array, "4 4"]:
        """Return Π = [[0, I], [−I, F]], F v = v × B."""
        self, x = at(self, x, 4)
        return charged_particle(lambda q: self.magnetic_field)(x)
