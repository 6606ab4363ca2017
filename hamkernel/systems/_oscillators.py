"""Systems that swing in a potential, and a chain of them."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel.systems._base import (
    AbstractHamiltonianSystem,
    Numbers,
    at,
    log_parameter,
    positive,
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
    mass = positive("mass", "The mass m.")
    stiffness = positive("stiffness", "The spring constant k.")

    def __init__(self, mass: ArrayLike = 0.5, stiffness: ArrayLike = 1.0):
        self.log_mass = log_parameter(mass, "mass")
        self.log_stiffness = log_parameter(stiffness, "stiffness")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        self, (q, p) = at(self, x, 2)
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
    mass = positive("mass", "The mass m.")
    length = positive("length", "The length l of the rod.")
    gravity = positive("gravity", "The acceleration of gravity g.")

    def __init__(self, mass: ArrayLike = 0.5, length: ArrayLike = 1.0, gravity: ArrayLike = 9.81):
        self.log_mass = log_parameter(mass, "mass")
        self.log_length = log_parameter(length, "length")
        self.log_gravity = log_parameter(gravity, "gravity")

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        self, (q, p) = at(self, x, 2)
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
    mass = positive("mass", "The mass m.")

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
        self, (q, p) = at(self, x, 2)
        potential = self.linear_stiffness * q**2 / 2 + self.cubic_stiffness * q**4 / 4
        return p**2 / (2 * self.mass) + potential


class HenonHeiles(AbstractHamiltonianSystem):
    """A star in a galaxy's plane: H = |p|²/2 + |q|²/2 + λ(q₁²q₂ − q₂³/3), n = 4.

    Dimensionless. Motion that starts near the origin stays bounded for H < 1/(6λ²), and turns
    from mostly regular to mostly chaotic as H nears that value.

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
        self, x = at(self, x, 4)
        return x @ x / 2 + self.coupling * (x[0] ** 2 * x[1] - x[1] ** 3 / 3)


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
    mass = positive("mass", "The masses m, shape () or (count,).")
    stiffness = positive("stiffness", "The spring constants k, shape () or (count + 1,).")

    def __init__(self, count: int = 10, mass: Numbers = 1.0, stiffness: Numbers = 1.0):
        self.count = require.count(count, "count")
        self.log_mass = log_parameter(mass, "mass", (), (self.count,))
        self.log_stiffness = log_parameter(stiffness, "stiffness", (), (self.count + 1,))

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·count,)."""
        self, x = at(self, x, 2 * self.count)
        q, p = jnp.split(x, 2)
        stretch = jnp.diff(jnp.pad(q, 1))  # (count + 1,)
        return jnp.sum(p**2 / (2 * self.mass)) + jnp.sum(self.stiffness * stretch**2) / 2
