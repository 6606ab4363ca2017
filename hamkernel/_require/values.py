"""Values, which are checked by NumPy where they are known and by Equinox under `jax.jit`."""

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool


def is_concrete(*values: object) -> bool:
    """Whether no leaf of `values` is a tracer, so that Python may branch on them."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def on_host(x: Array) -> Any:
    """`x` as a NumPy array, where it is concrete and on one device; else `x` itself."""
    if is_concrete(x) and len(x.sharding.device_set) == 1:
        return np.asarray(x)
    return x


def not_finite(x: Array) -> Any:
    """Where `x` is NaN or infinite, for `value`."""
    return ~(abs(on_host(x)) < np.inf)


def value(
    x: Any,
    bad: Bool[ArrayLike, "..."],
    message: str | Callable[[], str],
    error: type[Exception] = ValueError,
    throw: bool = True,
) -> Any:
    """Return `x`, or fail where `bad` holds: `error` on concrete values, at run time under jit.

    If not `throw`, `x` is NaN there.

    `x` is an array or a PyTree of them: everything that would be wrong, for under jit a check is
    dropped together with the value it hangs on.
    Computed with `on_host`, `bad` is known wherever it can be, also for constants under jit.
    """
    bad = bad.any()  # type: ignore[union-attr]
    if not throw:
        return jax.tree.map(lambda a: jnp.where(bad, jnp.full_like(a, jnp.nan), a), x)
    if not is_concrete(bad):
        return eqx.error_if(x, bad, message if isinstance(message, str) else message())
    if bad:
        raise error(message if isinstance(message, str) else message())
    return x


def warn(message: str) -> None:
    """Warn, with the line of the user.

    Equinox puts frames of its own between methods, so that the level is no constant. From Python
    3.12 on `skip_file_prefixes` of `warnings.warn` does this.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back:
        package = frame.f_globals.get("__name__", "").split(".")[0]
        if package not in ("hamkernel", "equinox"):
            break
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


@contextmanager
def traceable(name: str) -> Iterator[None]:
    """A TypeError that says what to do, in place of JAX's own where `name` is traced inside."""
    try:
        yield
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        raise TypeError(
            f"{name} asks for numbers while JAX traces it, when only shapes are known: write it "
            "with jax.numpy in place of numpy and math, and with jnp.where in place of if."
        ) from error
