"""What all pictures share: colours, axes, labels, and functions on a grid."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes

# Okabe & Ito's palette, which stays apart under every form of colour blindness.
COLORS: Mapping[str, str] = {
    "true": "#000000",
    "separable": "#D55E00",
    "symplectic": "#009E73",
    "odd_symplectic": "#0072B2",
}
_OTHERS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_DASHES: Mapping[str, Any] = {"separable": (0, (5, 1.5)), "symplectic": (0, (1, 1))}

STREAM = "#AEB6BF"  # stream lines and other background
DATA = "#E69F00"

Limits = tuple[float, float]
Units = tuple[str | None, str | None]


def axes(ax: Axes | None, **options: Any) -> Axes:
    """`ax`, or those of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

    return plt.subplots(layout="constrained", **options)[1]


def named(series: Any) -> dict[str | None, np.ndarray]:
    """Curves by name; a bare array has none."""
    pairs = series.items() if isinstance(series, Mapping) else [(None, series)]
    return {name: np.asarray(values) for name, values in pairs}


def line_styles(series: Mapping[str | None, Any]) -> Iterator[dict[str, Any]]:
    """Colour, dashes, width, order and legend entry of each curve."""
    keys = [(name or "").lower().replace(" ", "_") for name in series]
    taken = {COLORS[key] for key in keys if key in COLORS}
    others = itertools.cycle([color for color in _OTHERS if color not in taken])
    for name, key in zip(series, keys, strict=True):
        color = COLORS[key] if key in COLORS else next(others)
        yield {
            "color": color,
            "linestyle": _DASHES.get(key, "-"),
            "label": name and name.replace("_", " "),
            # Wide, and below a learned curve that covers it.
            "linewidth": 3.2 if key == "true" and len(series) > 1 else 1.6,
            "zorder": 2.5 if key == "true" else 3,
        }


def coordinate(i: int, n: int) -> str:
    """The symbol of coordinate i of a state (q, p) of n coordinates."""
    m, i = n // 2, range(n)[i]  # counted from the end where negative
    symbol = "q" if i < m else "p"
    return f"${symbol}$" if n == 2 else f"${symbol}_{{{i % m + 1}}}$"


def with_unit(name: str, unit: str | None) -> str:
    """An axis label."""
    return f"{name} [{unit}]" if unit else name


def label_plane(ax: Axes, dims: tuple[int, int], n: int, units: Units | None) -> None:
    """Axis labels of a plane of two coordinates."""
    units = units or (None, None)
    ax.set_xlabel(with_unit(coordinate(dims[0], n), units[0]))
    ax.set_ylabel(with_unit(coordinate(dims[1], n), units[1]))


def legend(ax: Axes, **options: Any) -> None:
    """A legend, if there is anything to name."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(**{"fontsize": "small", "framealpha": 0.9, **options})


def grid(
    xlim: Limits, ylim: Limits, resolution: int
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "P 2"]]:
    """Ticks on both axes and all points of their grid, y by y, P = resolution²."""
    x, y = np.linspace(*xlim, resolution), np.linspace(*ylim, resolution)
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@eqx.filter_jit
def _mapped(fn: Callable[[Array], Array], points: Float[Array, "P n"]) -> Array:
    return jax.vmap(fn)(points)


def on_points(fn: Callable[[Array], Array], points: np.ndarray) -> np.ndarray:
    """The values of fn at each row of `points`, in JAX's default float."""
    return np.asarray(_mapped(fn, jnp.asarray(points, float)))
