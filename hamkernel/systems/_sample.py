"""Noisy data from the trajectories of a system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key, Num, UInt32

from hamkernel import _require as require
from hamkernel.systems._base import in_precision, shaped


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

    The velocities belong to the true states x(t), not to the noisy ones. Trajectories are
    integrated by an adaptive Runge-Kutta method of order 8, in steps whose estimated error is
    below 1e-10 in float64 and about 1e-6 in float32, relative and absolute: choose units in which
    states are not tiny. Differentiable in reverse mode with respect to `system`, `x0` and the noise
    levels.

    Args:
        system: any traceable field, (n,) -> (n,); one of this module, a learned one, a function.
        x0: states at time ts[0], shape (B, n), or (n,) for a single trajectory. Its dtype is that
            of the integration and the results; the arrays of `system` are cast to it.
        ts: times, shape (T,), strictly increasing.
        state_noise: standard deviation of the noise on X, shape () or (n,), in units of the state.
        velocity_noise: standard deviation of the noise on Y, shape () or (n,), per unit of time.
        key: the source of the noise, needed unless both levels are zero. Many seeds:
            `jax.vmap(lambda key: sample(..., key=key))(keys)` integrates once.

    Returns:
        X and Y, each of shape (B, T, n), or (T, n) if x0 is a single state. `hk.fit` takes
        them as `X.reshape(-1, n)` and `Y.reshape(-1, n)`.

    Raises:
        ValueError: a shape is wrong; x0 or ts is not finite; ts does not increase; a noise level
            is negative or not finite; there is noise but no key, or more than one.
        TypeError: `system` does not map one JAX array to another; x0 has less precision than
            float32; the key is not a JAX key.
        RuntimeError: a trajectory diverged or needed too many steps.

    Source: Smith & Egeland (2023), section Experiments, where both levels are one number.
    """
    x0 = require.floating(x0, "x0")
    require.single_or_double(x0.dtype, "x0 has")
    states = require.finite(require.points(x0[None] if x0.ndim == 1 else x0, "x0"), "x0")
    ts = require.elapsed(require.times(ts, least=1), states.dtype)
    system = in_precision(system, states.dtype)
    require.velocity(system, states[0], "system")
    levels = [
        _noise_level(level, name, states, key)
        for level, name in [(state_noise, "state_noise"), (velocity_noise, "velocity_noise")]
    ]
    key = None if key is None else require.key(key)
    X, Y = _trajectories(system, states, ts)
    failed = (require.not_finite(X) | require.not_finite(Y)).any(axis=(1, 2))  # (B,)
    X = require.value(X, failed, lambda: _failure(failed), RuntimeError)
    if key is not None:
        noises = (jax.random.normal(k, X.shape, X.dtype) for k in jax.random.split(key))
        X, Y = (
            clean + jnp.broadcast_to(level, X.shape) * noise
            for clean, level, noise in zip((X, Y), levels, noises, strict=True)
        )
    return (X[0], Y[0]) if x0.ndim == 1 else (X, Y)


def _noise_level(level: ArrayLike, name: str, states: Float[Array, "B n"], key: Any) -> Array:
    """A standard deviation in the dtype of the states, shape () or (n,)."""
    if key is None and not (require.is_concrete(level) and np.all(np.asarray(level) == 0)):
        raise ValueError(f"{name} needs randomness: pass `key=jax.random.key(...)`.")
    array = shaped(require.floating(level, name), name, (), states.shape[1:])
    seen = require.on_host(array)
    array = require.value(
        array,
        ~((seen >= 0) & (seen < np.inf)),
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
) -> tuple[Float[Array, "B T n"], Float[Array, "B T n"]]:
    """True states and velocities at times ts from the first on; not finite where that failed."""

    def velocity(x):
        return field(x).astype(x.dtype)

    from hamkernel._dynamics.simulate import simulate  # which loads diffrax

    def trajectory(x0):
        if ts.size == 1:
            return x0[None]
        tolerance = max(1e-10, 10 * float(jnp.finfo(x0.dtype).eps))
        bounds = {"rtol": tolerance, "atol": tolerance, "max_steps": _MAX_STEPS + ts.size}
        return cast(Array, simulate(velocity, x0, ts, **bounds, throw=False).ys)

    X = jax.vmap(trajectory)(states)
    return X, jax.vmap(jax.vmap(velocity))(X)
