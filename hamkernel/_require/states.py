"""States and velocities: their shapes, their dtypes, and whether they are finite."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel._require.numbers import finite, floating, single_or_double
from hamkernel._require.values import is_concrete, on_host, warn


def one_dtype(X: Array, Z: Array) -> tuple[Array, Array]:
    """Both in the wider of their dtypes, under strict promotion too."""
    dtype = np.promote_types(X.dtype, Z.dtype)
    return X.astype(dtype), Z.astype(dtype)


def same_space(X: Array, Z: Array) -> tuple[Array, Array]:
    """Both in one dtype, if they hold states of the same number of coordinates."""
    if X.shape[1] != Z.shape[1]:
        raise ValueError(
            f"X has {X.shape[1]} coordinates and Z has {Z.shape[1]}: both must be states of one "
            "system, shapes (N, n) and (M, n)."
        )
    return one_dtype(X, Z)


def points(X: ArrayLike, name: str = "X") -> Float[Array, "N n"]:
    """States as a float array of shape (N, n) with N ≥ 1; their values are not looked at."""
    array = floating(X, name)
    if 0 in array.shape:
        raise ValueError(
            f"{name} has shape {array.shape}: at least one point is needed, shape (N, n). Look at "
            "how the data was read or selected."
        )
    if array.ndim != 2:
        hint = (
            f" One state per row: `{name}[:, None]` for N states of one coordinate, "
            f"`{name}[None]` for one state."
            if array.ndim == 1
            else f" Join trajectories with `{name}.reshape(-1, {name}.shape[-1])`."
            if array.ndim > 2
            else ""
        )
        raise ValueError(f"{name} has shape {array.shape}; it must be (N, n).{hint}")
    return array


def point(x: ArrayLike, n: int, name: str = "x") -> Float[Array, " n"]:
    """One state of `n` coordinates; for many, the caller is pointed to `jax.vmap`."""
    array = floating(x, name)
    if array.shape != (n,):
        hint = " Use `jax.vmap(...)` for a batch of states." if array.ndim > 1 else ""
        raise ValueError(
            f"{name} has shape {array.shape}; one state of shape ({n},) is needed.{hint}"
        )
    return array


def data(
    X: ArrayLike, Y: ArrayLike, part: bool = False
) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
    """States and velocities: two finite float arrays of one shape (N, n) and one dtype.

    A `part` of the data may have fewer points than coordinates; all of it is warned of then.
    """
    X, Y = points(X, "X"), points(Y, "Y")
    if X.shape != Y.shape:
        raise ValueError(
            f"X has shape {X.shape} and Y has shape {Y.shape}: they must be equal, "
            "one velocity Y[i] for each state X[i]."
        )
    if not part:
        warn_of_few_points(X)
    X, Y = one_dtype(X, Y)
    single_or_double(X.dtype, "X and Y have")
    return finite(X, "X"), finite(Y, "Y")


def warn_of_few_points(X: Float[Array, "N n"]) -> None:
    """Warn of data that is probably transposed."""
    N, n = X.shape
    if 1 < N < n:
        warn(
            f"X has shape {X.shape}: {N} points of {n} coordinates, fewer points than coordinates. "
            "If it holds one coordinate a row, pass X.T and Y.T: shape (N, n), one state a row."
        )


def measured(X: ArrayLike, Y: ArrayLike) -> tuple[Array, Array, np.ndarray | None]:
    """`data` with NaN in Y where nothing was measured, and which entries were; None if all were.

    Not everywhere, and not under jit, where it is not known which.
    """
    X, Y = points(X, "X"), points(Y, "Y")
    seen = on_host(Y)
    if not is_concrete(Y) or not (seen != seen).any():
        return *data(X, Y, part=True), None
    if not Y.is_fully_addressable:
        raise ValueError(
            "Y contains NaN and is spread over several processes, where components that were not "
            "measured cannot be left out: remove those points."
        )
    missing = np.isnan(np.asarray(Y))
    if missing.all():
        raise ValueError(
            f"all {missing.size} components of Y are NaN, which says not measured: there is "
            "nothing to learn from."
        )
    X, filled = data(X, jnp.where(missing, jnp.zeros_like(Y), Y), part=True)
    return X, jnp.where(missing, jnp.nan, filled), np.flatnonzero(~missing.reshape(-1))


def warn_of_float32(X: Array) -> None:
    """Say what a fit in float32 may be expected to do."""
    if X.dtype == jnp.float32:
        warn(
            "fitting in float32: expect three digits, and a failed factorisation for a ridge "
            "below about 1e-6 of the Gram. For float64 run "
            "jax.config.update('jax_enable_x64', True) first and pass float64 data."
        )
