"""Masses on springs, pendulums and linkages: Hamiltonian systems ẋ = J∇H."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel.systems._base import (
    AbstractHamiltonianSystem,
    Numbers,
    cast_state,
    log_parameter,
    positive_parameter,
    signed_parameter,
)


class HarmonicOscillator(AbstractHamiltonianSystem):
    """A mass on a spring: H = p²/(2m) + kq²/2, n = 2.

    q is the displacement [m], p = mq̇ the momentum [kg m/s]. The period is 2π√(m/k).

    Args:
        mass: m > 0 [kg].
        stiffness: k > 0 [N/m].

    Raises:
        ValueError: a parameter is not a positive scalar.

    Source: Smith & Egeland (2023), section Experiments, whose values are the defaults.
    """

    is_separable: ClassVar[bool] = True

    log_mass: Float[Array, ""]
    log_stiffness: Float[Array, ""]
    mass = positive_parameter("mass", "The mass m.")
    stiffness = positive_parameter("stiffness", "The spring constant k.")

    def __init__(self, mass: ArrayLike = 0.5, stiffness: ArrayLike = 1.0):
        self.log_mass = log_parameter(mass, "mass")
        self.log_stiffness = log_parameter(stiffness, "stiffness")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        self, (q, p) = cast_state(self, x, 2)
        return p**2 / (2 * self.mass) + self.stiffness * q**2 / 2


class Pendulum(AbstractHamiltonianSystem):
    """A point mass on a massless rod: H = p²/(2ml²) + mgl(1 − cos q), n = 2.

    q is the angle from hanging [rad], p = ml²q̇ its angular momentum [kg m²/s]. Small swings have
    the period 2π√(l/g).

    Args:
        mass: m > 0 [kg].
        length: l > 0 [m].
        gravity: g > 0 [m/s²].

    Raises:
        ValueError: a parameter is not a positive scalar.

    Source: Smith & Egeland (2023), section Experiments, whose text gives the defaults.
    """

    is_separable: ClassVar[bool] = True

    log_mass: Float[Array, ""]
    log_length: Float[Array, ""]
    log_gravity: Float[Array, ""]
    mass = positive_parameter("mass", "The mass m.")
    length = positive_parameter("length", "The length l of the rod.")
    gravity = positive_parameter("gravity", "The acceleration of gravity g.")

    def __init__(self, mass: ArrayLike = 0.5, length: ArrayLike = 1.0, gravity: ArrayLike = 9.81):
        self.log_mass = log_parameter(mass, "mass")
        self.log_length = log_parameter(length, "length")
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        self, (q, p) = cast_state(self, x, 2)
        kinetic = p**2 / (2 * self.mass * self.length**2)
        return kinetic + self.mass * self.gravity * self.length * (1 - jnp.cos(q))


class Duffing(AbstractHamiltonianSystem):
    """An undamped, unforced Duffing oscillator: H = p²/(2m) + αq²/2 + βq⁴/4, n = 2.

    q is the displacement [m], p = mq̇ [kg m/s]. The defaults have two wells, at q = ±√(−α/β), and
    a saddle between them; with β < 0 the motion may escape to infinity in finite time.

    Args:
        mass: m > 0 [kg].
        linear_stiffness: α of either sign [N/m].
        cubic_stiffness: β of either sign [N/m³].

    Raises:
        ValueError: the mass is not a positive scalar, or a stiffness not a finite one.

    Source: Guckenheimer & Holmes, Nonlinear Oscillations, Dynamical Systems, and Bifurcations of
        Vector Fields (Springer, 1983), section 2.2, without damping and forcing.
    """

    is_separable: ClassVar[bool] = True

    log_mass: Float[Array, ""]
    linear_stiffness: Float[Array, ""]
    cubic_stiffness: Float[Array, ""]
    mass = positive_parameter("mass", "The mass m.")

    def __init__(
        self,
        mass: ArrayLike = 1.0,
        linear_stiffness: ArrayLike = -1.0,
        cubic_stiffness: ArrayLike = 1.0,
    ):
        self.log_mass = log_parameter(mass, "mass")
        self.linear_stiffness = signed_parameter(linear_stiffness, "linear_stiffness")
        self.cubic_stiffness = signed_parameter(cubic_stiffness, "cubic_stiffness")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        self, (q, p) = cast_state(self, x, 2)
        potential = self.linear_stiffness * q**2 / 2 + self.cubic_stiffness * q**4 / 4
        return p**2 / (2 * self.mass) + potential


class HenonHeiles(AbstractHamiltonianSystem):
    """A star in a galaxy's plane: H = |p|²/2 + |q|²/2 + λ(q₁²q₂ − q₂³/3), n = 4.

    All quantities are dimensionless. Motion that starts near the origin stays bounded if
    H < 1/(6λ²). As H approaches 1/(6λ²), the motion changes from mostly regular to mostly chaotic.

    Args:
        coupling: λ of either sign; 1 in the paper, 0 for two free oscillators.

    Raises:
        ValueError: the coupling is not a finite scalar.

    Source: Hénon & Heiles, The applicability of the third integral of motion: some numerical
        experiments, Astronomical Journal 69 (1964) 73-79.
    """

    is_separable: ClassVar[bool] = True

    coupling: Float[Array, ""]

    def __init__(self, coupling: ArrayLike = 1.0):
        self.coupling = signed_parameter(coupling, "coupling")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = cast_state(self, x, 4)
        return jnp.sum(x**2) / 2 + self.coupling * (x[0] ** 2 * x[1] - x[1] ** 3 / 3)


class SpringChain(AbstractHamiltonianSystem):
    """Masses in a row, joined by springs to each other and to two fixed walls, n = 2·count.

    H = Σᵢ pᵢ²/(2mᵢ) + ½ Σ_{i=0}^{count} kᵢ(qᵢ₊₁ − qᵢ)²,  q₀ = q_{count+1} = 0

    q are the displacements from rest [m], p their momenta [kg m/s]. With equal masses and springs
    the normal frequencies are 2√(k/m) sin(jπ/(2(count+1))), j = 1…count.

    Args:
        count: number of masses, one or more.
        mass: m > 0 [kg], one for all or shape (count,).
        stiffness: k > 0 [N/m], one for all or shape (count + 1,), from wall to wall.

    Raises:
        TypeError: count is not an integer.
        ValueError: count is below one, or a parameter has the wrong shape or is not positive.

    Source: Goldstein, Poole & Safko, Classical Mechanics (3rd ed., 2002), section 13.1.
    """

    is_separable: ClassVar[bool] = True

    count: int = eqx.field(static=True)
    log_mass: Float[Array, "*count"]
    log_stiffness: Float[Array, "*springs"]
    mass = positive_parameter("mass", "The masses m, shape () or (count,).")
    stiffness = positive_parameter("stiffness", "The spring constants k, shape () or (count + 1,).")

    def __init__(self, count: int = 10, mass: Numbers = 1.0, stiffness: Numbers = 1.0):
        self.count = require.count(count, "count")
        self.log_mass = log_parameter(mass, "mass", (), (self.count,))
        self.log_stiffness = log_parameter(stiffness, "stiffness", (), (self.count + 1,))

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·count,)."""
        self, x = cast_state(self, x, 2 * self.count)
        q, p = jnp.split(x, 2)
        stretch = jnp.diff(jnp.pad(q, 1))  # (count + 1,)
        return jnp.sum(p**2 / (2 * self.mass)) + jnp.sum(self.stiffness * stretch**2) / 2


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
        1976), section 5, problem 1. The zero of energy differs: here it is the energy at rest.
    """

    log_masses: Float[Array, "2"]
    log_lengths: Float[Array, "2"]
    log_gravity: Float[Array, ""]
    masses = positive_parameter("masses", "The masses (m₁, m₂).")
    lengths = positive_parameter("lengths", "The lengths (l₁, l₂) of the rods.")
    gravity = positive_parameter("gravity", "The acceleration of gravity g.")

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
        self, (q1, q2, p1, p2) = cast_state(self, x, 4)
        (m1, m2), (l1, l2), g = self.masses, self.lengths, self.gravity
        # Momenta divided by the lengths; in them the kinetic energy does not contain the lengths.
        u1, u2 = p1 / l1, p2 / l2
        numerator = m2 * u1**2 + (m1 + m2) * u2**2 - 2 * m2 * u1 * u2 * jnp.cos(q1 - q2)
        kinetic = numerator / (2 * m2 * (m1 + m2 * jnp.sin(q1 - q2) ** 2))
        upper = (m1 + m2) * g * l1 * (1 - jnp.cos(q1))
        return kinetic + upper + m2 * g * l2 * (1 - jnp.cos(q2))


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
    masses = positive_parameter("masses", "The masses (M, m).")
    length = positive_parameter("length", "Half of the length of the pole, l.")
    gravity = positive_parameter("gravity", "The acceleration of gravity g.")

    def __init__(
        self, masses: Numbers = (0.5, 0.1), length: ArrayLike = 0.5, gravity: ArrayLike = 9.81
    ):
        self.log_masses = log_parameter(masses, "masses", (2,))
        self.log_length = log_parameter(length, "length")
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        self, x = cast_state(self, x, 4)
        (M, m), half, g = self.masses, self.length, self.gravity
        mixed = m * half * jnp.cos(x[1])
        kinetic = _kinetic(x[2:], M + m, mixed, 4 * m * half**2 / 3)
        return kinetic + m * g * half * (1 - jnp.cos(x[1]))


class Acrobot(AbstractHamiltonianSystem):
    """Two links hung from each other, n = 4: the torque between them is the input.

    H = ½ pᵀ M(q)⁻¹ p + V(q),  V = (m₁c₁ + m₂l) g (1 − cos q₁) + m₂c₂ g (1 − cos(q₁ + q₂)),
    M₁₁ = I₁ + I₂ + m₁c₁² + m₂(l² + c₂² + 2lc₂ cos q₂),  M₁₂ = I₂ + m₂(c₂² + lc₂ cos q₂),
    M₂₂ = I₂ + m₂c₂²

    q₁ is the angle of the first link from hanging, and q₂ the angle of the second link from the
    first [rad]. p = M(q) q̇ [kg m²/s]. The length of the second link enters through c₂ and I₂ only.

    Args:
        masses: (m₁, m₂), positive [kg].
        length: l > 0, of the first link [m].
        centres: (c₁, c₂), from the joint of each link to its centre of mass, positive [m].
        inertias: (I₁, I₂), of each link about its centre of mass, positive [kg m²].
        gravity: g > 0 [m/s²].

    Raises:
        ValueError: a parameter has the wrong shape or is not positive.

    Example: `hk.systems.Driven(hk.systems.Acrobot())`, whose u is the torque [N m], shape (1,).

    Source: Spong (1995), IEEE Control Systems 15; the parameters, other than g, are those of Sutton
        & Barto, Reinforcement Learning (1998).
    """

    actuation: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (0.0,), (0.0,), (1.0,))

    log_masses: Float[Array, "2"]
    log_length: Float[Array, ""]
    log_centres: Float[Array, "2"]
    log_inertias: Float[Array, "2"]
    log_gravity: Float[Array, ""]
    masses = positive_parameter("masses", "The masses (m₁, m₂).")
    length = positive_parameter("length", "The length l of the first link.")
    centres = positive_parameter("centres", "Where the centres of mass are, (c₁, c₂).")
    inertias = positive_parameter("inertias", "The moments of inertia (I₁, I₂).")
    gravity = positive_parameter("gravity", "The acceleration of gravity g.")

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
        self, x = cast_state(self, x, 4)
        (m1, m2), (c1, c2), (i1, i2) = self.masses, self.centres, self.inertias
        link, g = self.length, self.gravity
        swing = m2 * link * c2 * jnp.cos(x[1])
        second = i2 + m2 * c2**2
        first = i1 + m1 * c1**2 + m2 * link**2 + second + 2 * swing
        kinetic = _kinetic(x[2:], first, second + swing, second)
        upper = (m1 * c1 + m2 * link) * g * (1 - jnp.cos(x[0]))
        return kinetic + upper + m2 * c2 * g * (1 - jnp.cos(x[0] + x[1]))


def _kinetic(p: Float[Array, "2"], a: Array, b: Array, c: Array) -> Float[Array, ""]:
    """The kinetic energy ½ pᵀ [[a, b], [b, c]]⁻¹ p."""
    return (c * p[0] ** 2 - 2 * b * p[0] * p[1] + a * p[1] ** 2) / (2 * (a * c - b**2))
