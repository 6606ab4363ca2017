"""How kernels, fields and results print: with the values of their hyperparameters."""

import dataclasses
import textwrap
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_WIDTH = 88  # of a line, beyond which each attribute has its own
_FEW = 16  # numbers of a vector that are printed


def described(module: Any) -> str:
    """`Gaussian(lengthscale=3.28)`: the attributes as they are read, few numbers as values.

    What does not apply, and so is left at None, is left out.
    """
    fields = [f for f in dataclasses.fields(module) if getattr(module, f.name) is not None]
    shown = [_attribute(module, field.name) for field in fields]
    line = f"{type(module).__name__}({', '.join(shown)})"
    if len(line) <= _WIDTH and "\n" not in line:
        return line
    lines = textwrap.indent(",\n".join(shown), "  ")
    return f"{type(module).__name__}(\n{lines}\n)"


def _attribute(module: Any, name: str) -> str:
    value = getattr(module, name)
    if name.startswith("log_") and _is_short(value):
        name, value = name.removeprefix("log_"), np.asarray(np.exp(np.asarray(value)))
    return f"{name}={_text(value)}"


def _is_short(value: Any) -> bool:
    if isinstance(value, jax.Array):
        if isinstance(value, Tracer) or jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return False
        if not value.is_fully_addressable:
            return False
    elif not isinstance(value, np.ndarray):
        return False
    return value.ndim <= 1 and value.size <= _FEW


def _text(value: Any) -> str:
    if _is_short(value):
        digits: Any = {"float_kind": _number}
        return np.array2string(np.asarray(value), formatter=digits, separator=", ")
    if eqx.is_array(value):
        return eqx.tree_pformat(value)
    if isinstance(value, float):
        return _number(value)
    if type(value) is tuple:
        items = [_text(item) for item in value]
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {_text(item)}" for key, item in value.items()) + "}"
    name = getattr(getattr(value, "func", value), "__name__", None)
    return repr(value) if name is None else name


def _number(value: float) -> str:
    return f"{value:.4g}"
