"""The field as Diffrax calls it, f(t, x, args), with its inputs if it has some."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._dynamics.inputs import AtStart, Between, Driven, inputs_of, refuse_missing


class _Autonomous(eqx.Module):
    """The field as Diffrax calls it, f(t, x, args), and whether it is separable."""

    field: Callable[[Array], Array]

    @property
    def is_separable(self) -> bool:
        return bool(getattr(self.field, "is_separable", False))

    def __call__(self, t: Any, x: Float[Array, " n"], args: Any) -> Float[Array, " n"]:
        del t, args
        return self.field(x)


class RightHandSide(NamedTuple):
    """What is followed."""

    called: Callable[..., Any]  # (t, x, args) -> velocity
    args: Float[Array, ""] | None
    at_start: Callable[[Array], Array]  # x -> velocity, at the first time


def right_hand_side(
    field: Any,
    inputs: Any,
    ts: Float[Array, " T"],
    first: Float[Array, ""],
    between: Between,
    constant_steps: bool,
) -> RightHandSide:
    """The field with its inputs; `ts` are counted from `first`, the time of the caller."""
    field = _uncompiled(field)
    if inputs is None:
        refuse_missing(field)
        return RightHandSide(_Autonomous(field), None, field)
    only = require.other_arguments(field, ts, ts)
    if only is not None:
        raise TypeError(
            f"field takes ({only}); with inputs it is called with two arguments, the state x and "
            "its inputs u: a field of a Controlled kernel, hk.systems.Driven(system, G), or a "
            "function of yours. To follow it without inputs, leave them out."
        )
    # Functions get the caller's time, samples have times of their own: those since the start.
    start = first.astype(ts.dtype) if callable(inputs) else jnp.zeros((), ts.dtype)
    held = constant_steps and between == "held" and not callable(inputs)
    driven = Driven(field, inputs_of(inputs, ts, between), held)
    return RightHandSide(driven, start, AtStart(driven, start))


def check_field(field: Callable[[Array], Array], x0: Float[Array, " n"]) -> None:
    dtype = require.velocity(field, x0).dtype
    if dtype != x0.dtype:
        cure = f"Pass x0 as {dtype}, or cast the output of the field."
        if not jnp.issubdtype(dtype, jnp.floating):
            cure = "Let it return floats."
        raise TypeError(f"field maps {x0.dtype} to {dtype}; the solution has one dtype. {cure}")


_FilterJit: Any = type(eqx.filter_jit(abs))  # Equinox does not name it


def _uncompiled(field: Any) -> Any:
    """The function inside of `jax.jit`: it knows what it is, and the loop is compiled anyway."""
    # Not behind every `__wrapped__`: what functools.wraps names is another field.
    while isinstance(field, (jax.stages.Wrapped, _FilterJit)):
        field = field.__wrapped__
    return field
