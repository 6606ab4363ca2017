"""Inputs of a simulation: a function of time, or samples held or interpolated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.controlled import ControlledField
from hamkernel._kernels.functions import as_pytree

Between = Literal["held", "linear"]


class Samples(eqx.Module):
    """u(t) from its values at times ts: the last one before t, or on the line between two."""

    ts: Float[Array, " T"]
    values: Float[Array, "T m"]
    held: bool = eqx.field(static=True)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " m"]:
        last = len(self.ts) - 2
        index = jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, last)
        before = self.values[index]
        if self.held:
            return before
        share = (t - self.ts[index]) / (self.ts[index + 1] - self.ts[index])
        return before + share * (self.values[index + 1] - before)


class Driven(eqx.Module):
    """The field x -> f(x, u(t)) as Diffrax calls it, f(t, x, args).

    `args` is the caller's time at t = 0: the start, or the last of the saved times.
    """

    field: Any  # x, u -> velocity
    inputs: Callable[[Array], Any]
    # Whether inputs are held from t = 0 on: the last stage of a step would else see the next ones.
    held_from_args: bool = eqx.field(static=True)

    def __call__(self, t: Any, x: Float[Array, " n"], args: Any) -> Float[Array, " n"]:
        u = self.inputs(args if self.held_from_args else args + t)
        return self.field(x, require.floating(u, "the value of inputs").astype(x.dtype))


class AtStart(eqx.Module):
    """A driven field at the first time, to be looked at before the solve."""

    driven: Driven
    start: Float[Array, ""]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.driven(jnp.zeros_like(self.start), x, self.start)


def learned_at(field: Any, x: Float[Array, " n"]) -> tuple[Any, Float[Array, " d"]]:
    """The learned field and its first point, (x, u) where there are inputs."""
    if isinstance(field, AtStart) and isinstance(field.driven.field, ControlledField):
        learned, u = field.driven.field, field.driven.inputs(field.start)
        return learned.whole, learned.joined(x, u)
    return field, x


def inputs_of(given: Any, ts: Float[Array, " T"], between: Between) -> Callable[[Array], Any]:
    """The inputs u as a function of the time; samples are at the times ts.

    Raises:
        ValueError: samples are not of shape (T, m), or not finite; `between` is unknown.
        TypeError: they are no numbers.
    """
    if between not in ("held", "linear"):
        raise ValueError(f"between must be 'held' or 'linear'; got {between!r}.")
    if callable(given):
        others = require.other_arguments(given, ts[0])
        if others is not None:
            raise TypeError(
                f"inputs takes ({others}); it is called with one argument, the time. Feedback "
                "closes the loop instead: hk.simulate(lambda x: field(x, law(x)), x0, ts)."
            )
        shape = jax.eval_shape(given, jax.ShapeDtypeStruct((), ts.dtype))
        if len(getattr(shape, "shape", (0, 0))) != 1:
            raise ValueError(
                f"inputs(t) returns shape {getattr(shape, 'shape', type(shape).__name__)}; one "
                "vector u of shape (m,) is needed, such as jnp.array([jnp.sin(t)])."
            )
        return as_pytree(given)
    values = require.floating(given, "inputs")
    if values.ndim != 2 or len(values) != len(ts):
        one = values.ndim == 1 and len(values) == len(ts)
        hint = " For one input write U[:, None]." if one else ""
        if values.ndim < 2 and not one:
            hint = " A constant input is lambda t: jnp.array([…])."
        raise ValueError(
            f"inputs has shape {values.shape}; a function t -> (m,) is needed, or samples (T, m) at"
            f" the T = {len(ts)} times ts.{hint}"
        )
    values = require.finite(values, "inputs").astype(ts.dtype)
    return Samples(ts, values, between == "held")


def refuse_symplectic(solver: Any) -> None:
    """ValueError: no symplectic map belongs to a field with inputs."""
    raise ValueError(
        f"{type(solver).__name__} is symplectic, and a field with inputs is not the flow of one H: "
        "what it keeps bounded is not conserved while inputs do work, and its map would be "
        "symplectic only for forces that have a potential. Use the default solver, or "
        "diffrax.Dopri5() with dt=..."
    )


def refuse_missing(field: Any) -> None:
    """ValueError if the field has inputs."""
    if getattr(field, "takes_inputs", False):
        raise ValueError(
            f"this {type(field).__name__} has inputs: hk.simulate(field, x0, ts, inputs=u), u a "
            "function t -> (m,) or samples (T, m) at ts. Without inputs simulate its drift, "
            "field.drift."
        )
