"""Fields that lose energy: (J − R)∇H with friction on some of the coordinates."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Bounds, Invariance, as_scalar_kernel
from hamkernel._structures.structure import AbstractPotentialKernel, canonical, check_even

# Bounds of the damping ratio, r over the critical friction. At 1e-5 an oscillation loses 6e-5 of
# its amplitude in a period, far less than can be seen; at 30 it is overdamped 30 times over.
_LEAST_DAMPING, _MOST_DAMPING = 1e-5, 30.0


class PortHamiltonian(AbstractPotentialKernel):
    """K(x, z) = (J − R) [∂x ∂zᵀ k(x, z)] (J − R)ᵀ: fields f = (J − R)∇H with friction R ≥ 0.

    R is diagonal, constant and positive on the damped coordinates, zero on the others. With the
    momenta damped q̇ = ∂H/∂p and ṗ = −∂H/∂q − r ∂H/∂p = −∂H/∂q − r q̇: viscous friction. Along the
    flow dH/dt = −∇HᵀR∇H, `field.dissipation(x)`.

    The friction is a hyperparameter, found by every objective of `tune` and kept with
    `frozen="friction"`. Friction on p is unique if ∂²H/∂p² is invertible. In a (nearly) linear
    system only the sum of the frictions on q and p can be identified. A friction at the lower end
    of its box, see `tuned.at_bounds`, means that none was found.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        friction: r > 0, a number for all damped coordinates or one for each, in units of the
            momentum over those of the position, for damped momenta (mass per time).
        damped: the coordinates with friction, counted from 0; the momenta if None.

    Raises:
        TypeError: `kernel` is not a scalar kernel. ValueError: the friction is not positive, or not
            one number or one per damped coordinate; `damped` are no coordinates. With data: n is
            odd, or there is no such coordinate.

    Example: `hk.tune(hk.PortHamiltonian(1.0 * hk.Gaussian(1.0), friction=0.1), X, Y,
        objective="marginal_likelihood").kernel.friction`.

    Source: van der Schaft & Jeltsema (2014), Port-Hamiltonian Systems Theory; as a Gaussian
        process Beckers et al. (2022).
    """

    kernel: AbstractScalarKernel
    log_friction: Float[Array, "..."]
    damped: tuple[int, ...] | None = eqx.field(static=True)

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False
    has_hamiltonian: ClassVar[bool] = True
    conserves: ClassVar[bool] = False

    def __init__(
        self,
        kernel: Any,
        friction: ArrayLike = 0.1,
        damped: int | Sequence[int] | None = None,
    ):
        self.kernel = as_scalar_kernel(kernel)
        cure = (
            "Energy that grows is no friction; for a system without friction use Symplectic(k), "
            "and for other damping Structured(k, operator)."
        )
        array = require.positive(friction, "friction", cure)
        self.damped = None if damped is None else require.coordinates(damped, "damped")
        most = array.size if self.damped is None else len(self.damped)
        if array.ndim > 1 or (array.ndim and array.size != most):
            raise ValueError(
                f"friction has shape {array.shape}; one number, or one for each of the "
                f"{most} damped coordinates, is needed."
            )
        self.log_friction = jnp.log(array)

    @property
    def friction(self) -> Float[Array, "..."]:
        """The friction r, one number or one for each damped coordinate."""
        return jnp.exp(self.log_friction)

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return canonical(v) - self._rubbed(v)

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return -canonical(v) - self._rubbed(v)

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        """∇HᵀR∇H, a sum of squares."""
        return jnp.sum(self.resistance(len(x)).astype(x.dtype) * slope**2)

    def resistance(self, n: int) -> Float[Array, " n"]:
        """The diagonal of R."""
        zero = jnp.zeros(n, self.log_friction.dtype)
        return zero.at[np.asarray(self._coordinates(n))].set(self.friction)

    def _rubbed(self, v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        r = self.resistance(len(v)).astype(v.dtype)
        return r.reshape(-1, *(1,) * (v.ndim - 1)) * v

    def _coordinates(self, n: int) -> tuple[int, ...]:
        return tuple(range(n // 2, n)) if self.damped is None else self.damped

    def operator_at(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        # Frictions that are trained apart must be told apart: the square roots of 2, 3, 4, …
        apart = jnp.sqrt(jnp.arange(2.0, 2 + self.log_friction.size)).astype(x.dtype)
        stand_in = jnp.log(apart.reshape(self.log_friction.shape))
        general = eqx.tree_at(lambda K: K.log_friction, self, stand_in)
        return general.apply(x, jnp.eye(len(x), dtype=x.dtype))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """Bounds for log r: an oscillation of extents (Δq, Δp) in X is critical near r = Δp/Δq."""
        n = X.shape[1]
        damped = np.asarray(self._coordinates(n))
        extent = np.ptp(X, axis=0)
        extent = np.where(extent > 0, extent, 1.0)
        critical = np.log(extent[damped] / extent[(damped + n // 2) % n])
        if self.log_friction.ndim == 0:
            critical = critical.mean()
        return critical + np.log(_LEAST_DAMPING), critical + np.log(_MOST_DAMPING)

    def check_dimension(self, n: int) -> None:
        check_even(n, "a PortHamiltonian kernel")
        coordinates = self._coordinates(n)
        if max(coordinates) >= n:
            raise ValueError(
                f"damped = {self.damped} names a coordinate that does not exist: the states have "
                f"{n}, counted from 0, and the momenta are {tuple(range(n // 2, n))}."
            )
        if self.log_friction.ndim and self.log_friction.size != len(coordinates):
            raise ValueError(
                f"friction has {self.log_friction.size} numbers: give one for all momenta, or one "
                f"for each; states of n = {n} coordinates have {len(coordinates)}."
            )
        unseen = sorted(set(coordinates) - frozenset().union(*self.kernel.supports(n)))
        if unseen:
            raise ValueError(
                f"friction on coordinate {unseen[0]} is -r ∂H/∂x there, and the kernel of H does "
                "not depend on that coordinate, so there would be none. Where the kinetic energy is"
                " known as a mean, q̇ = p/m, add hk.Friction() to hk.Symplectic(k) instead."
            )
        super().check_dimension(n)
