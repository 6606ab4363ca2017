"""Colours, axes, labels, and functions on a grid, for all pictures."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes

from hamkernel import _require as require

# Okabe & Ito's palette, which stays distinct under every form of colour blindness.
COLORS: Mapping[str, str] = {
    "true": "#000000",
    "separable": "#D55E00",
    "symplectic": "#009E73",
    "odd_symplectic": "#0072B2",
}
BLUE = "#0072B2"
STREAM = "#AEB6BF"  # stream lines and other background
DATA = "#E69F00"

BENEATH: Mapping[str, Any] = {"linewidth": 3.2, "zorder": 2.5}  # wide, under what may cover it

Arguments = ParamSpec("Arguments")
R = TypeVar("R")

Limits = tuple[float, float]
Texts = tuple[str | None, str | None]  # the units, or the names, of two coordinates


def as_pair(name: str, values: Any) -> tuple[Any, Any]:
    """The entries of an argument that must be a pair; a string of two letters is not one."""
    entries = () if isinstance(values, str) or not np.iterable(values) else tuple(values)
    if len(entries) != 2:
        raise ValueError(f"{name} must be a pair (first, second), got {values!r}.")
    return entries


def axes(ax: Axes | None, **options: Any) -> Axes:
    """`ax`, or those of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

    return plt.subplots(layout="constrained", **options)[1]


def refuse_tracers(plot: Callable[Arguments, R]) -> Callable[Arguments, R]:
    """The function `plot`, with a TypeError where JAX traces an argument."""

    @functools.wraps(plot)
    def wrapper(*args: Arguments.args, **options: Arguments.kwargs) -> R:
        name = f"hk.plot.{plot.__name__}"
        require.no_tracers(name, "Return the arrays and draw them outside.", args, options)
        return plot(*args, **options)

    return wrapper


def curves_by_name(series: Any) -> dict[str | None, np.ndarray]:
    """Curves by name; a bare array has none."""
    pairs = series.items() if isinstance(series, Mapping) else [(None, series)]
    return {name: np.asarray(values) for name, values in pairs}


def line_styles(series: Mapping[str | None, Any]) -> Iterator[dict[str, Any]]:
    """Colour, dashes, width, order and legend entry of each curve."""
    keys = [(name or "").lower().replace(" ", "_") for name in series]
    taken = {COLORS[key] for key in keys if key in COLORS}
    palette = (BLUE, "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
    free_colors = itertools.cycle([color for color in palette if color not in taken])
    dashes: dict[str, Any] = {"separable": (0, (5, 1.5)), "symplectic": (0, (1, 1))}
    for name, key in zip(series, keys, strict=True):
        color = COLORS[key] if key in COLORS else next(free_colors)
        yield {
            "color": color,
            "linestyle": dashes.get(key, "-"),
            "label": name and name.replace("_", " "),
            "linewidth": 1.6,
            "zorder": 3,
            **(BENEATH if key == "true" and len(series) > 1 else {}),
        }


def coordinate(i: int, n: int) -> str:
    """The symbol of coordinate i of a state (q, p) of n coordinates."""
    m, i = n // 2, range(n)[i]  # counted from the end where negative
    symbol = "q" if i < m else "p"
    return f"${symbol}$" if n == 2 else f"${symbol}_{{{i % m + 1}}}$"


def with_unit(name: str, unit: str | None) -> str:
    """An axis label."""
    return f"{name} [{unit}]" if unit else name


def plane_labels(
    dims: tuple[int, int], n: int, units: Texts | None, names: Texts | None
) -> dict[str, str]:
    """Axis labels of a plane of two of n coordinates, for `ax.set`."""
    if len({range(n)[i] for i in as_pair("dims", dims) if -n <= i < n}) != 2:
        raise ValueError(f"dims must be two different coordinates of {n}, got {dims}.")
    units = (None, None) if units is None else as_pair("units", units)
    names = (None, None) if names is None else as_pair("names", names)
    symbols = [name or coordinate(i, n) for name, i in zip(names, dims, strict=True)]
    return {
        "xlabel": with_unit(symbols[0], units[0]),
        "ylabel": with_unit(symbols[1], units[1]),
    }


def plane_data(data: Any) -> np.ndarray | None:
    """Measured states in the plane, if there are any."""
    X = None if data is None else np.asarray(data)
    if X is not None and (X.ndim != 2 or X.shape[1] != 2):
        raise ValueError(f"data has shape {X.shape}; measured states (N, 2) are needed.")
    return X


def dots(ax: Axes, X: np.ndarray | None, **options: Any) -> None:
    """Draw the measured states on top of the picture; nothing if there are none."""
    if X is not None:
        ax.plot(
            *X.T, "o", color=DATA, mec="black", mew=0.6, ms=5, zorder=5, label="data", **options
        )


def legend(ax: Axes, **options: Any) -> None:
    """A legend, if there is anything to name."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(**{"fontsize": "small", "framealpha": 0.9, **options})


def grid(
    xlim: Limits, ylim: Limits, resolution: int
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "P 2"]]:
    """Ticks on both axes and all points of their grid, y by y, P = resolution²."""
    for name, limits in (("xlim", xlim), ("ylim", ylim)):
        low, high = as_pair(name, limits)
        if not -np.inf < low < high < np.inf:
            raise ValueError(f"{name} must be finite limits (low, high), low < high; got {limits}.")
    x, y = np.linspace(*xlim, resolution), np.linspace(*ylim, resolution)
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@eqx.filter_jit
def _map_points(fn: Callable[[Array], Array], points: Float[Array, "P n"]) -> Array:
    return jax.vmap(fn)(points)


def evaluate_at(fn: Callable[[Array], Array], points: np.ndarray) -> np.ndarray:
    """The values of fn at each row of `points`, in JAX's default float."""
    return np.asarray(_map_points(fn, jnp.asarray(points, float)))


def evaluate_in_plane(
    fn: Callable[[Array], Array],
    points: Float[np.ndarray, "P 2"],
    shape: tuple[int, ...],
    need: str,
) -> np.ndarray:
    """The values of fn on a plane, (P, *shape); a function of more coordinates is refused."""
    need = f"{need} (2,) -> {shape} is needed"
    if not callable(fn):
        hint = " Pass its .field." if hasattr(fn, "field") else ""
        raise TypeError(f"{need}; got a {type(fn).__name__}.{hint}")
    hint = "plane_slice draws functions of more coordinates."
    try:
        values = evaluate_at(fn, points)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{need}; {hint} This one says: {error}") from error
    if values.shape[1:] != shape:
        raise ValueError(f"{need}, this one returns {values.shape[1:]}; {hint}")
    return values
