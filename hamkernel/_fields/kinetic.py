"""`kinetic`: the kinetic energy of known masses, as a prior mean."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._show import describe


class Kinetic(eqx.Module):
    """The field (M⁻¹p, 0) of the energy T(p) = ½ pᵀM⁻¹p; made by `kinetic`.

    Attributes:
        mass: M, shape (), (m,) or (m, m).
        is_of_velocities: whether states are (q, q̇) instead of (q, p); the field is then (q̇, 0).
    """

    is_separable: ClassVar[bool] = True
    mass: Float[Array, "..."]
    is_of_velocities: bool = eqx.field(static=True, default=False)

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """The velocity (M⁻¹p, 0) of the state x = (q, p), shape (n,).

        Raises:
            ValueError: x is not one state with one position for each mass.
        """
        velocity = self._velocity(self._state(x))
        return jnp.concatenate([velocity, jnp.zeros_like(velocity)])

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The energy ½ pᵀM⁻¹p of the state x, shape ().

        Raises:
            ValueError: x is not one state with one position for each mass.
        """
        x = self._state(x)
        v, mass = self._velocity(x), self.mass.astype(x.dtype)
        return 0.5 * v @ (mass @ v if mass.ndim == 2 else mass * v)

    def _state(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        x = require.floating(x, "x")
        n = 2 * self.mass.shape[0] if self.mass.ndim else None
        if x.ndim != 1 or x.shape[0] % 2 or n not in (None, x.shape[0]):
            raise ValueError(
                f"x has shape {x.shape}; one state (q, p) of shape ({n or 'n'},), with a mass for "
                "each q, is needed."
            )
        return x

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        p, mass = x[x.shape[0] // 2 :], self.mass.astype(x.dtype)
        if self.is_of_velocities:
            return p
        return jnp.linalg.solve(mass, p) if mass.ndim == 2 else p / mass

    def __repr__(self) -> str:
        return describe(self)


def kinetic_of_velocities(mass: Float[Array, "..."]) -> Kinetic:
    """The prior mean (q̇, 0) of states (q, q̇), with the kinetic energy ½ q̇ᵀMq̇."""
    return Kinetic(mass, is_of_velocities=True)


def kinetic(mass: ArrayLike) -> Kinetic:
    """The prior mean (M⁻¹p, 0) for known masses M; the kernel then learns the forces.

        hk.learn(K, hk.Runs(times, states), mean=hk.kinetic(mass=1.0))

    The energy ½ pᵀM⁻¹p of the mean is part of `field.hamiltonian`. `save` stores the mean with the
    field, so `load` needs no `mean`.

    Args:
        mass: M, in the units p/q̇: one mass for all positions, one for each, shape (m,), or a
            symmetric positive definite matrix (m, m).

    Returns:
        A function x (n,) -> (n,) with the method `hamiltonian(x)`, n = 2m.

    Raises:
        ValueError: the shape is none of these, a mass is not positive, or the matrix is not
            symmetric positive definite.
        TypeError: `mass` holds no real numbers.
    """
    mass_array = require.floating(mass, "mass")
    if mass_array.ndim == 2 and mass_array.shape[0] == mass_array.shape[1]:
        matrix = np.asarray(mass_array)
        if not np.allclose(matrix, matrix.T) or not (np.linalg.eigvalsh(matrix) > 0).all():
            raise ValueError(
                "mass must be a symmetric positive definite matrix; got one that is not. Check its "
                "entries, or give one mass for each position, shape (m,)."
            )
        return Kinetic(mass_array)
    if mass_array.ndim > 1:
        raise ValueError(f"mass has shape {mass_array.shape}; (), (m,) or (m, m) is needed.")
    return Kinetic(require.positive(mass, "mass"))
