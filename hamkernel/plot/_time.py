"""Pictures over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes

from hamkernel import _require as require
from hamkernel.plot._style import axes, drawn, legend, line_styles, named, two, with_unit

# Each (T,), or (S, T) for several seeds.
Series = ArrayLike | Mapping[str, ArrayLike]


@drawn
def trajectory_error(
    ts: Float[ArrayLike, " T"],
    errors: Series,
    ax: Axes | None = None,
    *,
    log: bool = True,
    quantiles: tuple[float, float] = (0.1, 0.9),
    unit: str | None = None,
    time_unit: str | None = None,
    title: str | None = None,
    show_legend: bool = True,
) -> Axes:
    """Draw the error of trajectories over time; for several seeds, their median and a band.

    Seeds with a value that is not finite are omitted, with a warning.

    Args:
        ts: times, shape (T,).
        errors: ‖x_true(t) − x(t)‖, shape (T,) or (S, T), or a mapping from names to such arrays.
        ax: axes to draw on; new ones if None.
        log: whether the axis of the error is logarithmic. Zeros, as at the start, are omitted.
        quantiles: the band over seeds.
        unit: of the error.
        time_unit: of `ts`.
        title: of the axes.
        show_legend: whether named curves get a legend.

    Raises:
        ValueError: a curve does not have one value per time, or no seed of it is finite.
    """
    curves = _checked(ts, errors)
    ax = axes(ax, figsize=(5.6, 3.8))
    _bands(ax, ts, curves, quantiles, log)
    ax.set_ylabel(with_unit("trajectory error", unit))
    return _finish(ax, ts, time_unit, title, show_legend)


@drawn
def energy_drift(
    ts: Float[ArrayLike, " T"],
    energies: Series,
    ax: Axes | None = None,
    *,
    relative: bool = False,
    log: bool = False,
    quantiles: tuple[float, float] = (0.1, 0.9),
    unit: str | None = None,
    time_unit: str | None = None,
    title: str | None = None,
    show_legend: bool = True,
) -> Axes:
    """Draw the change of the energy along trajectories, H(x(t)) − H(x(0)).

    Args:
        ts: times, shape (T,).
        energies: H(x(t)), shape (T,) or (S, T), or a mapping from names to such arrays.
        ax: axes to draw on; new ones if None.
        relative: divide by |H(x(0))|.
        log: draw the absolute change on a logarithmic axis. Zeros are omitted.
        quantiles: the band over seeds.
        unit: of the energy; unused if `relative`.
        time_unit: of `ts`.
        title: of the axes.
        show_legend: whether named curves get a legend.

    Raises:
        ValueError: a curve does not have one value per time, or no seed of it is finite; or
            `relative`, and an energy is zero at the start.
    """
    changes = {}
    for name, values in _checked(ts, energies).items():
        start = values[..., :1]
        if relative and not start.all():
            raise ValueError("H(x(0)) = 0 has no relative change: use relative=False.")
        change = (values - start) / np.abs(start) if relative else values - start
        changes[name] = np.abs(change) if log else change
    ax = axes(ax, figsize=(5.6, 3.8))
    _bands(ax, ts, changes, quantiles, log)
    change = r"|\Delta H|" if log else r"\Delta H"
    symbol = rf"${change} / |H(0)|$" if relative else f"${change}$"
    ax.set_ylabel(with_unit(f"energy drift {symbol}", None if relative else unit))
    return _finish(ax, ts, time_unit, title, show_legend)


def _checked(ts: ArrayLike, series: Series) -> dict[str | None, np.ndarray]:
    """The curves by name, if each has one value for each time."""
    shape, curves = np.shape(ts), named(series)
    if len(shape) != 1:
        raise ValueError(f"ts has shape {shape}; times (T,) are needed.")
    for name, values in curves.items():
        if values.ndim not in (1, 2) or values.shape[-1:] != shape:
            of_name = "" if name is None else f" {name!r}"
            raise ValueError(
                f"the curve{of_name} has shape {values.shape}; (T,) or (S, T) with T = {shape[0]} "
                "is needed, one value for each time in ts."
            )
    return curves


def _bands(
    ax: Axes,
    ts: ArrayLike,
    series: Mapping[str | None, np.ndarray],
    quantiles: tuple[float, float],
    log: bool,
) -> None:
    ts, counts = np.asarray(ts), set()
    first, last = two("quantiles", quantiles)
    for style, values in zip(line_styles(series), series.values(), strict=True):
        seeds = np.atleast_2d(values)  # (S, T)
        if len(seeds) > 1:
            seeds = _finite_seeds(seeds, f" of {style['label']}" if style["label"] else "")
        low, median, high = np.quantile(seeds, [first, 0.5, last], axis=0)
        if log:
            low, median, high = (np.where(v > 0, v, np.nan) for v in (low, median, high))
        ax.plot(ts, median, **style)
        if len(seeds) > 1:
            ax.fill_between(ts, low, high, color=style["color"], alpha=0.2, linewidth=0)
            counts.add(len(seeds))
    if counts:
        of_count = " or ".join(map(str, sorted(counts)))
        label = f"median and {100 * first:g} to {100 * last:g} % of {of_count}"
        ax.fill_between([], [], color="0.5", alpha=0.3, linewidth=0, label=label)
    if log:
        ax.set_yscale("log")


def _finite_seeds(seeds: np.ndarray, of_name: str) -> np.ndarray:
    """The curves (S, T) that are finite throughout."""
    finite = np.isfinite(seeds).all(axis=1)
    if not finite.any():
        raise ValueError(f"none of the {len(seeds)} curves{of_name} is finite.")
    if not finite.all():
        require.warn(
            f"{np.sum(~finite)} of the {len(seeds)} curves{of_name} are NaN or infinite somewhere "
            "and left out of the median and the band."
        )
    return seeds[finite]


def _finish(
    ax: Axes, ts: ArrayLike, time_unit: str | None, title: str | None, show_legend: bool
) -> Axes:
    ts = np.asarray(ts)
    ax.set_xlabel(with_unit("time $t$", time_unit))
    ax.set_xlim(ts[0], ts[-1])
    ax.grid(True, color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    if title is not None:
        ax.set_title(title)
    if show_legend:
        legend(ax)
    return ax
