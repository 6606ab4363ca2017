"""Friction: in the operator J − R (`PortHamiltonian`), and as a force curve (`Friction`)."""

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Bounds,
    Invariance,
    Point,
    Points,
    as_scalar_kernel,
    log_per_coordinate,
)
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._structures.base import AbstractMatrixKernel, nodes_of
from hamkernel._structures.structure import AbstractPotentialKernel, canonical, check_even

# The default rest speed, as a fraction of the root mean square of the momenta. For a real pendulum
# (`tests/benchmarks/real_logs.py`), the error of rollouts in which the pendulum comes to rest is
#
#     fraction     .03      .006     .003     .001
#     log p       6892     6911     6917     6917
#     error        .16      .11      .11      .12 rad
#
# For a drive (`tests/benchmarks/machines.py`) the error of free runs is
#
#     fraction     .03      .01      .003
#     log p     13 586   13 770   13 858
#     error        3.3      3.2      2.3 mm
#
# A simulated minute of a sticking pendulum takes 17 ms with .003, and 6 ms with .01. We do not
# train the rest speed, since it then absorbs other effects: on the real pendulum the error of
# rollouts under another controller rose from .13 to .5 rad.
REST_SPEED_FRACTION = 0.003
DEFAULT_REST_SPEED = 0.1  # if there are no data


def damped_coordinates(damped: tuple[int, ...] | None, n: int) -> tuple[int, ...]:
    """The coordinates with friction in a state of n coordinates; the momenta if `damped` is None.

    Raises:
        ValueError: `damped` names a coordinate that does not exist.
    """
    if damped is not None and max(damped) >= n:
        raise ValueError(
            f"damped = {damped} names a coordinate that does not exist: the states have {n}, "
            f"counted from 0, and the momenta are {tuple(range(n // 2, n))}."
        )
    return tuple(range(n // 2, n)) if damped is None else damped


class PortHamiltonian(AbstractPotentialKernel):
    """K(x, z) = (J − R) [∂x ∂zᵀ k(x, z)] (J − R)ᵀ: fields f = (J − R)∇H with friction R ≥ 0.

    R is diagonal and constant, positive on the damped coordinates and zero on the others. If the
    momenta are damped, q̇ = ∂H/∂p and ṗ = −∂H/∂q − r ∂H/∂p = −∂H/∂q − r q̇, viscous friction. Along
    the flow dH/dt = −∇HᵀR∇H = −`field.dissipation(x)`.

    The friction r is a hyperparameter: every objective of `tune` finds r, and `frozen="friction"`
    keeps r fixed. Friction on p is unique if ∂²H/∂p² is invertible. In a nearly linear system the
    data determine only the sum of the frictions on q and p. If r is at the lower end of its bounds
    (`tuned.at_bounds`), the data show no friction.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        friction: r > 0, a number for all damped coordinates or one for each. For damped momenta its
            unit is momentum/position (mass per time).
        damped: the coordinates with friction, counted from 0; the momenta if None.

    Raises:
        TypeError: `kernel` is not a scalar kernel.
        ValueError: the friction is not positive, or has another shape; `damped` are no coordinates;
            or, with data, n is odd, `damped` names a coordinate that does not exist, or H does not
            depend on a damped coordinate.

    Example: `hk.tune(hk.PortHamiltonian(1.0 * hk.Gaussian(1.0), friction=0.1), X, Y,
        objective="marginal_likelihood").kernel.friction`.

    Source: van der Schaft & Jeltsema (2014), Port-Hamiltonian Systems Theory; as a Gaussian
        process Beckers et al. (2022).
    """

    log_friction: Float[Array, "..."]
    damped: tuple[int, ...] | None = eqx.field(static=True)

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False
    has_hamiltonian: ClassVar[bool] = True
    conserves: ClassVar[bool] = False

    def __init__(
        self, kernel: Any, friction: ArrayLike = 0.1, damped: int | Sequence[int] | None = None
    ):
        self.kernel = as_scalar_kernel(kernel)
        cure = (
            "For a system without friction use Symplectic(k), and for other damping, or energy "
            "that grows, Structured(k, operator)."
        )
        array = require.positive(friction, "friction", cure)
        self.damped = None if damped is None else require.coordinates(damped, "damped")
        max_size = array.size if self.damped is None else len(self.damped)
        if array.ndim > 1 or (array.ndim and array.size != max_size):
            raise ValueError(
                f"friction has shape {array.shape}; one number, or one for each of the "
                f"{max_size} damped coordinates, is needed."
            )
        self.log_friction = jnp.log(array)

    @property
    def friction(self) -> Float[Array, "..."]:
        """The friction r, one number or one for each damped coordinate."""
        return jnp.exp(self.log_friction)

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return canonical(v) - self._damping(v)

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return -canonical(v) - self._damping(v)

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        """The dissipated power ∇HᵀR∇H ≥ 0, for ∇H = `slope`."""
        return jnp.sum(self.resistance(len(x)).astype(x.dtype) * slope**2)

    def resistance(self, n: int) -> Float[Array, " n"]:
        """The diagonal of R, shape (n,)."""
        zero = jnp.zeros(n, self.log_friction.dtype)
        return zero.at[np.asarray(damped_coordinates(self.damped, n))].set(self.friction)

    def _damping(self, v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        r = self.resistance(len(v)).astype(v.dtype)
        return r.reshape(-1, *(1,) * (v.ndim - 1)) * v

    def operator_at(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        # Separately trained frictions get different generic values: √2, √3, √4, …
        apart = jnp.sqrt(jnp.arange(2.0, 2 + self.log_friction.size)).astype(x.dtype)
        stand_in = jnp.log(apart.reshape(self.log_friction.shape))
        general = eqx.tree_at(lambda K: K.log_friction, self, stand_in)
        return general.apply(x, jnp.eye(len(x), dtype=x.dtype))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """Bounds of log r around log Δp/Δq, for extents (Δq, Δp) of the data.

        For an oscillator Δp/Δq = √(km), half of the critical friction.
        """
        n = X.shape[1]
        damped = np.asarray(damped_coordinates(self.damped, n))
        extent = np.ptp(X, axis=0)
        extent = np.where(extent > 0, extent, 1.0)
        critical = np.log(extent[damped] / extent[(damped + n // 2) % n])
        if self.log_friction.ndim == 0:
            critical = critical.mean()
        # At r = 1e-5 √(km) an oscillation loses the fraction π·1e-5 = 3e-5 of its amplitude in a
        # period, far less than data can resolve. At r = 30 √(km) the motion creeps.
        return critical + np.log(1e-5), critical + np.log(30.0)

    def check_dimension(self, n: int) -> None:
        check_even(n, "a PortHamiltonian kernel")
        coordinates = damped_coordinates(self.damped, n)
        if self.log_friction.ndim and self.log_friction.size != len(coordinates):
            raise ValueError(
                f"friction has {self.log_friction.size} numbers: give one for all momenta, or one "
                f"for each; states of n = {n} coordinates have {len(coordinates)}."
            )
        unused = sorted(set(coordinates) - frozenset().union(*self.kernel.supports(n)))
        if unused:
            raise ValueError(
                f"the friction on coordinate {unused[0]} is -r ∂H/∂x, and the kernel of H does not "
                "depend on this coordinate, so the friction would be zero. If the kinetic energy is"
                " known as a mean, q̇ = p/m, add hk.Friction() to hk.Symplectic(k) instead."
            )
        super().check_dimension(n)


class Friction(AbstractMatrixKernel):
    """K_ii(x, z) = F(xᵢ) F(zᵢ): forces −a F(v) on the momenta, a ~ N(0, 1), for a sum of kernels.

    F(v) = d v + c tanh(v/ε) + s exp(−(v/w)²) tanh(v/ε) is viscous, dry (Coulomb) and Stribeck
    friction, with d, c, s and w > 0 as hyperparameters. F is odd and has the sign of v, so a force
    with a > 0 removes energy at every speed, inside and outside the data. The fit finds a. If
    a < 0, the force drives the motion.

    Add this kernel to the kernel of the energy, `Sum(energy=Symplectic(k), friction=Friction())`.
    The energy is then `field.part("energy").hamiltonian`. Its kernel need not depend on the
    momenta: if q̇ = p/m is the prior mean, use `Symplectic(Select(k, 0))`. If the curve is too
    simple, add a smooth term such as `Odd(CurlFree(Select(k, 1)))`, which vanishes away from the
    data.

    The friction of a joint between links depends on the velocity of the joint, not on one momentum.
    This velocity is (M(q)⁻¹p)ᵢ, or the difference of two such components. The friction is
    −∂D/∂v = −M(q) ∂D/∂p with Rayleigh's function D(v) = ½ d v² + c ε log cosh v/ε. Use a structure
    with the operator −M(q) and one product kernel for each term of D:

        def terms(x):  # v: the velocities of the joints at x = (q, p)
            v = velocities(x)
            return jnp.concatenate([v**2 / 2, eps * jnp.logaddexp(v / eps, -v / eps)])

        def operator(x):
            zero = jnp.zeros((m, m))
            return jnp.block([[zero, zero], [zero, -M(x[:m])]])

        joints = hk.Structured(1.0 * hk.Warp(lambda a, b: a @ b, terms), operator)

    Args:
        viscous: the first guess of d, in 1/time.
        coulomb: the first guess of c, a force.
        stribeck: the first guess of s, the difference of static and sliding friction; None for
            none.
        rest_speed: ε > 0, the momentum below which dry friction fades to zero, so that the force is
            smooth; not trained. If None, fits and `learn` take .003 of the smallest root mean
            square of the damped momenta (the kernel of the result has the number), and other
            functions .1. Under `jax.jit` a number is needed. A smaller ε costs a simulation more
            steps. A system that should stick creeps at a speed of about ε, and error bars do not
            account for the creep (`tests/benchmarks/model_error.py friction`).
        stribeck_speed: the first guess of w, the momentum above which the joint slides.
        damped: the coordinates with friction, counted from 0; the momenta if None.

    Each guess is a number for all damped coordinates, or an array with one for each.

    Raises:
        ValueError: a guess is not positive and finite; `damped` are no coordinates; or, with data,
            n is odd and `damped` is None, or `damped` names a coordinate that does not exist.
        TypeError: a guess is no number.

    Example: `hk.Sum(energy=hk.Symplectic(hk.Select(k, 0)), friction=hk.Friction(0.1, 1.0))`.

    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30, 1083.
    """

    log_viscous: Float[Array, "..."]
    log_coulomb: Float[Array, "..."]
    log_stribeck: Float[Array, "..."] | None
    log_stribeck_speed: Float[Array, "..."] | None
    rest_speed: float | None = eqx.field(static=True)
    damped: tuple[int, ...] | None = eqx.field(static=True)

    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = (
        "friction has no potential: ask the part of the sum with the energy, "
        "field.part(…).hamiltonian."
    )

    def __init__(
        self,
        viscous: ArrayLike = 0.1,
        coulomb: ArrayLike = 0.1,
        stribeck: ArrayLike | None = None,
        rest_speed: float | None = None,
        stribeck_speed: ArrayLike = 0.5,
        damped: int | Sequence[int] | None = None,
    ):
        self.log_viscous = log_per_coordinate(viscous, "viscous")
        self.log_coulomb = log_per_coordinate(coulomb, "coulomb")
        has_speed = rest_speed is not None
        self.rest_speed = require.positive_number(rest_speed, "rest_speed") if has_speed else None
        self.log_stribeck = self.log_stribeck_speed = None
        if stribeck is not None:
            self.log_stribeck = log_per_coordinate(stribeck, "stribeck")
            self.log_stribeck_speed = log_per_coordinate(stribeck_speed, "stribeck_speed")
        self.damped = None if damped is None else require.coordinates(damped, "damped")

    @property
    def viscous(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_viscous)

    @property
    def coulomb(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_coulomb)

    @property
    def stribeck(self) -> Float[Array, "..."] | None:
        return None if self.log_stribeck is None else jnp.exp(self.log_stribeck)

    @property
    def stribeck_speed(self) -> Float[Array, "..."] | None:
        return None if self.log_stribeck_speed is None else jnp.exp(self.log_stribeck_speed)

    def curve(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The curve F at the damped coordinates of a state; 0 at the others, shape (n,)."""
        damped = np.asarray(damped_coordinates(self.damped, len(x)))
        rest_speed = DEFAULT_REST_SPEED if self.rest_speed is None else self.rest_speed
        return jnp.zeros_like(x).at[damped].set(sum(self.terms(x[damped], rest_speed)))

    def terms(self, v: Float[Array, " m"], rest_speed: ArrayLike) -> list[Float[Array, " m"]]:
        """The viscous, the dry and, if `stribeck` is set, the Stribeck force at the speeds v."""
        stick = jnp.tanh(v / rest_speed)
        forces = [self.viscous.astype(v.dtype) * v, self.coulomb.astype(v.dtype) * stick]
        if self.stribeck is not None and self.stribeck_speed is not None:
            fades = jnp.exp(-((v / self.stribeck_speed.astype(v.dtype)) ** 2))
            forces.append(self.stribeck.astype(v.dtype) * fades * stick)
        return forces

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return (self.curve(x) * u) @ (self.curve(z) * v)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        return self.curve(x) * jnp.sum(jax.vmap(self.curve)(Z) * A, axis=0)

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """Bounds of forces around √amplitude, and of speeds up to the largest in X."""
        damped = list(damped_coordinates(self.damped, X.shape[1]))
        fastest = np.abs(X[:, damped]).max(axis=0)
        fastest = np.where(fastest > 0, fastest, 1.0)
        if getattr(self, name).ndim == 0:
            fastest = fastest.max()
        if name == "log_stribeck_speed":
            # Near the turning points of a swing of n samples the speed changes by 2π/n of the
            # largest speed per sample: 2 % of the largest speed needs 300 samples.
            return np.log(0.02 * fastest), np.log(fastest)
        force = 0.5 * np.log(amplitude)
        if name == "log_viscous":
            force = force - np.log(fastest)
        # Three decades on both sides of the force that explains the velocities.
        return force - np.log(1e3), force + np.log(1e3)

    def check_dimension(self, n: int) -> None:
        if self.damped is None and n % 2:
            raise ValueError(
                f"Friction acts on the momenta of states x = (q, p), and there are n = {n} "
                "coordinates: say which have friction, Friction(…, damped=(2,))."
            )
        coordinates = damped_coordinates(self.damped, n)
        for guess in jax.tree.leaves(self):
            if guess.ndim and guess.size != len(coordinates):
                raise ValueError(
                    f"a guess of Friction has {guess.size} numbers and {len(coordinates)} "
                    "coordinates are damped: give one for all, or one for each."
                )

    def with_parity(self, parity: int) -> "Friction":
        if parity > 0:
            raise TypeError("friction is odd, F(-v) = -F(v): add it to Even(K), Even(K) + Friction")
        return self

    def average_over(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(
            "friction has no potential that could have a symmetry: give the symmetry to the energy "
            "alone, Sum(energy=Invariant(K, maps), friction=Friction())."
        )

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return ()

    @property
    def invariance(self) -> Invariance:
        return Invariance.REFLECTION


def frictions(K: AbstractMatrixKernel) -> list[Friction]:
    """The `Friction` kernels inside K."""
    return nodes_of(Friction, K)


def with_rest_speed(K: AbstractMatrixKernel, X: Float[Array, "N d"], n: int) -> Any:
    """The kernel K with a rest speed in every `Friction`, from the states X[:, :n].

    The damped coordinate with the smallest nonzero root mean square sets the rest speed. If all are
    zero, the rest speed is .1.
    """
    if all(part.rest_speed is not None for part in frictions(K)):
        return K
    require.no_tracers(
        "hk.Friction() without a rest speed", "Name it: hk.Friction(rest_speed=…).", X
    )
    with require.eager():
        speeds = np.asarray(jnp.sqrt(jnp.mean(jnp.square(X[:, :n]), axis=0)))

    def set_speed(node: Any) -> Any:
        if not isinstance(node, Friction) or node.rest_speed is not None:
            return node
        moving = [v for v in speeds[list(damped_coordinates(node.damped, n))] if v > 0]
        out = copy.copy(node)
        object.__setattr__(
            out,
            "rest_speed",
            REST_SPEED_FRACTION * float(min(moving)) if moving else DEFAULT_REST_SPEED,
        )
        return out

    return jax.tree.map(set_speed, K, is_leaf=lambda node: isinstance(node, Friction))
