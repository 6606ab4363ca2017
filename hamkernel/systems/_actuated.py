"""Mechanisms with one motor and two degrees of freedom, as control theory likes them."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel.systems._base import AbstractHamiltonianSystem, Numbers, at, log_parameter, positive


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
