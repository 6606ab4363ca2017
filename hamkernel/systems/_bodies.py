"""Bodies that attract each other, vortices, and systems ẋ = Π(x)∇H with Π ≠ J."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._show import describe
from hamkernel.poisson import charged_particle, lotka_volterra, rigid_body
from hamkernel.systems._base import (
    AbstractHamiltonianSystem,
    Numbers,
    cast_arrays,
    cast_state,
    count_of,
    log_parameter,
    positive_parameter,
    require_shape,
    signed_parameter,
    squared_distances,
)


class Kepler(AbstractHamiltonianSystem):
    """The relative motion of two bodies in their plane: H = |p|²/(2μ) − GMμ/|q|, n = 4.

    q is the vector from one body to the other [m], p = μq̇ [kg m/s], μ = m₁m₂/(m₁+m₂) the reduced
    mass and M = m₁+m₂. An ellipse of semi-major axis a takes 2π√(a³/GM). At q = 0 the energy is
    −inf and the field NaN. `NBody` moves both bodies.

    Args:
        reduced_mass: μ > 0 [kg].
        gravitational_parameter: GM > 0 [m³/s²].

    Raises:
        ValueError: a parameter is not a positive scalar.

    Source: Goldstein, Poole & Safko, Classical Mechanics (3rd ed., 2002), chapter 3.
    """

    is_separable: ClassVar[bool] = True

    log_reduced_mass: Float[Array, ""]
    log_gravitational_parameter: Float[Array, ""]
    reduced_mass = positive_parameter("reduced_mass", "The reduced mass μ.")
    gravitational_parameter = positive_parameter(
        "gravitational_parameter", "The gravitational parameter GM."
    )

    def __init__(self, reduced_mass: ArrayLike = 1.0, gravitational_parameter: ArrayLike = 1.0):
        self.log_reduced_mass = log_parameter(reduced_mass, "reduced_mass")
        self.log_gravitational_parameter = log_parameter(
            gravitational_parameter, "gravitational_parameter"
        )

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = cast_state(self, x, 4)
        q, p = jnp.split(x, 2)
        potential = -self.gravitational_parameter * self.reduced_mass / jnp.sqrt(jnp.sum(q**2))
        return jnp.sum(p**2) / (2 * self.reduced_mass) + potential


class NBody(AbstractHamiltonianSystem):
    """Bodies in a plane that attract each other, n = 4·bodies.

    H = Σᵢ |pᵢ|²/(2mᵢ) − G Σ_{i<j} mᵢmⱼ/|qᵢ − qⱼ|

    The state holds all positions, then all momenta, body by body: q = (x₁, y₁, x₂, y₂, …) [m],
    p = (m₁ẋ₁, m₁ẏ₁, …) [kg m/s]. Two masses make the two-body problem in 8 dimensions. If two
    bodies meet, the energy is −inf and the field NaN.

    Args:
        masses: mᵢ > 0, shape (bodies,), two or more [kg].
        gravitational_constant: G > 0 [m³/(kg s²)].

    Raises:
        ValueError: a parameter has the wrong shape or is not positive.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration (2nd ed., 2006), section I.2.
    """

    is_separable: ClassVar[bool] = True

    log_masses: Float[Array, " bodies"]
    log_gravitational_constant: Float[Array, ""]
    masses = positive_parameter("masses", "The masses mᵢ.")
    gravitational_constant = positive_parameter(
        "gravitational_constant", "The gravitational constant G."
    )

    def __init__(self, masses: Numbers = (1.0, 1.0), gravitational_constant: ArrayLike = 1.0):
        self.log_masses = log_parameter(masses, "masses", (count_of(masses, "masses"),))
        self.log_gravitational_constant = log_parameter(
            gravitational_constant, "gravitational_constant"
        )

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4·bodies,)."""
        self, x = cast_state(self, x, 4 * self.masses.size)
        m = self.masses
        q, p = x.reshape(2, m.size, 2)  # (bodies, 2) each
        i, j, squared = squared_distances(q)
        kinetic = jnp.sum(jnp.sum(p**2, axis=1) / (2 * m))
        return kinetic - self.gravitational_constant * jnp.sum(m[i] * m[j] / jnp.sqrt(squared))


class PointVortices(AbstractHamiltonianSystem):
    """Point vortices in an unbounded ideal fluid in the plane, n = 2·vortices.

    Each vortex drifts with the velocity that the others induce,

        ẋᵢ = −(1/2π) Σ_{j≠i} Γⱼ(yᵢ − yⱼ)/rᵢⱼ²,   ẏᵢ = (1/2π) Σ_{j≠i} Γⱼ(xᵢ − xⱼ)/rᵢⱼ²,

    which is Kirchhoff's form Γᵢẋᵢ = ∂H/∂yᵢ, Γᵢẏᵢ = −∂H/∂xᵢ with

        H = −(1/2π) Σ_{i<j} ΓᵢΓⱼ log rᵢⱼ.

    The positions in the plane are thus canonical up to the factors Γᵢ, which may be negative. The
    state

        qᵢ = √|Γᵢ| xᵢ,   pᵢ = sᵢ√|Γᵢ| yᵢ,   sᵢ = sign Γᵢ

    absorbs these factors. By the chain rule ∂H/∂yᵢ = sᵢ√|Γᵢ| ∂H/∂pᵢ and ∂H/∂xᵢ = √|Γᵢ| ∂H/∂qᵢ, so

        q̇ᵢ = √|Γᵢ| ẋᵢ = (√|Γᵢ|/Γᵢ) sᵢ√|Γᵢ| ∂H/∂pᵢ = ∂H/∂pᵢ,
        ṗᵢ = sᵢ√|Γᵢ| ẏᵢ = −(sᵢ√|Γᵢ|/Γᵢ) √|Γᵢ| ∂H/∂qᵢ = −∂H/∂qᵢ,

    since Γᵢ = sᵢ|Γᵢ|. Hence ẋ = J∇H for any nonzero circulations. `state` and `positions` map
    between the plane [m] and the state [m²/√s]. H [m⁴/s²] is the energy divided by the density of
    the fluid, per unit of depth, up to a constant. If two vortices meet, H is infinite and the
    field NaN.

    Args:
        circulations: Γᵢ ≠ 0, shape (vortices,), two or more [m²/s]; positive turns
            counter-clockwise.

    Raises:
        ValueError: circulations has the wrong shape, or an entry that is zero or not finite.

    Source: Kirchhoff, Vorlesungen über mathematische Physik: Mechanik (Teubner, 1876), lecture 20;
        Newton, The N-Vortex Problem (Springer, 2001), chapter 2.
    """

    circulations: Float[Array, " vortices"]

    def __init__(self, circulations: Numbers = (1.0, 1.0)):
        array = signed_parameter(
            circulations, "circulations", (count_of(circulations, "circulations"),)
        )
        self.circulations = require.value(
            array,
            require.host_array(array) == 0,
            lambda: f"circulations must not be zero, got {array}: leave out vortices without one.",
        )

    def state(self, positions: Num[ArrayLike, "vortices 2"]) -> Float[Array, " n"]:
        """Return the state (q, p) of vortices at the given points of the plane.

        Args:
            positions: one row (xᵢ, yᵢ) for each vortex, shape (vortices, 2).

        Returns:
            The canonical state, shape (2·vortices,).

        Raises:
            ValueError: positions has another shape.
        """
        positions = require.floating(positions, "positions")
        x, y = require_shape(positions, "positions", (self.circulations.size, 2)).T
        self = cast_arrays(self, x.dtype)
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.concatenate([scale * x, jnp.sign(self.circulations) * scale * y])

    def positions(self, x: Num[ArrayLike, " n"]) -> Float[Array, "vortices 2"]:
        """Return the points (xᵢ, yᵢ) of the plane, shape (vortices, 2), of one state.

        The map is linear, so it also takes velocities ẋ to velocities in the plane.

        Raises:
            ValueError: x is not one state of shape (2·vortices,).
        """
        self, x = cast_state(self, x, 2 * self.circulations.size)
        q, p = jnp.split(x, 2)
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.stack([q / scale, jnp.sign(self.circulations) * p / scale], axis=1)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·vortices,)."""
        self, x = cast_state(self, x, 2 * self.circulations.size)
        i, j, squared = squared_distances(self.positions(x))
        strengths = self.circulations[i] * self.circulations[j]
        return -jnp.sum(strengths * jnp.log(squared)) / (4 * jnp.pi)


class AbstractPoissonSystem(eqx.Module):
    """A system with the Hamiltonian H(x), the antisymmetric tensor Π(x) and the field Π∇H."""

    @abc.abstractmethod
    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the energy H(x) of one state, shape ()."""

    @abc.abstractmethod
    def tensor(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n n"]:
        """Return the antisymmetric Π(x), shape (n, n)."""

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
        return _poisson_velocity(self, x)

    def __repr__(self) -> str:
        return describe(self)


@eqx.filter_jit
def _poisson_velocity(system: AbstractPoissonSystem, x: Float[Array, " n"]) -> Float[Array, " n"]:
    system = cast_arrays(system, x.dtype)
    return jnp.matmul(system.tensor(x), jax.grad(system.hamiltonian)(x), precision="highest")


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
    inertia = positive_parameter("inertia", "The principal moments of inertia.")

    def __init__(self, inertia: Numbers = (1.0, 2.0, 3.0)):
        self.log_inertia = log_parameter(inertia, "inertia", (3,))

    def hamiltonian(self, x: Num[ArrayLike, "3"]) -> Float[Array, ""]:
        """Return H(L), shape (); ValueError unless L has shape (3,)."""
        self, L = cast_state(self, x, 3)
        return jnp.sum(L**2 / (2 * self.inertia))

    def tensor(self, x: Num[ArrayLike, "3"]) -> Float[Array, "3 3"]:
        """Return the matrix of v -> L × v."""
        return rigid_body(require.point(x, 3))

    def casimir(self, x: Num[ArrayLike, "3"]) -> Float[Array, ""]:
        """Return |L|², which every field Π∇H conserves, shape ()."""
        return jnp.sum(require.point(x, 3) ** 2)


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
    growth = positive_parameter("growth", "The growth of the prey.")
    predation = positive_parameter("predation", "The rate at which each predator eats prey.")
    death = positive_parameter("death", "The death rate of the predators.")
    reproduction = positive_parameter("reproduction", "The growth of the predators by each prey.")

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
        """Return H(x, y), shape (); NaN if a population is negative."""
        self, (prey, predators) = cast_state(self, x, 2)
        of_prey = self.reproduction * prey - self.death * jnp.log(prey)
        return of_prey + self.predation * predators - self.growth * jnp.log(predators)

    def tensor(self, x: Num[ArrayLike, "2"]) -> Float[Array, "2 2"]:
        """Return [[0, −xy], [xy, 0]]."""
        return lotka_volterra(require.point(x, 2))


class ChargedParticle(AbstractPoissonSystem):
    """A charge in a plane, held by a spring, in a magnetic field normal to the plane: n = 4.

    q̇ = p/m, ṗ = −κq + (b/m)(p₂, −p₁) with H = |p|²/(2m) + κ|q|²/2 and the KINETIC momentum p = mq̇.
    Without a spring the charge circles at the angular frequency b/m.

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
    mass = positive_parameter("mass", "The mass m.")

    def __init__(
        self, mass: ArrayLike = 1.0, stiffness: ArrayLike = 1.0, magnetic_field: ArrayLike = 1.0
    ):
        self.log_mass = log_parameter(mass, "mass")
        self.stiffness = signed_parameter(stiffness, "stiffness")
        self.magnetic_field = signed_parameter(magnetic_field, "magnetic_field")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(q, p), shape (); ValueError unless x has shape (4,)."""
        self, x = cast_state(self, x, 4)
        q, p = jnp.split(x, 2)
        return jnp.sum(p**2) / (2 * self.mass) + self.stiffness * jnp.sum(q**2) / 2

    def tensor(self, x: Num[ArrayLike, "4"]) -> Float[Array, "4 4"]:
        """Return Π = [[0, I], [−I, F]] with F = [[0, b], [−b, 0]], shape (4, 4)."""
        self, x = cast_state(self, x, 4)
        return charged_particle(lambda q: self.magnetic_field)(x)
