"""Uncertainty: ensembles of orbits, bands, and deviations over a phase plane."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.axes import Axes

from hamkernel.plot._style import (
    COLORS,
    Limits,
    Texts,
    axes,
    dots,
    drawn,
    grid,
    in_plane,
    legend,
    measured,
    plane_labels,
    with_unit,
)

_BLUE = "#0072B2"


@drawn
def ensemble(
    ys: Float[ArrayLike, "S T n"],
    true: Float[ArrayLike, "T n"] | None = None,
    ax: Axes | None = None,
    *,
    dims: tuple[int, int] = (0, 1),
    color: str = _BLUE,
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    label: str | None = "draws",
) -> Axes:
    """Draw many orbits, thin and transparent: the picture is dark where most of them pass.

    Args:
        ys: an orbit of each sampled field, shape (S, T, n):
            `jax.vmap(lambda f: hk.simulate(f, x0, ts).ys)(posterior.sample(key, S, region))`.
        true: the true orbit, shape (T, n), drawn on top.
        ax: axes to draw on; new ones if None.
        dims: the two coordinates, counted from 0.
        color: of the ensemble.
        title: of the axes.
        units: of the two coordinates.
        names: of the two coordinates, if they are not q and p.
        label: of the ensemble, in the legend.

    Raises:
        ValueError: an array is of another shape, `dims` are not two of the coordinates, or an
            argument is not a pair.
    """
    ys = np.asarray(ys)
    if ys.ndim != 3:
        raise ValueError(f"ys has shape {ys.shape}; an orbit of each draw, (S, T, n), is needed.")
    if true is not None and np.shape(true)[-1:] != ys.shape[2:]:
        raise ValueError(f"true has shape {np.shape(true)}; (T, {ys.shape[2]}) is needed.")
    labels = plane_labels(dims, ys.shape[2], units, names)
    ax = axes(ax, figsize=(4.8, 4.4))
    # Where all of them coincide they are as dark as one line; a single one stays visible.
    alpha = float(np.clip(8 / len(ys), 0.06, 0.6))
    for i, orbit in enumerate(ys):
        name = label if i == 0 else None
        ax.plot(*orbit[:, list(dims)].T, color=color, alpha=alpha, linewidth=0.8, label=name)
    ax.plot(*ys[0, 0, list(dims)], "o", color=color, ms=5, zorder=4)
    if true is not None:
        path = np.asarray(true)[:, list(dims)]
        ax.plot(*path.T, color=COLORS["true"], linewidth=1.4, zorder=3, label="true")
    if ax.get_legend_handles_labels()[0]:
        for line in ax.legend(fontsize="small", framealpha=0.9).get_lines():
            line.set_alpha(1.0)
    ax.set(title=title or "", **labels)
    return ax


# Standard deviations on either side that hold a share of a normal variable, and how it is shaded.
_SHARES = ((0.9, 1.645, 0.18), (0.5, 0.674, 0.38))


@drawn
def band(
    ts: Float[ArrayLike, " T"],
    mean: Float[ArrayLike, " T"],
    deviation: Float[ArrayLike, " T"],
    true: Float[ArrayLike, " T"] | None = None,
    ax: Axes | None = None,
    *,
    color: str = _BLUE,
    xlabel: str = "time $t$",
    ylabel: str = "",
    unit: str | None = None,
    title: str | None = None,
) -> Axes:
    """Draw a mean with the bands that contain the truth with a probability of 50 and 90 %.

    Args:
        ts: times, or another abscissa, shape (T,).
        mean: shape (T,).
        deviation: standard deviations, shape (T,), such as those of `posterior.energy_deviation`.
        true: the truth, shape (T,).
        ax: axes to draw on; new ones if None.
        color: of the mean and the bands.
        xlabel: of the abscissa.
        ylabel: of the mean.
        unit: of the mean.
        title: of the axes.

    Raises:
        ValueError: shapes are not all (T,), or a deviation is negative.
    """
    given = [ts, mean, deviation] + ([] if true is None else [true])
    ts, mean, deviation, *rest = (np.asarray(each) for each in given)
    if ts.ndim != 1 or any(each.shape != ts.shape for each in (mean, deviation, *rest)):
        shapes = ", ".join(str(np.shape(each)) for each in given)
        raise ValueError(f"the arrays have shapes {shapes}; all must be (T,).")
    if (deviation < 0).any():
        raise ValueError("deviation is negative somewhere: standard deviations are needed.")
    ax = axes(ax, figsize=(5.6, 3.6))
    for share, width, shade in _SHARES:
        reach = width * deviation
        name = f"{share:.0%}"
        ax.fill_between(
            ts, mean - reach, mean + reach, color=color, alpha=shade, linewidth=0, label=name
        )
    ax.plot(ts, mean, color=color, linewidth=1.4, label="mean")
    for values in rest:
        ax.plot(ts, values, color=COLORS["true"], linewidth=1.2, linestyle="--", label="true")
    ax.set(xlabel=xlabel, ylabel=with_unit(ylabel, unit), title=title or "")
    ax.set_xlim(ts.min(), ts.max())
    legend(ax)
    return ax


@drawn
def deviation(
    fn: Callable[[Float[Array, "2"]], Array],
    xlim: Limits,
    ylim: Limits,
    data: Float[ArrayLike, "N 2"] | None = None,
    ax: Axes | None = None,
    *,
    label: str = "standard deviation",
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    resolution: int = 41,
) -> Axes:
    """Draw the standard deviation of a learned field or H over the plane, and mark its maximum.

    Args:
        fn: x (2,) -> (), or (2,) to draw its length: `posterior.deviation`, or
            `lambda x: posterior.energy_deviation(x, x0)`.
        xlim: limits of q.
        ylim: limits of p.
        data: measured states, shape (N, 2).
        ax: axes to draw on; new ones if None.
        label: of the colours.
        title: of the axes.
        units: of q and p.
        names: of the coordinates; q and p if None.
        resolution: points on each axis of the grid.

    Raises:
        ValueError: the function or the data is not in the plane, the limits do not rise, or an
            argument is not a pair.
    """
    labels = plane_labels((0, 1), 2, units, names)
    q, p, points = grid(xlim, ylim, resolution)
    X = measured(data)
    length = jax.tree_util.Partial(_length, fn)
    values = in_plane(length, points, (), "a deviation")
    ax = axes(ax, figsize=(5.4, 4.4))
    filled = ax.contourf(q, p, values.reshape(len(p), -1), 14, cmap="cividis")
    ax.figure.colorbar(filled, ax=ax, label=label)
    dots(ax, X, clip_on=False)
    most = {"color": "white", "mec": "black", "mew": 0.8, "ms": 13, "linestyle": "none"}
    ax.plot(*points[values.argmax()], "*", label="largest", zorder=6, clip_on=False, **most)
    ax.set(title=title or "", xlim=xlim, ylim=ylim, **labels)
    legend(ax)
    return ax


def _length(fn: Callable[[Array], Array], x: Float[Array, "2"]) -> Float[Array, ""]:
    return jnp.linalg.norm(jnp.atleast_1d(fn(x)))
