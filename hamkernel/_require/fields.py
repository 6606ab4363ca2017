"""Vector fields and the times at which they are followed."""

import inspect
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from hamkernel._require.numbers import finite, floating
from hamkernel._require.values import on_host, traceable, value


def times(ts: ArrayLike, least: int) -> Float[Array, " T"]:
    """Finite times, at least `least` of them, as a float array of shape (T,)."""
    array = floating(ts, "ts")
    if array.ndim != 1 or array.size < least:
        raise ValueError(
            f"ts has shape {array.shape}; times of shape (T,), T ≥ {least}, are needed, the first "
            "that of x0."
        )
    return finite(array, "ts")


def elapsed(ts: Float[Array, " T"], dtype: Any) -> Float[Array, " T"]:
    """The times since the first one, which must increase, in the dtype of the states.

    A field does not depend on time. Late times that come in float64 keep their distances so,
    however large they are in float32.
    """
    ts = on_host(ts)
    since = jnp.asarray((ts - ts[0]).astype(dtype))
    seen = on_host(since)
    return value(
        since,
        seen[1:] <= seen[:-1],
        f"ts, the argument after x0, must be strictly increasing in {dtype}, the dtype of x0: sort "
        "the times and drop repeated ones. To go back in time, "
        "hk.simulate(lambda x: -field(x), ...).",
    )


def velocity(field: Any, x: Float[Array, " n"], name: str = "field") -> jax.ShapeDtypeStruct:
    """Shape and dtype of `field(x)`, which must be one velocity; what it raises itself passes."""
    if not callable(field):
        hint = " Pass its .field." if hasattr(field, "field") else ""
        raise TypeError(
            f"{name} is a {type(field).__name__}; a callable x (n,) -> (n,) is needed.{hint}"
        )
    other = other_arguments(field, x)
    if other is not None:
        raise TypeError(
            f"{name} takes ({other}); it is called with one argument, the state x of shape (n,). "
            "Bind the others, as in `lambda x: f(0.0, x)` where time does not enter. A kernel "
            "becomes a field by hk.fit."
        )
    with traceable(name):
        out = eqx.filter_eval_shape(field, x)
    if not hasattr(out, "shape"):
        raise TypeError(
            f"{name} returns {type(out).__name__}; one velocity is needed, a JAX array of shape "
            f"{x.shape}, such as jnp.array([...])."
        )
    if out.shape != x.shape:
        raise ValueError(
            f"{name} maps a state of shape {x.shape} to shape {out.shape}; one velocity for each "
            "coordinate is needed. Is x0 of the dimension it was made for?"
        )
    return out


def other_arguments(function: Any, *arguments: Any) -> str | None:
    """What `function` takes, by name, if it does not take these arguments."""
    with suppress(ValueError):  # raised for a builtin without a signature
        signature = inspect.signature(function)
        try:
            signature.bind(*arguments)
        except TypeError:
            return ", ".join(signature.parameters)
    return None
