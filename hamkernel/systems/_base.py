"""The base of all systems: the field that follows from H, and the storage of parameters."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._show import described

Numbers = ArrayLike | Sequence[ArrayLike]
Field = TypeVar("Field", bound=Callable[[Array], Array])


class AbstractHamiltonianSystem(eqx.Module):
    """A Hamiltonian H(x), and the field J∇H that follows from it.

    A final class with H = T(p) + U(q) sets `is_separable = True`, which explicit symplectic
    integrators require.
    """

    is_separable: ClassVar[bool] = False

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
        return _velocity(self, x)

    def __repr__(self) -> str:
        return described(self)


@eqx.filter_jit
def _velocity(system: AbstractHamiltonianSystem, x: Float[Array, " n"]) -> Float[Array, " n"]:
    dq, dp = jnp.split(jax.grad(in_precision(system, x.dtype).hamiltonian)(x), 2)
    return jnp.concatenate([dp, -dq])


def in_precision(field: Field, dtype: jnp.dtype) -> Field:
    """`field` with its real arrays in the dtype of the states; a plain function has none."""

    def cast_leaf(leaf):
        real = eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf.astype(dtype) if real else leaf

    return jax.tree.map(cast_leaf, field)


def at(system: Field, x: Num[ArrayLike, " n"], n: int) -> tuple[Field, Float[Array, " n"]]:
    """`system` in the dtype of x, and x, which must be one state of n coordinates."""
    x = require.point(x, n)
    return in_precision(system, x.dtype), x


def shaped(x: Array, name: str, *shapes: tuple[int, ...]) -> Array:
    """`x`, whose shape must be one of `shapes`."""
    if x.shape not in shapes:
        needed = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {x.shape}; shape {needed} is needed.")
    return x


def log_parameter(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """The logarithm of a positive parameter, by default a scalar."""
    array = require.positive(x, name)
    return jnp.log(shaped(array, name, *(shapes or ((),))))


def positive(name: str, doc: str) -> Any:
    """The property that reads the positive parameter stored as the logarithm `log_<name>`."""
    return property(lambda system: jnp.exp(getattr(system, f"log_{name}")), doc=doc)


def signed_parameter(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """A finite parameter of either sign, by default a scalar."""
    array = shaped(require.floating(x, name), name, *(shapes or ((),)))
    bad = require.not_finite(array)
    return require.value(array, bad, lambda: f"{name} must be finite, got {array}.")


def count_of(x: Numbers, name: str) -> int:
    """The number of entries of a list of masses or circulations, at least two."""
    shape = require.floating(x, name).shape
    if len(shape) != 1 or shape[0] < 2:
        raise ValueError(f"{name} has shape {shape}; one number for each of two or more is needed.")
    return shape[0]


def squared_distances(positions: Float[Array, "bodies 2"]) -> tuple[np.ndarray, np.ndarray, Array]:
    """Indices i < j of all pairs, and |r_i − r_j|² of each; a body never meets itself."""
    i, j = np.triu_indices(positions.shape[0], k=1)
    return i, j, jnp.sum((positions[i] - positions[j]) ** 2, axis=1)
