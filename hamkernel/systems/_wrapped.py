"""Damping and inputs, added to any system."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import described
from hamkernel.systems._base import in_precision

System = Callable[[Any], Float[Array, " n"]]


class Damped(eqx.Module):
    """A system with friction: ẋ = f(x) − R∇H, R diagonal and constant.

    With damping of the momenta ṗ = … − r ∂H/∂p = … − r q̇, viscous friction. dH/dt = −∇HᵀR∇H.

    Args:
        system: one of this module, or any field with a `hamiltonian`.
        damping: r > 0, one number, or one for each damped coordinate.
        damped: the coordinates with friction, from 0; the momenta, the second half, if None.

    Raises:
        ValueError: the damping is not positive or has the wrong shape; `damped` are not
            coordinates, or, when called, not those of the state. TypeError: the system has no
            Hamiltonian.

    Example: `hk.systems.Damped(hk.systems.Pendulum(), 0.1)`.
    """

    system: Any
    log_damping: Float[Array, "..."]
    damped: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self, system: Any, damping: ArrayLike = 0.1, damped: int | Sequence[int] | None = None
    ):
        if not callable(system) or not hasattr(system, "hamiltonian"):
            raise TypeError(
                f"Damped needs a system with a hamiltonian, such as hk.systems.Pendulum(); got "
                f"{system!r}. Of a driven one damp the inside: Driven(Damped(system), G)."
            )
        self.system = system
        self.log_damping = jnp.log(require.positive(damping, "damping"))
        self.damped = None if damped is None else require.coordinates(damped, "damped")
        if self.log_damping.ndim > 1:
            raise ValueError(f"damping has shape {self.log_damping.shape}; () or (m,) is needed.")

    @property
    def damping(self) -> Float[Array, "..."]:
        """The friction r."""
        return jnp.exp(self.log_damping)

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the energy H(x), which decreases, shape ()."""
        return self.system.hamiltonian(x)

    def dissipation(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the power lost, ∇HᵀR∇H ≥ 0, shape ()."""
        x = require.floating(x, "x")
        slope = jax.grad(in_precision(self, x.dtype).hamiltonian)(x)
        return self._resistance(x) @ slope**2

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """Return the velocity of one state, shape (n,)."""
        x = require.floating(x, "x")
        return _damped_velocity(self, x)

    def _resistance(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        n = len(x)
        which = tuple(range(n // 2, n)) if self.damped is None else self.damped
        if max(which) >= n or (self.log_damping.ndim and self.log_damping.size != len(which)):
            raise ValueError(
                f"damping of shape {self.log_damping.shape} on the coordinates {which}: the states "
                f"have {n} coordinates, and one number or one for each damped one is needed."
            )
        return jnp.zeros_like(x).at[np.asarray(which)].set(self.damping.astype(x.dtype))

    def __repr__(self) -> str:
        return described(self, positional=("system",))


@eqx.filter_jit
def _damped_velocity(system: Damped, x: Float[Array, " n"]) -> Float[Array, " n"]:
    system = in_precision(system, x.dtype)
    return system.system(x) - system._resistance(x) * jax.grad(system.system.hamiltonian)(x)


class Driven(eqx.Module):
    """A system with inputs: ẋ = f(x) + G(x) u, called as `system(x, u)`.

    `hk.simulate(system, x0, ts, inputs=u)` integrates it.

    Args:
        system: any field x (n,) -> (n,), such as one of this module.
        inputs: G, an array (n, m), or a function x -> (n, m); if None that of the system's motors,
            which `CartPole` and `Acrobot` know.

    Raises:
        TypeError: `system` is not a function, or knows of no motors. ValueError: G is not a matrix,
            or, when called, x or u does not fit it.

    Example: a torque on a pendulum with friction,
        `hk.systems.Driven(hk.systems.Damped(hk.systems.Pendulum()), [[0.0], [1.0]])`.
    """

    system: System
    inputs: Any

    def __init__(self, system: System, inputs: ArrayLike | Callable[[Array], Any] | None = None):
        if not callable(system):
            raise TypeError(f"Driven needs a system x -> (n,) first; got {system!r}.")
        if inputs is None:
            inputs = getattr(system, "actuation", None)
        if inputs is None:
            raise TypeError(
                f"{system!r} does not say where its motors act: give the input matrix, such as "
                "Driven(system, [[0.0], [1.0]])."
            )
        self.system = as_pytree(system)
        if callable(inputs):
            self.inputs = as_pytree(inputs)
        else:
            self.inputs = require.floating(inputs, "inputs")
            if self.inputs.ndim != 2:
                raise ValueError(
                    f"inputs has shape {self.inputs.shape}; a matrix G of shape (n, m) is needed, "
                    "such as [[0.0], [1.0]] for one force on the momentum."
                )

    @property
    def drift(self) -> System:
        """The system without inputs."""
        return self.system

    @property
    def takes_inputs(self) -> bool:
        """Whether a velocity needs u as well; `hk.simulate` reads this."""
        return True

    def input_matrix(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n m"]:
        """Return G(x), shape (n, m)."""
        x = require.floating(x, "x")
        G: Any = self.inputs
        G = G(x) if callable(G) else G
        if jnp.ndim(G) != 2 or len(G) != len(x):
            raise ValueError(
                f"the input matrix has shape {jnp.shape(G)} and the state {x.shape}: (n, m) and "
                "(n,) are needed. Are x and u swapped? system(x, u)."
            )
        return jnp.asarray(G).astype(x.dtype)

    def __call__(
        self, x: Num[ArrayLike, " n"], u: Num[ArrayLike, " m"] | None = None
    ) -> Float[Array, " n"]:
        """Return the velocity f(x) + G(x) u, shape (n,)."""
        if u is None:
            raise ValueError(
                "a driven system needs its inputs: system(x, u), and hk.simulate(system, x0, ts, "
                "inputs=u). Without inputs it is system.drift."
            )
        x, G = require.floating(x, "x"), self.input_matrix(x)
        u = require.floating(u, "u")
        if u.shape != G.shape[1:]:
            raise ValueError(
                f"u has shape {u.shape}; the inputs have shape {G.shape[1:]}. Is it system(x, u)?"
            )
        drift = cast(Array, self.system(x))
        return drift + G @ u.astype(x.dtype)

    def __repr__(self) -> str:
        return described(self, positional=("system",))
