"""Systems of several bodies: linked, driven by one motor, gravitating, or carried by a flow."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel.systems._base import (
    AbstractHamiltonianSystem,
    Numbers,
    at,
    count_of,
    in_precision,
    log_parameter,
    positive,
    shaped,
    signed_parameter,
    squared_distances,
)


class DoublePendulum(AbstractHamiltonianSystem):
    """Two point masses on two massless rods, the second hung from the first, n = 4.

    H = [m₂l₂²p₁² + (m₁+m₂)l₁²p₂² − 2m₂l₁l₂p₁p₂ cos(q₁−q₂)] / [2m₂l₁²l₂²(m₁ + m₂ sin²(q₁−q₂))]
        + (m₁+m₂)gl₁(1 − cos q₁) + m₂gl₂(1 − cos q₂)

    q are the angles of both rods from hanging [rad], not of one rod from the other. p are their
    canonical momenta [kg m²/s], p₁ = (m₁+m₂)l₁²q̇₁ + m₂l₁l₂q̇₂ cos(q₁−q₂) and
    p₂ = m₂l₂²q̇₂ + m₂l₁l₂q̇₁ cos(q₁−q₂), not the angular momenta of the single masses.

    Args:
        masses: (m₁, m₂), positive [kg].
        lengths: (l₁, l₂), positive [m].
        gravity: g > 0 [m/s²].

    Raises:
        ValueError: a parameter has the wrong shape or is not positive.

    Source: the Legendre transform of the Lagrangian in Landau & Lifshitz, Mechanics (3rd ed.,
        1976), section 5, problem 1. Differs in the zero of energy, which is the state of rest.
    """

    log_masses: Float[Array, "2"]
    log_lengths: Float[Array, "2"]
    log_gravity: Float[Array, ""]
    masses = positive("masses", "The masses (m₁, m₂).")
    lengths = positive("lengths", "The lengths (l₁, l₂) of the rods.")
    gravity = positive("gravity", "The acceleration of gravity g.")

    def __init__(
        self,
        masses: Numbers = (1.0, 1.0),
        lengths: Numbers = (1.0, 1.0),
        gravity: ArrayLike = 9.81,
    ):
        self.log_masses = log_parameter(masses, "masses", (2,))
        self.log_lengths = log_parameter(lengths, "lengths", (2,))
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, (q1, q2, p1, p2) = at(self, x, 4)
        (m1, m2), (l1, l2), g = self.masses, self.lengths, self.gravity
        # Momenta per length: the kinetic energy is then free of the lengths.
        u1, u2 = p1 / l1, p2 / l2
        numerator = m2 * u1**2 + (m1 + m2) * u2**2 - 2 * m2 * u1 * u2 * jnp.cos(q1 - q2)
        kinetic = numerator / (2 * m2 * (m1 + m2 * jnp.sin(q1 - q2) ** 2))
        upper = (m1 + m2) * g * l1 * (1 - jnp.cos(q1))
        return kinetic + upper + m2 * g * l2 * (1 - jnp.cos(q2))


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
    reduced_mass = positive("reduced_mass", "The reduced mass μ.")
    gravitational_parameter = positive("gravitational_parameter", "The gravitational parameter GM.")

    def __init__(self, reduced_mass: ArrayLike = 1.0, gravitational_parameter: ArrayLike = 1.0):
        self.log_reduced_mass = log_parameter(reduced_mass, "reduced_mass")
        self.log_gravitational_parameter = log_parameter(
            gravitational_parameter, "gravitational_parameter"
        )

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = at(self, x, 4)
        q, p = jnp.split(x, 2)
        potential = -self.gravitational_parameter * self.reduced_mass / jnp.sqrt(q @ q)
        return p @ p / (2 * self.reduced_mass) + potential


class NBody(AbstractHamiltonianSystem):
    """Bodies in a plane that attract each other, n = 4·bodies.

    H = Σᵢ |pᵢ|²/(2mᵢ) − G Σ_{i<j} mᵢmⱼ/|qᵢ − qⱼ|

    The state holds all positions, then all momenta, body by body: q = (x₁, y₁, x₂, y₂, …) [m],
    p = (m₁ẋ₁, m₁ẏ₁, …) [kg m/s]. With two masses it is the two-body problem in 8 dimensions.
    Where two bodies meet the energy is −inf and the field NaN.

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
    masses = positive("masses", "The masses mᵢ.")
    gravitational_constant = positive("gravitational_constant", "The gravitational constant G.")

    def __init__(self, masses: Numbers = (1.0, 1.0), gravitational_constant: ArrayLike = 1.0):
        self.log_masses = log_parameter(masses, "masses", (count_of(masses, "masses"),))
        self.log_gravitational_constant = log_parameter(
            gravitational_constant, "gravitational_constant"
        )

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4·bodies,)."""
        self, x = at(self, x, 4 * self.masses.size)
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

    Plane positions are thus canonical only up to the factors Γᵢ, which may be negative. With
    sᵢ = sign Γᵢ the state

        qᵢ = √|Γᵢ| xᵢ,   pᵢ = sᵢ√|Γᵢ| yᵢ

    absorbs them. By the chain rule ∂H/∂yᵢ = sᵢ√|Γᵢ| ∂H/∂pᵢ and ∂H/∂xᵢ = √|Γᵢ| ∂H/∂qᵢ, so

        q̇ᵢ = √|Γᵢ| ẋᵢ = (√|Γᵢ|/Γᵢ) sᵢ√|Γᵢ| ∂H/∂pᵢ = ∂H/∂pᵢ,
        ṗᵢ = sᵢ√|Γᵢ| ẏᵢ = −(sᵢ√|Γᵢ|/Γᵢ) √|Γᵢ| ∂H/∂qᵢ = −∂H/∂qᵢ,

    since Γᵢ = sᵢ|Γᵢ|: ẋ = J∇H for any nonzero circulations. `state` and `positions` map between the
    plane [m] and the state [m²/√s]. H [m⁴/s²] is the energy per density, up to a constant. Where
    two vortices meet it is infinite and the field NaN.

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
            require.on_host(array) == 0,
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
        x, y = shaped(positions, "positions", (self.circulations.size, 2)).T
        self = in_precision(self, x.dtype)
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.concatenate([scale * x, jnp.sign(self.circulations) * scale * y])

    def positions(self, x: Num[ArrayLike, " n"]) -> Float[Array, "vortices 2"]:
        """Return the points (xᵢ, yᵢ) of the plane, shape (vortices, 2), of one state.

        It is linear, so it takes velocities ẋ to velocities in the plane as well.

        Raises:
            ValueError: x is not one state of shape (2·vortices,).
        """
        self, x = at(self, x, 2 * self.circulations.size)
        q, p = jnp.split(x, 2)
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.stack([q / scale, jnp.sign(self.circulations) * p / scale], axis=1)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·vortices,)."""
        self, x = at(self, x, 2 * self.circulations.size)
        i, j, squared = squared_distances(self.positions(x))
        strengths = self.circulations[i] * self.circulations[j]
        return -jnp.sum(strengths * jnp.log(squared)) / (4 * jnp.pi)


class CartPole(AbstractHamiltonianSystem):
    """A cart on a track with a pole hung from it, n = 4: the force on the cart is the input.

    H = ½ pᵀ M(q)⁻¹ p + mgl (1 − cos q₂),  M(q) = [[M + m, ml cos q₂], [ml cos q₂, 4ml²/3]]

    q₁ is the position of the cart [m], q₂ the angle of the pole from hanging [rad], so that it
    stands at q₂ = π; p = M(q) q̇ [kg m/s, kg m²/s]. The pole is uniform and 2l long.

    Args:
        masses: (M, m) of cart and pole, positive [kg].
        length: l > 0, half of the pole [m].
        gravity: g > 0 [m/s²].

    Raises:
        ValueError: a parameter has the wrong shape or is not positive.

    Example: `hk.systems.Driven(hk.systems.CartPole())`, whose u is the force [N], shape (1,).

    Source: Barto, Sutton & Anderson (1983), without friction; the masses are those of Zhong, Dey &
        Chakraborty (2020), arXiv 1909.12077. Both count the angle from the upright.
    """

    actuation: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (0.0,), (1.0,), (0.0,))

    log_masses: Float[Array, "2"]
    log_length: Float[Array, ""]
    log_gravity: Float[Array, ""]
    masses = positive("masses", "The masses (M, m).")
    length = positive("length", "Half of the length of the pole, l.")
    gravity = positive("gravity", "The acceleration of gravity g.")

    def __init__(
        self, masses: Numbers = (0.5, 0.1), length: ArrayLike = 0.5, gravity: ArrayLike = 9.81
    ):
        self.log_masses = log_parameter(masses, "masses", (2,))
        self.log_length = log_parameter(length, "length")
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = at(self, x, 4)
        (M, m), half, g = self.masses, self.length, self.gravity
        mixed = m * half * jnp.cos(x[1])
        kinetic = _kinetic(x[2:], M + m, mixed, 4 * m * half**2 / 3)
        return kinetic + m * g * half * (1 - jnp.cos(x[1]))


class Acrobot(AbstractHamiltonianSystem):
    """Two links hung from each other, n = 4: the torque between them is the input.

    H = ½ pᵀ M(q)⁻¹ p + V(q),  V = (m₁c₁ + m₂l) g (1 − cos q₁) + m₂c₂ g (1 − cos(q₁ + q₂)),
    M₁₁ = I₁ + I₂ + m₁c₁² + m₂(l² + c₂² + 2lc₂ cos q₂),  M₁₂ = I₂ + m₂(c₂² + lc₂ cos q₂),
    M₂₂ = I₂ + m₂c₂²

    q₁ is the angle of the first link from hanging and q₂ that of the second from the first [rad];
    p = M(q) q̇ [kg m²/s]. The length of the second link matters through c₂ and I₂ alone.

    Args:
        masses: (m₁, m₂), positive [kg].
        length: l > 0, of the first link [m].
        centres: (c₁, c₂), from the joint of each link to its centre of mass, positive [m].
        inertias: (I₁, I₂), of each link about its centre of mass, positive [kg m²].
        gravity: g > 0 [m/s²].

    Raises:
        ValueError: a parameter has the wrong shape or is not positive.

    Example: `hk.systems.Driven(hk.systems.Acrobot())`, whose u is the torque [N m], shape (1,).

    Source: Spong (1995), IEEE Control Systems 15; the parameters are those of Sutton & Barto,
        Reinforcement Learning (1998).
    """

    actuation: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (0.0,), (0.0,), (1.0,))

    log_masses: Float[Array, "2"]
    log_length: Float[Array, ""]
    log_centres: Float[Array, "2"]
    log_inertias: Float[Array, "2"]
    log_gravity: Float[Array, ""]
    masses = positive("masses", "The masses (m₁, m₂).")
    length = positive("length", "The length l of the first link.")
    centres = positive("centres", "Where the centres of mass are, (c₁, c₂).")
    inertias = positive("inertias", "The moments of inertia (I₁, I₂).")
    gravity = positive("gravity", "The acceleration of gravity g.")

    def __init__(
        self,
        masses: Numbers = (1.0, 1.0),
        length: ArrayLike = 1.0,
        centres: Numbers = (0.5, 0.5),
        inertias: Numbers = (1.0, 1.0),
        gravity: ArrayLike = 9.81,
    ):
        self.log_masses = log_parameter(masses, "masses", (2,))
        self.log_length = log_parameter(length, "length")
        self.log_centres = log_parameter(centres, "centres", (2,))
        self.log_inertias = log_parameter(inertias, "inertias", (2,))
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = at(self, x, 4)
        (m1, m2), (c1, c2), (i1, i2) = self.masses, self.centres, self.inertias
        link, g = self.length, self.gravity
        swing = m2 * link * c2 * jnp.cos(x[1])
        second = i2 + m2 * c2**2
        first = i1 + m1 * c1**2 + m2 * link**2 + second + 2 * swing
        kinetic = _kinetic(x[2:], first, second + swing, second)
        upper = (m1 * c1 + m2 * link) * g * (1 - jnp.cos(x[0]))
        return kinetic + upper + m2 * c2 * g * (1 - jnp.cos(x[0] + x[1]))


def _kinetic(p: Float[Array, "2"], a: Array, b: Array, c: Array) -> Float[Array, ""]:
    """½ pᵀ [[a, b], [b, c]]⁻¹ p."""
    return (c * p[0] ** 2 - 2 * b * p[0] * p[1] + a * p[1] ** 2) / (2 * (a * c - b**2))
