"""Real numbers, positive ones, counts and random keys."""

import operator
import reprlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel._require.values import is_concrete, not_finite, on_host, value


def count(number: Any, name: str) -> int:
    """`number` as a Python integer, at least 1."""
    message = f"{name} must be a whole number, at least 1; got {number!r}."
    if isinstance(number, bool) or not hasattr(number, "__index__"):
        raise TypeError(message)
    if operator.index(number) < 1:
        raise ValueError(message)
    return operator.index(number)


def positive_number(number: Any, name: str) -> float:
    """`number` as a Python float, positive and finite: one that is compiled in."""
    try:
        converted = float(number)
    except (TypeError, ValueError):
        converted = None
    if converted is None or isinstance(number, bool | str):
        raise TypeError(f"{name} must be a number; got {number!r}.")
    if not 0 < converted < np.inf:
        raise ValueError(f"{name} must be positive and finite, got {number}.")
    return converted


def floating(x: Any, name: str) -> Array:
    """`x` as a JAX array of real floats: integers and booleans become the default float."""
    if isinstance(x, bool | int | float):
        x = np.asarray(x, float)
    try:
        array = x if isinstance(x, jax.Array) else jnp.asarray(x)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must hold real numbers; got {reprlib.repr(x)}. Pass floats, a NumPy or JAX "
            "array of them (of objects: .astype(float)), or lists with rows of equal length."
        ) from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        # No weak type: a Python float must not recompile.
        return array.astype(array.dtype) if array.weak_type else array
    if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
        return array.astype(float)
    raise TypeError(
        f"{name} has dtype {array.dtype}; real numbers are needed. "
        f"Pass floats or integers (for complex data, stack real and imaginary parts)."
    )


def single_or_double(dtype: Any, whose: str) -> None:
    """Refuse a dtype with fewer digits than float32."""
    if jnp.finfo(dtype).bits < 32:
        raise TypeError(f"{whose} dtype {dtype}: float32 or float64 is needed.")


def positive(x: Any, name: str, cure: str = "") -> Array:
    """`x` as a float array whose every entry is finite and larger than zero."""
    array = floating(x, name)
    seen = on_host(array)
    return value(
        array,
        ~((seen > 0) & (seen < np.inf)),
        lambda: (
            f"{name} must be positive and finite"
            + (f", got {array}." if is_concrete(array) else ".")
            + (f" {cure}" if cure else "")
        ),
    )


def positive_scalar(x: ArrayLike, name: str, cure: str = "") -> Float[Array, ""]:
    """`x` as a positive float array of shape ()."""
    array = floating(x, name)
    if array.shape:
        raise ValueError(f"{name} has shape {array.shape}; one number is needed.")
    return positive(array, name, cure)


def ridge(x: ArrayLike, dtype: jnp.dtype) -> Float[Array, ""]:
    """The λ of a fit, positive in the dtype of the data too: 1e-50 is zero in float32."""
    cure = "Data without noise still need a small one, such as 1e-8; hk.tune finds a good one."
    return positive_scalar(floating(x, "regularization").astype(dtype), "regularization", cure)


def finite(x: Array, name: str) -> Array:
    """`x`, in which every entry must be finite."""

    def message() -> str:
        if not is_concrete(x):
            return f"{name} contains NaN or inf: remove or repair those points first."
        rows = np.flatnonzero(~np.isfinite(x).reshape(len(x), -1).all(axis=1))
        return f"{name} contains NaN or inf in {listed(rows)}: remove or repair those points."

    return value(x, not_finite(x), message)


def listed(rows: np.ndarray) -> str:
    """`row 1, 2, 3, 4, 5 and 7 more`."""
    shown = ", ".join(str(row) for row in rows[:5])
    return f"row {shown}" + (f" and {rows.size - 5} more" if rows.size > 5 else "")


def key(key: Any) -> Key[Array, ""]:
    """One random key, of the newer kind also where one of the older, `jax.random.PRNGKey`, came."""
    if getattr(key, "dtype", None) == jnp.uint32 and jnp.ndim(key):
        key = jax.random.wrap_key_data(key)
    dtype = getattr(key, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        raise TypeError(f"key must be a key of JAX, such as jax.random.key(0); got {key!r}.")
    if key.shape:
        raise ValueError(
            f"key is an array of keys of shape {key.shape}; one is needed. For many seeds map over "
            "them, jax.vmap(lambda key: ...)(keys)."
        )
    return key
