"""Example systems with a known Hamiltonian, and noisy data sampled from them.

A system is a field like a learned one: `system(x)` is the velocity of one state, `jax.vmap(system)`
that of many, and `system.hamiltonian(x)` the energy. States are x = (q₁…q_m, p₁…p_m), velocities
ẋ = J∇H with J = [[0, I], [−I, 0]]. Units are free but must agree; those named below are SI.

Positive parameters are stored as logarithms (`log_mass`) and read through properties (`mass`),
signed ones as they are: every array leaf is an unconstrained real, and everything is
differentiable with respect to it.

A system only states H, and the field follows from it here and nowhere else. What is not J∇H, such
as damping, is to be added by a module that wraps a system, not by one that overrides its field.
"""

import abc
from collections.abc import Callable, Sequence
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num, PRNGKeyArray

from hamkernel import _require as require

Numbers = ArrayLike | Sequence[ArrayLike]


class AbstractHamiltonianSystem(eqx.Module):
    """A Hamiltonian H(x), and the field J∇H that follows from it."""

    @abc.abstractmethod
    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the energy H(x) of one state, shape ()."""

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """Return the velocity J∇H(x) = (∂H/∂p, −∂H/∂q) of one state, by automatic differentiation.

        Args:
            x: one state (q, p), shape (n,), n even; `jax.vmap(system)` takes many.

        Returns:
            The velocity (q̇, ṗ), shape (n,).

        Raises:
            ValueError: x is not one state, or not a state of this system.
        """
        x = require.floating(x, "x")
        if x.ndim != 1 or x.shape[0] % 2:
            hint = " Use `jax.vmap(system)` for a batch of states." if x.ndim > 1 else ""
            raise ValueError(
                f"x has shape {x.shape}; one state (q, p) of shape (n,), n even, is needed.{hint}"
            )
        dq, dp = jnp.split(jax.grad(self.hamiltonian)(x), 2)
        return jnp.concatenate([dp, -dq])


def _shaped(x: Array, name: str, *shapes: tuple[int, ...]) -> Array:
    """`x`, whose shape must be one of `shapes`."""
    if x.shape not in shapes:
        needed = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {x.shape}; shape {needed} is needed.")
    return x


def _log(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """The logarithm of a positive parameter, by default a scalar."""
    array = require.positive(jnp.asarray(x), name)
    return jnp.log(_shaped(array, name, *(shapes or ((),))))


def _signed(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """A finite parameter of either sign, by default a scalar."""
    array = _shaped(require.floating(jnp.asarray(x), name), name, *(shapes or ((),)))
    return _finite(array, name)


def _finite(x: Array, name: str) -> Array:
    """`x`, in which every entry must be finite."""
    return require.value(x, ~jnp.isfinite(x), lambda: f"{name} must be finite, got {x}.")


def _bodies(x: Numbers, name: str) -> int:
    """How many entries a list of masses or circulations has; at least two."""
    shape = jnp.asarray(x).shape
    if len(shape) != 1 or shape[0] < 2:
        raise ValueError(f"{name} has shape {shape}; one number for each of two or more is needed.")
    return shape[0]


def _squared_distances(positions: Float[Array, "bodies 2"]) -> tuple[np.ndarray, np.ndarray, Array]:
    """Indices i < j of all pairs, and |r_i − r_j|² of each; a body never meets itself."""
    i, j = np.triu_indices(positions.shape[0], k=1)
    return i, j, jnp.sum((positions[i] - positions[j]) ** 2, axis=1)


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

    log_mass: Float[Array, ""]
    log_stiffness: Float[Array, ""]

    def __init__(self, mass: ArrayLike = 0.5, stiffness: ArrayLike = 1.0):
        self.log_mass = _log(mass, "mass")
        self.log_stiffness = _log(stiffness, "stiffness")

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass m."""
        return jnp.exp(self.log_mass)

    @property
    def stiffness(self) -> Float[Array, ""]:
        """The spring constant k."""
        return jnp.exp(self.log_stiffness)

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        q, p = require.point(x, 2)
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

    log_mass: Float[Array, ""]
    log_length: Float[Array, ""]
    log_gravity: Float[Array, ""]

    def __init__(self, mass: ArrayLike = 0.5, length: ArrayLike = 1.0, gravity: ArrayLike = 9.81):
        self.log_mass = _log(mass, "mass")
        self.log_length = _log(length, "length")
        self.log_gravity = _log(gravity, "gravity")

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass m."""
        return jnp.exp(self.log_mass)

    @property
    def length(self) -> Float[Array, ""]:
        """The length l of the rod."""
        return jnp.exp(self.log_length)

    @property
    def gravity(self) -> Float[Array, ""]:
        """The acceleration of gravity g."""
        return jnp.exp(self.log_gravity)

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        q, p = require.point(x, 2)
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

    log_mass: Float[Array, ""]
    linear_stiffness: Float[Array, ""]
    cubic_stiffness: Float[Array, ""]

    def __init__(
        self,
        mass: ArrayLike = 1.0,
        linear_stiffness: ArrayLike = -1.0,
        cubic_stiffness: ArrayLike = 1.0,
    ):
        self.log_mass = _log(mass, "mass")
        self.linear_stiffness = _signed(linear_stiffness, "linear_stiffness")
        self.cubic_stiffness = _signed(cubic_stiffness, "cubic_stiffness")

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass m."""
        return jnp.exp(self.log_mass)

    def hamiltonian(self, x: Num[ArrayLike, "2"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2,)."""
        q, p = require.point(x, 2)
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

    coupling: Float[Array, ""]

    def __init__(self, coupling: ArrayLike = 1.0):
        self.coupling = _signed(coupling, "coupling")

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        x = require.point(x, 4)
        return x @ x / 2 + self.coupling * (x[0] ** 2 * x[1] - x[1] ** 3 / 3)


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

    def __init__(
        self,
        masses: Numbers = (1.0, 1.0),
        lengths: Numbers = (1.0, 1.0),
        gravity: ArrayLike = 9.81,
    ):
        self.log_masses = _log(masses, "masses", (2,))
        self.log_lengths = _log(lengths, "lengths", (2,))
        self.log_gravity = _log(gravity, "gravity")

    @property
    def masses(self) -> Float[Array, "2"]:
        """The masses (m₁, m₂)."""
        return jnp.exp(self.log_masses)

    @property
    def lengths(self) -> Float[Array, "2"]:
        """The lengths (l₁, l₂) of the rods."""
        return jnp.exp(self.log_lengths)

    @property
    def gravity(self) -> Float[Array, ""]:
        """The acceleration of gravity g."""
        return jnp.exp(self.log_gravity)

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        q1, q2, p1, p2 = require.point(x, 4)
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

    log_reduced_mass: Float[Array, ""]
    log_gravitational_parameter: Float[Array, ""]

    def __init__(self, reduced_mass: ArrayLike = 1.0, gravitational_parameter: ArrayLike = 1.0):
        self.log_reduced_mass = _log(reduced_mass, "reduced_mass")
        self.log_gravitational_parameter = _log(gravitational_parameter, "gravitational_parameter")

    @property
    def reduced_mass(self) -> Float[Array, ""]:
        """The reduced mass μ."""
        return jnp.exp(self.log_reduced_mass)

    @property
    def gravitational_parameter(self) -> Float[Array, ""]:
        """The gravitational parameter GM."""
        return jnp.exp(self.log_gravitational_parameter)

    def hamiltonian(self, x: Num[ArrayLike, "4"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4,)."""
        q, p = jnp.split(require.point(x, 4), 2)
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

    log_masses: Float[Array, " bodies"]
    log_gravitational_constant: Float[Array, ""]

    def __init__(self, masses: Numbers = (1.0, 1.0), gravitational_constant: ArrayLike = 1.0):
        self.log_masses = _log(masses, "masses", (_bodies(masses, "masses"),))
        self.log_gravitational_constant = _log(gravitational_constant, "gravitational_constant")

    @property
    def masses(self) -> Float[Array, " bodies"]:
        """The masses mᵢ."""
        return jnp.exp(self.log_masses)

    @property
    def gravitational_constant(self) -> Float[Array, ""]:
        """The gravitational constant G."""
        return jnp.exp(self.log_gravitational_constant)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (4·bodies,)."""
        m = self.masses
        q, p = require.point(x, 4 * m.size).reshape(2, m.size, 2)  # (bodies, 2) each
        i, j, squared = _squared_distances(q)
        kinetic = jnp.sum(jnp.sum(p**2, axis=1) / (2 * m))
        return kinetic - self.gravitational_constant * jnp.sum(m[i] * m[j] / jnp.sqrt(squared))


class SpringChain(AbstractHamiltonianSystem):
    """Masses in a row, joined by springs to each other and to two fixed walls, n = 2·count.

    H = Σᵢ pᵢ²/(2mᵢ) + ½ Σ_{i=0}^{count} kᵢ(qᵢ₊₁ − qᵢ)²,  q₀ = q_{count+1} = 0

    q are the displacements from rest [m], p their momenta [kg m/s]. With equal masses and springs
    the normal frequencies are 2√(k/m) sin(jπ/(2(count+1))), j = 1…count.

    Args:
        count: number of masses, one or more; a Python integer.
        mass: m > 0 [kg], one for all or shape (count,).
        stiffness: k > 0 [N/m], one for all or shape (count + 1,), from wall to wall.

    Raises:
        TypeError: count is not an integer.
        ValueError: count is below one, or a parameter has the wrong shape or is not positive.

    Source: Goldstein, Poole & Safko, Classical Mechanics (3rd ed., 2002), section 13.1.
    """

    count: int = eqx.field(static=True)
    log_mass: Float[Array, "*count"]
    log_stiffness: Float[Array, "*springs"]

    def __init__(self, count: int = 10, mass: Numbers = 1.0, stiffness: Numbers = 1.0):
        if isinstance(count, bool) or not isinstance(count, int | np.integer):
            raise TypeError(f"count is {count!r}; a Python integer is needed.")
        if count < 1:
            raise ValueError(f"count is {count}; at least one mass is needed.")
        self.count = int(count)
        self.log_mass = _log(mass, "mass", (), (self.count,))
        self.log_stiffness = _log(stiffness, "stiffness", (), (self.count + 1,))

    @property
    def mass(self) -> Float[Array, "*count"]:
        """The masses m, shape () or (count,)."""
        return jnp.exp(self.log_mass)

    @property
    def stiffness(self) -> Float[Array, "*springs"]:
        """The spring constants k, shape () or (count + 1,)."""
        return jnp.exp(self.log_stiffness)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·count,)."""
        q, p = jnp.split(require.point(x, 2 * self.count), 2)
        stretch = jnp.diff(jnp.pad(q, 1))  # (count + 1,)
        return jnp.sum(p**2 / (2 * self.mass)) + jnp.sum(self.stiffness * stretch**2) / 2


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
        array = _signed(circulations, "circulations", (_bodies(circulations, "circulations"),))
        self.circulations = require.value(
            array,
            array == 0,
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
        x, y = _shaped(positions, "positions", (self.circulations.size, 2)).T
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.concatenate([scale * x, jnp.sign(self.circulations) * scale * y])

    def positions(self, x: Num[ArrayLike, " n"]) -> Float[Array, "vortices 2"]:
        """Return the points (xᵢ, yᵢ) of the plane, shape (vortices, 2), of one state.

        It is linear, so it takes velocities ẋ to velocities in the plane as well.

        Raises:
            ValueError: x is not one state of shape (2·vortices,).
        """
        q, p = jnp.split(require.point(x, 2 * self.circulations.size), 2)
        scale = jnp.sqrt(jnp.abs(self.circulations))
        return jnp.stack([q / scale, jnp.sign(self.circulations) * p / scale], axis=1)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return H(x), shape (); ValueError unless x has shape (2·vortices,)."""
        i, j, squared = _squared_distances(self.positions(x))
        strengths = self.circulations[i] * self.circulations[j]
        return -jnp.sum(strengths * jnp.log(squared)) / (4 * jnp.pi)


def sample(
    system: Callable[[Array], Array],
    x0: Num[ArrayLike, "*batch n"],
    ts: Num[ArrayLike, " T"],
    state_noise: Num[ArrayLike, "..."] = 0.0,
    velocity_noise: Num[ArrayLike, "..."] = 0.0,
    *,
    key: PRNGKeyArray | None = None,
) -> tuple[Float[Array, "*batch T n"], Float[Array, "*batch T n"]]:
    """Return noisy states and velocities along trajectories of `system`.

        X = x(t) + state_noise · ξ,   Y = f(x(t)) + velocity_noise · η,   ξ, η ~ N(0, I)

    The velocities belong to the true states x(t), not to the noisy ones. Trajectories are
    integrated by an adaptive Runge-Kutta method of order 8, in steps whose estimated error is
    below 1e-10 in float64 and about 1e-6 in float32, relative and absolute: choose units in which
    states are not tiny. Differentiable in reverse mode with respect to `system`, `x0` and the noise
    levels.

    Args:
        system: any traceable field, (n,) -> (n,); one of this module, a learned one, a function.
        x0: states at time ts[0], shape (B, n), or (n,) for a single trajectory. Its dtype is that
            of the results and of the integration, for which the arrays of `system` are cast to it.
        ts: times, shape (T,), strictly increasing.
        state_noise: standard deviation of the noise on X, shape () or (n,), in units of the state.
        velocity_noise: standard deviation of the noise on Y, shape () or (n,), per unit of time.
        key: the source of the noise, needed unless both levels are zero. Many seeds:
            `jax.vmap(lambda key: sample(..., key=key))(keys)` integrates once.

    Returns:
        X and Y, each of shape (B, T, n), or (T, n) where x0 is a single state. `hk.fit` takes
        them as `X.reshape(-1, n)` and `Y.reshape(-1, n)`.

    Raises:
        ValueError: a shape is wrong; x0 or ts is not finite; ts does not increase; a noise level
            is negative or not finite; there is noise but no key.
        RuntimeError: a trajectory left the finite numbers or needed too many steps.

    Source: Smith & Egeland (2023), section Experiments, where both levels are one number.
    """
    x0 = require.floating(x0, "x0")
    states = _finite(require.points(x0[None] if x0.ndim == 1 else x0, "x0"), "x0")
    ts = _times(ts, states.dtype)
    system = _in_precision(system, states.dtype)
    velocity = eqx.filter_eval_shape(system, states[0])
    if getattr(velocity, "shape", None) != states[0].shape:
        raise ValueError(
            f"system(x) must return one velocity, of the shape {states[0].shape} of x; "
            f"it returns {velocity}."
        )
    levels = [
        _noise_level(level, name, states, key)
        for level, name in [(state_noise, "state_noise"), (velocity_noise, "velocity_noise")]
    ]
    X, Y, failed = _trajectories(system, states, ts)  # (B, T, n) twice, (B,)
    X = require.value(X, failed, lambda: _failure(failed), RuntimeError)
    if key is not None:
        noises = (jax.random.normal(k, X.shape, X.dtype) for k in jax.random.split(key))
        X, Y = (
            clean + jnp.broadcast_to(level, X.shape) * noise
            for clean, level, noise in zip((X, Y), levels, noises, strict=True)
        )
    return (X[0], Y[0]) if x0.ndim == 1 else (X, Y)


def _in_precision(field: Callable[[Array], Array], dtype: jnp.dtype) -> Callable[[Array], Array]:
    """`field` with its real arrays in the dtype of the states; a plain function has none."""

    def cast_leaf(leaf):
        real = eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf.astype(dtype) if real else leaf

    return jax.tree.map(cast_leaf, field)


def _times(ts: ArrayLike, dtype: jnp.dtype) -> Float[Array, " T"]:
    """Times since the first one, in the dtype of the states, finite and strictly increasing."""
    ts = require.floating(ts, "ts")
    if ts.ndim != 1 or ts.size == 0:
        raise ValueError(f"ts has shape {ts.shape}; times of shape (T,), T ≥ 1, are needed.")
    ts = _finite(ts, "ts")
    # The field does not depend on time. Counting from zero keeps late, dense times apart.
    elapsed = (ts - ts[0]).astype(dtype)
    return require.value(
        elapsed,
        jnp.diff(elapsed) <= 0,
        f"ts must be strictly increasing in {dtype}: sort it and drop repeated times.",
    )


def _noise_level(
    level: ArrayLike, name: str, states: Float[Array, "B n"], key: PRNGKeyArray | None
) -> Array:
    """A standard deviation in the dtype of the states, shape () or (n,)."""
    if key is None and not (require.is_concrete(level) and np.all(np.asarray(level) == 0)):
        raise ValueError(f"{name} needs randomness: pass `key=jax.random.key(...)`.")
    array = _shaped(require.floating(level, name), name, (), states.shape[1:])
    array = require.value(
        array,
        ~((array >= 0) & jnp.isfinite(array)),
        lambda: f"{name} is a standard deviation, finite and not negative; got {array}.",
    )
    return array.astype(states.dtype)


def _failure(failed: Array) -> str:
    if require.is_concrete(failed):
        which = f"The trajectory of x0 in row {', '.join(map(str, np.flatnonzero(failed)))}"
    else:
        which = "A trajectory"
    return (
        f"{which} could not be integrated to the end of ts: the field blows up or is NaN on the "
        "way (a collision, an escape to infinity), or the time span needs too many steps. "
        "Start elsewhere, shorten ts, or check the field at x0."
    )


# Far more than a smooth trajectory needs beside one step for each of ts: a few dozen per swing of
# a pendulum.
_MAX_STEPS = 2**16


@eqx.filter_jit
def _trajectories(
    field: Callable[[Array], Array], states: Float[Array, "B n"], ts: Float[Array, " T"]
) -> tuple[Float[Array, "B T n"], Float[Array, "B T n"], Array]:
    """True states and velocities at times ts from the first on, and which trajectories failed."""
    import diffrax  # heavy, so it loads when used

    def velocity(t, x, field):
        del t
        return field(x).astype(x.dtype)

    tolerance = max(1e-10, 10 * float(jnp.finfo(states.dtype).eps))
    # Steps end on ts: the solver's interpolant between steps is of lower order, and was measured
    # to break conservation of energy by 1e-7 where the steps themselves keep it to 1e-10.
    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(rtol=tolerance, atol=tolerance), step_ts=ts
    )

    def trajectory(x0):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(velocity),
            diffrax.Dopri8(),
            t0=ts[0],
            t1=ts[-1],
            dt0=None,
            y0=x0,
            args=field,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=controller,
            max_steps=_MAX_STEPS + ts.size,
            throw=False,
        )
        return cast(Array, solution.ys), solution.result == diffrax.RESULTS.successful

    X, successful = jax.vmap(trajectory)(states)
    Y = jax.vmap(jax.vmap(lambda x: velocity(None, x, field)))(X)
    finite = jnp.isfinite(X).all(axis=(1, 2)) & jnp.isfinite(Y).all(axis=(1, 2))
    return X, Y, ~(successful & finite)
