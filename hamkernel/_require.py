"""Checks of the arguments of public functions, made before any long computation.

Shapes, dtypes and configuration are known while tracing, and errors in them raise at once. NumPy
checks concrete values, since it compiles nothing. Under `jax.jit` the same check becomes
`equinox.error_if` on the returned value, so the caller must use that value.
"""

import inspect
import operator
import reprlib
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Key
from numpy.lib.recfunctions import structured_to_unstructured


def is_concrete(*values: object) -> bool:
    """Whether no leaf of `values` is a tracer, so that Python may branch on them."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def eager(*values: object) -> AbstractContextManager[None]:
    """A context in which operations on constants are evaluated at once, also while JAX traces.

    Otherwise the sum of two constants is a tracer under `jax.jit`, and its value cannot be checked.
    """
    return jax.ensure_compile_time_eval() if is_concrete(*values) else nullcontext()


def no_tracers(name: str, instead: str, *values: object) -> None:
    """TypeError if JAX traces one of `values`; the function `name` branches on their numbers."""
    if not is_concrete(*values):
        raise TypeError(
            f"{name} cannot run under jax.jit, jax.vmap or jax.grad: it branches in Python on the "
            f"numbers of its arguments. {instead}"
        )


def host_array(x: Array) -> Any:
    """`x` as a NumPy array if it is concrete and on one device; else `x` itself."""
    if is_concrete(x) and len(x.sharding.device_set) == 1:
        return np.asarray(x)
    return x


def not_finite(x: Array) -> Any:
    """A mask of the entries of `x` that are NaN or infinite, as `value` takes it."""
    return ~(abs(host_array(x)) < np.inf)


def value(
    x: Any,
    bad: Bool[ArrayLike, "..."],
    message: str | Callable[[], str],
    error: type[Exception] = ValueError,
    throw: bool = True,
) -> Any:
    """Return `x`, or raise `error` if `bad` holds anywhere: at once, or at run time under jit.

    Without `throw`, a failure makes `x` NaN. Pass as `x` all arrays that would be wrong, as one
    array or a PyTree: under jit the check is dropped if the caller does not use `x`. Compute `bad`
    with `host_array`, so that `bad` is concrete whenever possible, also for constants under jit.
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
    """Issue a UserWarning that names the caller's line outside this library.

    Equinox inserts frames between methods, so the stack level varies. From Python 3.12 on, replace
    this by `skip_file_prefixes` of `warnings.warn`.
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
    """Replace JAX's error about traced values inside `name` by a TypeError with a remedy."""
    try:
        yield
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        raise TypeError(
            f"{name} needs numbers while JAX traces it, and then only shapes are known: write it "
            "with jax.numpy in place of numpy and math, and with jnp.where in place of if."
        ) from error


def count(number: Any, name: str, least: int = 1) -> int:
    """`number` as a Python integer, at least `least`."""
    message = f"{name} must be a whole number, at least {least}; got {number!r}."
    if isinstance(number, bool) or not hasattr(number, "__index__"):
        raise TypeError(message)
    if operator.index(number) < least:
        raise ValueError(message)
    return operator.index(number)


def coordinates(numbers: Any, name: str) -> tuple[int, ...]:
    """Coordinates of the state, as a tuple of distinct integers ≥ 0."""
    try:
        indices = tuple(operator.index(i) for i in np.atleast_1d(numbers))
    except TypeError:
        indices = ()
    if not indices or min(indices) < 0 or len(set(indices)) < len(indices):
        raise ValueError(
            f"{name} must be distinct coordinates, integers >= 0 such as (2, 3); got {numbers!r}."
        )
    return indices


def positive_number(number: Any, name: str) -> float:
    """`number` as a positive, finite Python float, which is a constant of compiled programs."""
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
    elif not isinstance(x, jax.Array):
        x = _plain(x, name)
    with eager(x):
        try:
            array = x if isinstance(x, jax.Array) else jnp.asarray(x)
        except (TypeError, ValueError) as error:
            raise _no_numbers(x, name) from error
        if jnp.issubdtype(array.dtype, jnp.floating):
            # No weak type: a Python float must not recompile.
            return array.astype(array.dtype) if array.weak_type else array
        if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
            return array.astype(float)
    raise _no_numbers(array, name)


def doubles(x: Any, name: str) -> np.ndarray:
    """`x` as a NumPy array of doubles, NaN where it is masked or missing.

    The caller's log keeps all its digits, whatever the precision of JAX.
    """
    plain = _plain(x, name)  # which does not change arrays of JAX; the next line does
    return _plain(np.asarray(plain), name).astype(float)


def _plain(x: Any, name: str) -> Any:
    """`x` as a NumPy array of real numbers; arrays of JAX, and lists of them, unchanged.

    We read iterators, write NaN for masked or missing entries, make a matrix of named columns, and
    detach tensors of PyTorch. JAX converts none of these.
    """
    if isinstance(x, jax.Array):
        return x
    if x is None:
        raise _no_numbers(x, name)
    if isinstance(x, Iterator):
        x = list(x)
    if hasattr(x, "__jax_array__") or _holds_jax(x):
        return x
    original = x
    if hasattr(x, "detach"):
        x = x.detach().cpu()
    if isinstance(x, np.ma.MaskedArray):
        x = np.ma.filled(x.astype(float), np.nan) if x.dtype.kind in "fiubO" else x.data
    elif hasattr(x, "to_numpy"):  # pandas, whose missing values NumPy refuses, and polars
        x = _frame_values(x)
    try:
        array = np.asarray(x)
        if array.dtype.names:
            array = structured_to_unstructured(array)
        if array.dtype == object:
            array = array.astype(float)
    except (TypeError, ValueError) as error:
        raise _no_numbers(original, name) from error
    if not (array.dtype.kind in "fiub" or jnp.issubdtype(array.dtype, jnp.floating)):
        raise _no_numbers(array, name)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _holds_jax(x: Any) -> bool:
    """Whether a list or tuple has an array of JAX in it, at any depth."""
    return isinstance(x, list | tuple) and any(
        isinstance(entry, jax.Array) or _holds_jax(entry) for entry in x
    )


def _frame_values(x: Any) -> Any:
    """The array of a frame or column of pandas or polars, or of an array of xarray."""
    array = x.to_numpy()
    if getattr(array, "dtype", np.dtype(float)).kind == "O":  # with missing values
        with suppress(TypeError, ValueError):
            return x.to_numpy(dtype=float, na_value=np.nan)
    return array


def _holds_numbers(column: Any) -> bool:
    """Whether a column of a frame becomes an array of floats."""
    try:
        np.asarray(column, dtype=float)
    except (TypeError, ValueError):
        return False
    return True


def _no_numbers(x: Any, name: str) -> TypeError:
    """The error for an argument that does not hold real numbers."""
    dtype = getattr(x, "dtype", None)
    kind = getattr(dtype, "kind", "")
    if kind in ("M", "m") or _first(x).__class__.__module__ == "datetime":
        return TypeError(
            f"{name} holds dates or durations; numbers are needed. For seconds since the first: "
            "(t - t[0]) / np.timedelta64(1, 's')."
        )
    cure = {
        "c": " For complex data stack real and imaginary parts.",
        "U": " Text becomes numbers by .astype(float); a header of a file is left out by skiprows.",
    }.get(kind)
    if cure is not None:
        return TypeError(f"{name} has dtype {dtype}; real numbers are needed.{cure}")
    if hasattr(x, "columns") and hasattr(x, "__getitem__"):  # a frame of pandas or polars
        text = ", ".join(str(column) for column in x.columns if not _holds_numbers(x[column]))
        return TypeError(
            f"{name} has columns that hold no numbers: {text}. Choose the columns of the state, "
            "frame[['q', 'p']]."
        )
    return TypeError(
        f"{name} must hold real numbers; got {reprlib.repr(x)}. Pass floats, an array of them, or "
        "lists with rows of equal length."
    )


def _first(x: Any) -> Any:
    """The first entry of lists and arrays of any depth."""
    while isinstance(x, list | tuple) or (isinstance(x, np.ndarray) and x.ndim):
        x = x[0] if len(x) else None
    return x


def single_or_double(dtype: Any, whose: str) -> None:
    """Refuse a dtype with fewer digits than float32."""
    if jnp.finfo(dtype).bits < 32:
        raise TypeError(f"{whose} dtype {dtype}: float32 or float64 is needed.")


def positive(x: Any, name: str, cure: str = "") -> Array:
    """`x` as a float array whose every entry is finite and larger than zero."""
    array = floating(x, name)
    values = host_array(array)
    return value(
        array,
        ~((values > 0) & (values < np.inf)),
        lambda: (
            f"{name} must be positive and finite"
            + (f", got {array}." if is_concrete(array) else ".")
            + (f" {cure}" if cure else "")
        ),
    )


def positive_scalar(x: ArrayLike, name: str, cure: str = "") -> Float[Array, ""]:
    """`x` as a positive float array of shape ()."""
    array = floating(x, name)
    shape(array, f"{name} has", "one number", ())
    return positive(array, name, cure)


def ridge(x: ArrayLike, dtype: jnp.dtype) -> Float[Array, ""]:
    """The λ of a fit, positive also in the dtype of the data: 1e-50 is zero in float32."""
    cure = "Data without noise still need a small λ, such as 1e-8; hk.tune finds a good one."
    return positive_scalar(floating(x, "regularization").astype(dtype), "regularization", cure)


def finite(x: Array, name: str, cure: str = "") -> Array:
    """`x`; ValueError if an entry is not finite."""

    def message() -> str:
        if not is_concrete(x):
            return f"{name} contains NaN or inf: remove or repair those points first.{cure}"
        rows = np.flatnonzero(~np.isfinite(x).reshape(len(x), -1).all(axis=1))
        shown = ", ".join(str(row) for row in rows[:5])
        more = f" and {rows.size - 5} more" if rows.size > 5 else ""
        where = f"in row {shown}{more}"
        return f"{name} contains NaN or inf {where}: remove or repair those points.{cure}"

    return value(x, not_finite(x), message)


def key(key: Any) -> Key[Array, ""]:
    """One typed random key. A legacy key from `jax.random.PRNGKey` is converted."""
    if getattr(key, "dtype", None) == jnp.uint32 and jnp.ndim(key):
        key = jax.random.wrap_key_data(key)
    dtype = getattr(key, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        raise TypeError(f"key must be a key of JAX, such as jax.random.key(0); got {key!r}.")
    if key.shape:
        raise ValueError(
            f"key is an array of keys of shape {key.shape}; one key is needed. For many seeds use "
            "jax.vmap(lambda key: ...)(keys)."
        )
    return key


def shape(array: Any, subject: str, needed: str, *shapes: tuple[int, ...], cure: str = "") -> None:
    """ValueError unless the array has one of the shapes, such as `shape(x, "x has", "one state")`.

    `needed` says in words what the array holds.
    """
    if jnp.shape(array) not in shapes:
        wanted = f"{needed} of shape {' or '.join(map(str, shapes))} is needed."
        raise ValueError(f"{subject} shape {jnp.shape(array)}; {wanted} {cure}".rstrip())


def one_system(subject: str, n: int, reference: str, m: int) -> None:
    """ValueError unless states with n and with m coordinates may be those of one system."""
    if n != m:
        raise ValueError(
            f"{subject} {n} coordinates and {reference} {m}: both must be states of one system."
        )


def one_dtype(X: Array, Z: Array) -> tuple[Array, Array]:
    """Both arrays in the wider of their dtypes, also under strict promotion."""
    dtype = np.promote_types(X.dtype, Z.dtype)
    with eager(X, Z):
        return X.astype(dtype), Z.astype(dtype)


def one_space(X: Array, Z: Array) -> tuple[Array, Array]:
    """Both arrays in one dtype; ValueError if their numbers of coordinates differ."""
    one_system("X has", X.shape[1], "Z has", Z.shape[1])
    return one_dtype(X, Z)


def points(X: ArrayLike, name: str = "X") -> Float[Array, "N n"]:
    """States as a float array of shape (N, n), N ≥ 1, without a check of the values."""
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
    """One state of `n` coordinates; the error for several states points to `jax.vmap`."""
    array = floating(x, name)
    cure = "Use `jax.vmap(...)` for a batch of states." if array.ndim > 1 else ""
    shape(array, f"{name} has", "one state", (n,), cure=cure)
    return array


def data(
    X: ArrayLike,
    Y: ArrayLike,
    part: bool = False,
    cure: str = " Where NaN means that a component was not measured, pass hk.Velocities(X, Y).",
) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
    """States and velocities: two finite float arrays of one shape (N, n) and one dtype.

    Fewer points than coordinates raise a warning, unless the points are a `part` of the data. The
    error about NaN in Y ends with `cure`.
    """
    X, Y = points(X, "X"), points(Y, "Y")
    if X.shape != Y.shape:
        raise ValueError(
            f"X has shape {X.shape} and Y has shape {Y.shape}: they must be equal, "
            "one velocity Y[i] for each state X[i]."
        )
    N, n = X.shape
    if 1 < N < n and not part:
        warn(
            f"X has shape {X.shape}: {N} points of {n} coordinates, fewer points than coordinates. "
            "If it holds one coordinate a row, pass X.T and Y.T: shape (N, n), one state a row."
        )
    X, Y = one_dtype(X, Y)
    single_or_double(X.dtype, "X and Y have")
    return finite(X, "X"), finite(Y, "Y", cure)


def velocity_data(X: ArrayLike, Y: ArrayLike) -> tuple[Array, Array, np.ndarray | None]:
    """States, velocities with NaN where a component was not measured, and the measured indices.

    The indices count the components of all points, and are None if all were measured. If Y is
    traced, NaN is refused, since the measured components are then unknown.
    """
    X, Y = points(X, "X"), points(Y, "Y")
    values = host_array(Y)
    if not is_concrete(Y):
        cure = (
            " If NaN means that a component was not measured, make hk.Velocities(X, Y) outside "
            "of jax.jit: inside, the positions of NaN are unknown."
        )
        return *data(X, Y, part=True, cure=cure), None
    if not (values != values).any():
        return *data(X, Y, part=True), None
    if not Y.is_fully_addressable:
        raise ValueError(
            "Y contains NaN and is sharded over several processes, where components that were not "
            "measured cannot be left out: remove the points with NaN."
        )
    missing = np.isnan(np.asarray(Y))
    if missing.all():
        raise ValueError(
            f"all {missing.size} components of Y are NaN, which means not measured: there is "
            "nothing to learn from. Look at how Y was read or computed."
        )
    X, filled = data(X, jnp.where(missing, jnp.zeros_like(Y), Y), part=True)
    return X, jnp.where(missing, jnp.nan, filled), np.flatnonzero(~missing.reshape(-1))


def warn_of_float32(X: Array) -> None:
    """Warn if X is in float32, and name the accuracy to expect."""
    if X.dtype == jnp.float32:
        warn(
            "fitting in float32: expect three digits, and a failed factorisation for a ridge "
            "below about 1e-6 of the Gram. For float64 run "
            "jax.config.update('jax_enable_x64', True) first and pass float64 data."
        )


def times(ts: ArrayLike, least: int) -> Float[Array, " T"]:
    """Finite times, at least `least` of them, as a float array of shape (T,)."""
    array = floating(ts, "ts")
    if array.ndim != 1 or array.size < least:
        raise ValueError(
            f"ts has shape {array.shape}; times of shape (T,), T ≥ {least}, are needed. The first "
            "is the time of x0."
        )
    return finite(array, "ts")


def elapsed_times(ts: Float[Array, " T"], dtype: Any) -> Float[Array, " T"]:
    """The times since the first one, which must increase, in the dtype of the states.

    A field does not depend on time, so we may subtract the first time. We subtract in the dtype of
    `ts`: late times in float64 then keep their differences if the states are in float32.
    """
    ts = host_array(ts)
    since = jnp.asarray((ts - ts[0]).astype(dtype))
    values = host_array(since)
    return value(
        since,
        values[1:] <= values[:-1],
        f"ts, the argument after x0, must be strictly increasing in {dtype}, the dtype of x0: sort "
        "the times and drop repeated ones. To go back in time, "
        "hk.simulate(lambda x: -field(x), ...).",
    )


def velocity(field: Any, x: Any, name: str = "field") -> jax.ShapeDtypeStruct:
    """The shape and dtype of `field(x)`, one velocity, for a state x or a struct of its shape.

    Errors inside `field` propagate.
    """
    if not callable(field):
        hint = " Pass its .field." if hasattr(field, "field") else ""
        raise TypeError(
            f"{name} is a {type(field).__name__}; a callable x (n,) -> (n,) is needed.{hint}"
        )
    mismatch = signature_mismatch(field, x)
    if mismatch is not None:
        raise TypeError(
            f"{name} takes ({mismatch}); it is called with one argument, the state x of shape "
            "(n,). Bind the others, as in `lambda x: f(0.0, x)` if f does not depend on time. A "
            "kernel becomes a field by hk.fit."
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
            "coordinate is needed. Was it made for states of another dimension?"
        )
    return out


def takes_two(function: Any) -> bool:
    """Whether a function needs two arguments; a second one with a default does not count."""
    return signature_mismatch(function, 0) is not None and not signature_mismatch(function, 0, 0)


def signature_mismatch(function: Any, *arguments: Any) -> str | None:
    """The parameters of `function`, as text, if it cannot take these arguments; else None."""
    with suppress(ValueError):  # raised for a builtin without a signature
        signature = inspect.signature(function)
        try:
            signature.bind(*arguments)
        except TypeError:
            return ", ".join(signature.parameters)
    return None
