"""The base classes of systems, damping and inputs for any system, and noisy data."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key, Num, UInt32

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._machine import compiled_by_size, compiled_without_emitters
from hamkernel._show import describe

Numbers = ArrayLike | Sequence[ArrayLike]
Function = TypeVar("Function", bound=Callable[[Array], Array])


class AbstractHamiltonianSystem(eqx.Module):
    """A system with the Hamiltonian H(x) and the field J∇H.

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
        return describe(self)


@eqx.filter_jit
def _velocity(system: AbstractHamiltonianSystem, x: Float[Array, " n"]) -> Float[Array, " n"]:
    dq, dp = jnp.split(jax.grad(cast_arrays(system, x.dtype).hamiltonian)(x), 2)
    return jnp.concatenate([dp, -dq])


def cast_arrays(field: Function, dtype: jnp.dtype) -> Function:
    """`field` with its real arrays cast to `dtype`; a plain function is unchanged."""

    def cast_leaf(leaf):
        real = eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf.astype(dtype) if real else leaf

    return jax.tree.map(cast_leaf, field)


def cast_state(
    system: Function, x: Num[ArrayLike, " n"], n: int
) -> tuple[Function, Float[Array, " n"]]:
    """`system` in the dtype of x, and x, checked to be one state of n coordinates."""
    x = require.point(x, n)
    return cast_arrays(system, x.dtype), x


def require_shape(x: Array, name: str, *shapes: tuple[int, ...]) -> Array:
    """`x`, checked to have one of the `shapes`."""
    if x.shape not in shapes:
        needed = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {x.shape}; shape {needed} is needed.")
    return x


def log_parameter(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """The logarithm of a positive parameter, by default a scalar."""
    array = require.positive(x, name)
    return jnp.log(require_shape(array, name, *(shapes or ((),))))


def positive_parameter(name: str, doc: str) -> Any:
    """The property exp(log_<name>) for a positive parameter stored as a logarithm."""
    return property(lambda system: jnp.exp(getattr(system, f"log_{name}")), doc=doc)


def signed_parameter(x: Numbers, name: str, *shapes: tuple[int, ...]) -> Array:
    """A finite parameter of either sign, by default a scalar."""
    array = require_shape(require.floating(x, name), name, *(shapes or ((),)))
    bad = require.not_finite(array)
    return require.value(array, bad, lambda: f"{name} must be finite, got {array}.")


def count_of(x: Numbers, name: str) -> int:
    """The number of entries of a list of masses or circulations, at least two."""
    shape = require.floating(x, name).shape
    if len(shape) != 1 or shape[0] < 2:
        raise ValueError(f"{name} has shape {shape}; one number for each of two or more is needed.")
    return shape[0]


def squared_distances(positions: Float[Array, "bodies 2"]) -> tuple[np.ndarray, np.ndarray, Array]:
    """The indices i < j of all pairs of bodies, and |r_i − r_j|² of each pair."""
    i, j = np.triu_indices(positions.shape[0], k=1)
    return i, j, jnp.sum((positions[i] - positions[j]) ** 2, axis=1)


VectorField = Callable[[Any], Float[Array, " n"]]


class Damped(eqx.Module):
    """A system with friction: ẋ = f(x) − R∇H, where R is diagonal and constant.

    If the momenta are damped, ṗ = … − r ∂H/∂p = … − r q̇ is viscous friction. The energy obeys
    dH/dt = −∇HᵀR∇H.

    Args:
        system: a system of this module, or any field with a `hamiltonian`.
        damping: r > 0, one number, or one for each damped coordinate.
        damped: the coordinates with friction, from 0; if None, the momenta, the second half.

    Raises:
        ValueError: the damping is not positive or has the wrong shape; `damped` are not
            coordinates; or, when called, the state has fewer coordinates.
        TypeError: the system has no Hamiltonian.

    Example: `hk.systems.Damped(hk.systems.Pendulum(), 0.1)`.
    """

    system: Any
    log_damping: Float[Array, "..."]
    damped: tuple[int, ...] | None = eqx.field(static=True)
    damping = positive_parameter("damping", "The friction r.")

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

    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the energy H(x), which decreases, shape ()."""
        return self.system.hamiltonian(x)

    def dissipation(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """Return the dissipated power ∇HᵀR∇H ≥ 0, shape ()."""
        x = require.floating(x, "x")
        slope = jax.grad(cast_arrays(self, x.dtype).hamiltonian)(x)
        return jnp.sum(self._resistance(x) * slope**2)

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
        return describe(self, positional=("system",))


@eqx.filter_jit
def _damped_velocity(system: Damped, x: Float[Array, " n"]) -> Float[Array, " n"]:
    system = cast_arrays(system, x.dtype)
    return system.system(x) - system._resistance(x) * jax.grad(system.system.hamiltonian)(x)


class Driven(eqx.Module):
    """A system with inputs: ẋ = f(x) + G(x) u, called as `system(x, u)`.

    `hk.simulate(system, x0, ts, inputs=u)` integrates it.

    Args:
        system: any field x (n,) -> (n,), such as a system of this module.
        inputs: G, an array (n, m), or a function x -> (n, m). If None, the attribute
            `system.actuation`, which `CartPole` and `Acrobot` have.

    Raises:
        TypeError: `system` is not a function, or G is None and `system` has no `actuation`.
        ValueError: G is not a matrix, or, when called, x or u does not fit G.

    Example: a torque on a pendulum with friction,
        `hk.systems.Driven(hk.systems.Damped(hk.systems.Pendulum()), [[0.0], [1.0]])`.
    """

    system: VectorField
    inputs: Any

    def __init__(
        self, system: VectorField, inputs: ArrayLike | Callable[[Array], Any] | None = None
    ):
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
    def drift(self) -> VectorField:
        """The system without inputs."""
        return self.system

    @property
    def takes_inputs(self) -> bool:
        """True: a velocity needs u too. `hk.simulate` reads this attribute."""
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
        return drift + jnp.matmul(G, u.astype(x.dtype), precision="highest")

    def __repr__(self) -> str:
        return describe(self, positional=("system",))


def sample(
    system: Callable[[Array], Array],
    x0: Num[ArrayLike, "*batch n"],
    ts: Num[ArrayLike, " T"],
    state_noise: Num[ArrayLike, "..."] = 0.0,
    velocity_noise: Num[ArrayLike, "..."] = 0.0,
    *,
    key: Key[Array, ""] | UInt32[Array, "..."] | None = None,
) -> tuple[Float[Array, "*batch T n"], Float[Array, "*batch T n"]]:
    """Return noisy states and velocities along trajectories of `system`.

        X = x(t) + state_noise · ξ,   Y = f(x(t)) + velocity_noise · η,   ξ, η ~ N(0, I)

    The velocities belong to the true states x(t), not to the noisy ones. An adaptive Runge-Kutta
    method of order 8 integrates the trajectories. The estimated error of a step is at most 1e-10 in
    float64 and about 1e-6 in float32, relative and absolute, so choose units in which states are
    not tiny. The result is differentiable in reverse mode with respect to `system`, `x0` and the
    noise levels.

    Args:
        system: any traceable field, (n,) -> (n,): a system of this module, a learned field, or a
            function.
        x0: states at time ts[0], shape (B, n), or (n,) for a single trajectory. The integration and
            the results have its dtype; `sample` casts the arrays of `system` to it.
        ts: times, shape (T,), strictly increasing.
        state_noise: standard deviation of the noise on X, shape () or (n,), in units of the state.
        velocity_noise: standard deviation of the noise on Y, shape () or (n,), per unit of time.
        key: the source of the noise, needed unless both levels are zero. Many seeds:
            `jax.vmap(lambda key: sample(..., key=key))(keys)` integrates once.

    Returns:
        X and Y, each of shape (B, T, n), or (T, n) if x0 is a single state. `hk.fit` takes
        them as `X.reshape(-1, n)` and `Y.reshape(-1, n)`.

    Raises:
        ValueError: a shape is wrong; x0 or ts is not finite; ts does not increase; a noise level is
            negative or not finite; there is noise but no key, or more than one key.
        TypeError: `system` does not map one JAX array to another; x0 has less precision than
            float32; the key is not a JAX key.
        RuntimeError: a trajectory diverged or needed too many steps.

    Source: Smith & Egeland (2023), section Experiments, where both levels are one number.
    """
    x0 = require.floating(x0, "x0")
    require.single_or_double(x0.dtype, "x0 has")
    states = require.finite(require.points(x0[None] if x0.ndim == 1 else x0, "x0"), "x0")
    ts = require.elapsed_times(require.times(ts, least=1), states.dtype)
    system = cast_arrays(system, states.dtype)
    one = jax.ShapeDtypeStruct(states.shape[1:], states.dtype)  # indexing would compile
    require.velocity(system, one, "system")
    state_level = _noise_level(state_noise, "state_noise", states, key)
    velocity_level = _noise_level(velocity_noise, "velocity_noise", states, key)
    key = None if key is None else require.key(key)
    X, Y = _trajectories(system, states, ts)
    failed = (require.not_finite(X) | require.not_finite(Y)).any(axis=(1, 2))  # (B,)
    X = require.value(X, failed, lambda: _failure(failed), RuntimeError)
    if key is not None:
        X, Y = _noisy((X, Y), (state_level, velocity_level), key)
    return (X[0], Y[0]) if x0.ndim == 1 else (X, Y)


@compiled_by_size
def _noisy(
    clean: Sequence[Float[Array, "B T n"]], levels: Sequence[Array], key: Key[Array, ""]
) -> tuple[Float[Array, "B T n"], ...]:
    keys = jax.random.split(key, len(clean))
    return tuple(
        A + jnp.broadcast_to(level, A.shape) * jax.random.normal(k, A.shape, A.dtype)
        for A, level, k in zip(clean, levels, keys, strict=True)
    )


def _noise_level(level: ArrayLike, name: str, states: Float[Array, "B n"], key: Any) -> Array:
    """A standard deviation in the dtype of the states, shape () or (n,)."""
    if key is None and not (require.is_concrete(level) and np.all(np.asarray(level) == 0)):
        raise ValueError(f"{name} needs randomness: pass `key=jax.random.key(...)`.")
    array = require_shape(require.floating(level, name), name, (), states.shape[1:])
    level_on_host = require.host_array(array)
    array = require.value(
        array,
        ~((level_on_host >= 0) & (level_on_host < np.inf)),
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


@compiled_without_emitters
def _trajectories(
    field: Callable[[Array], Array], states: Float[Array, "B n"], ts: Float[Array, " T"]
) -> tuple[Float[Array, "B T n"], Float[Array, "B T n"]]:
    """The true states and velocities at the times ts; not finite if the integration failed."""

    def velocity(x):
        return field(x).astype(x.dtype)

    from hamkernel._simulate import simulate  # which loads diffrax

    def trajectory(x0):
        if ts.size == 1:
            return x0[None]
        tolerance = max(1e-10, 10 * float(jnp.finfo(x0.dtype).eps))
        # One step for each of ts, and 65536 more: a swing of a pendulum needs a few dozen.
        bounds = {"rtol": tolerance, "atol": tolerance, "max_steps": 2**16 + ts.size}
        return cast(Array, simulate(velocity, x0, ts, **bounds, throw=False).ys)

    X = jax.vmap(trajectory)(states)
    return X, jax.vmap(jax.vmap(velocity))(X)
