"""Friction as a force that is known everywhere but for a few numbers: a kernel of one curve."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, log_per_coordinate
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._structures.base import AbstractMatrixKernel

_DECADES = np.log(1e3)  # of a force, to both sides of one that explains the velocities
# Of the largest speed. A swing through n samples passes its turning points in steps of 2π/n of the
# largest speed, so with fewer than 300 samples a swing a log does not resolve what is finer.
_LEAST_SPEED = 0.02


class Friction(AbstractMatrixKernel):
    """K_ii(x, z) = F(xᵢ) F(zᵢ): forces −a F(v) on the momenta, a ~ N(0, 1), for a sum of kernels.

    F(v) = d v + c tanh(v/ε) + s exp(−(v/w)²) tanh(v/ε): viscous, dry (Coulomb) and Stribeck
    friction, with d, c, s and w > 0 as hyperparameters. F is odd and has the sign of v, so the
    force takes energy away at every speed, measured or not, where a > 0; the closed form finds a,
    and it is negative only for a motion that friction drives. A Gaussian kernel of the momentum
    falls to zero outside the data instead, and with it the friction.

    It stands beside the kernel of the energy, `Sum(energy=Symplectic(k), friction=Friction())`, and
    needs no energy that depends on the momenta: with q̇ = p/m known and
    `Symplectic(Select(k, 0))` for the rest it is found from positions alone, where the R ∂H/∂p of
    `PortHamiltonian` is zero. What the curve cannot say, a smooth remainder that vanishes outside
    the data is for: one more term `Odd(CurlFree(Select(k, 1)))`. The energy of the sum is that of
    its part, `field.part("energy").hamiltonian`.

    Args:
        viscous: the first guess of d, in units of the momentum's rate over the momentum.
        coulomb: that of c, a force.
        stribeck: that of s, the force by which sticking exceeds sliding; None for none.
        rest_speed: ε > 0, the momentum below which dry friction fades to zero: no guess but a
            number that makes the force smooth, and is not trained. A hundredth of the largest
            momentum is sharp; less costs a simulation more steps. Trained, it takes up what the
            log has beside friction: on a real pendulum it rose from a hundredth to a fifth of the
            largest speed, and the error of rollouts under another controller from .13 to .5 rad.
        stribeck_speed: that of w, the momentum above which it slides.
        damped: the coordinates with friction, counted from 0; the momenta if None.

    Each guess is a number for all damped coordinates, or an array with one for each.

    Raises:
        ValueError: a guess is not positive and finite, or `damped` are no coordinates. With data: n
            is odd and `damped` is None, or there is no such coordinate. TypeError: a guess is no
            number.

    Example: `hk.Sum(energy=hk.Symplectic(hk.Select(k, 0)), friction=hk.Friction(0.1, 1.0))`.

    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30, 1083.
    """

    log_viscous: Float[Array, "..."]
    log_coulomb: Float[Array, "..."]
    log_stribeck: Float[Array, "..."] | None
    log_stribeck_speed: Float[Array, "..."] | None
    rest_speed: float = eqx.field(static=True)
    damped: tuple[int, ...] | None = eqx.field(static=True)

    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = (
        "friction has no potential: the energy is that of another part of the sum, "
        "field.part(…).hamiltonian."
    )

    def __init__(
        self,
        viscous: ArrayLike = 0.1,
        coulomb: ArrayLike = 0.1,
        stribeck: ArrayLike | None = None,
        rest_speed: float = 0.1,
        stribeck_speed: ArrayLike = 0.5,
        damped: int | Sequence[int] | None = None,
    ):
        self.log_viscous = log_per_coordinate(viscous, "viscous")
        self.log_coulomb = log_per_coordinate(coulomb, "coulomb")
        self.rest_speed = require.positive_number(rest_speed, "rest_speed")
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
        """F of the damped coordinates of a state, zero elsewhere."""
        damped = np.asarray(self._coordinates(len(x)))
        v = x[damped]
        stick = jnp.tanh(v / self.rest_speed)
        force = self.viscous.astype(x.dtype) * v + self.coulomb.astype(x.dtype) * stick
        if self.stribeck is not None and self.stribeck_speed is not None:
            fades = jnp.exp(-((v / self.stribeck_speed.astype(x.dtype)) ** 2))
            force = force + self.stribeck.astype(x.dtype) * fades * stick
        return jnp.zeros_like(x).at[damped].set(force)

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return (self.curve(x) * u) @ (self.curve(z) * v)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return self.curve(x) * jnp.sum(jax.vmap(self.curve)(Z) * A, axis=0)

    def bounds(
        self, name: str, X: Float[np.ndarray, "N n"], amplitude: float
    ) -> tuple[ArrayLike, ArrayLike]:
        """Bounds of forces around √amplitude, and of speeds up to the largest in X."""
        damped = list(self._coordinates(X.shape[1]))
        fastest = np.abs(X[:, damped]).max(axis=0)
        fastest = np.where(fastest > 0, fastest, 1.0)
        if getattr(self, name).ndim == 0:
            fastest = fastest.max()
        if name == "log_stribeck_speed":
            return np.log(_LEAST_SPEED * fastest), np.log(fastest)
        force = 0.5 * np.log(amplitude)
        if name == "log_viscous":
            force = force - np.log(fastest)
        return force - _DECADES, force + _DECADES

    def check_dimension(self, n: int) -> None:
        if self.damped is None and n % 2:
            raise ValueError(
                f"Friction acts on the momenta of states x = (q, p), and there are n = {n} "
                "coordinates: say which have friction, Friction(…, damped=(2,))."
            )
        coordinates = self._coordinates(n)
        if max(coordinates) >= n:
            raise ValueError(
                f"damped = {self.damped} names a coordinate that does not exist: the states have "
                f"{n}, counted from 0."
            )
        guesses = self.log_viscous, self.log_coulomb, self.log_stribeck
        for guess in (*guesses, self.log_stribeck_speed):
            if guess is not None and guess.ndim and guess.size != len(coordinates):
                raise ValueError(
                    f"a guess of Friction has {guess.size} numbers and {len(coordinates)} "
                    "coordinates are damped: give one for all, or one for each."
                )

    def _coordinates(self, n: int) -> tuple[int, ...]:
        return tuple(range(n // 2, n)) if self.damped is None else self.damped

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        return False

    def with_parity(self, parity: int) -> "Friction":
        if parity > 0:
            raise TypeError("friction is odd, F(-v) = -F(v): add it to Even(K), Even(K) + Friction")
        return self

    def averaged(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(
            "friction has no potential to be averaged, and no motion with friction runs backwards: "
            "say the symmetry of the energy alone, Sum(energy=Invariant(K, maps), "
            "friction=Friction())."
        )

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return ()

    @property
    def invariance(self) -> Invariance:
        return Invariance.REFLECTION
