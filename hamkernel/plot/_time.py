"""Curves over time: errors and energies, and logged runs with their smoothed and fitted states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes

from hamkernel import _require as require
from hamkernel._runs.flow import integrate
from hamkernel.plot._style import (
    BLUE,
    COLORS,
    DATA,
    as_pair,
    axes,
    coordinate,
    curves_by_name,
    legend,
    line_styles,
    refuse_tracers,
    with_unit,
)

if TYPE_CHECKING:
    from hamkernel._learned.result import Learned
    from hamkernel._runs.runs import Runs

# Each (T,), or (S, T) for several seeds.
Series = ArrayLike | Mapping[str, ArrayLike]


@refuse_tracers
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
        unit: the unit of the error.
        time_unit: the unit of `ts`.
        title: the title of the axes.
        show_legend: whether named curves get a legend.

    Raises:
        ValueError: a curve does not have one value per time, or no seed of it is finite.
    """
    curves = _curves_over_time(ts, errors)
    ax = axes(ax, figsize=(5.6, 3.8))
    _bands(ax, ts, curves, quantiles, log)
    ax.set_ylabel(with_unit("trajectory error", unit))
    return _finish_time_axes(ax, ts, time_unit, title, show_legend)


@refuse_tracers
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
        unit: the unit of the energy; unused if `relative`.
        time_unit: the unit of `ts`.
        title: the title of the axes.
        show_legend: whether named curves get a legend.

    Raises:
        ValueError: a curve does not have one value per time, or no seed of it is finite; or
            `relative`, and an energy is zero at the start.
    """
    changes = {}
    for name, values in _curves_over_time(ts, energies).items():
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
    return _finish_time_axes(ax, ts, time_unit, title, show_legend)


def _curves_over_time(ts: ArrayLike, series: Series) -> dict[str | None, np.ndarray]:
    """The curves by name, if each has one value for each time."""
    shape, curves = np.shape(ts), curves_by_name(series)
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
    first, last = as_pair("quantiles", quantiles)
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


def _finish_time_axes(
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


_SIGMAS = 2.0  # standard deviations on either side, which hold 95 % of a normal variable
_BETWEEN = 9  # points a sample, between which a curve looks smooth


@refuse_tracers
def smoothing(
    runs: Runs,
    run: int = 0,
    ax: Sequence[Axes] | None = None,
    *,
    units: Sequence[str | None] | None = None,
    names: Sequence[str | None] | None = None,
    time_unit: str | None = None,
    title: str | None = None,
) -> tuple[Axes, ...]:
    """Draw one logged run: the samples, and the smoothed states within two standard deviations.

    Each coordinate has one panel. The band is for the state; a new sample has noise on top of it.
    The panel of a coordinate that was never measured stays empty.

    Args:
        runs: the logged runs.
        run: the position of the run, counted from 0, or from the end if negative.
        ax: n axes, one for each coordinate; new ones if None.
        units: the unit of each coordinate.
        names: the name of each coordinate; if None, the name of its column in the log, else q
            or p.
        time_unit: the unit of the times.
        title: above the first panel; the number of the run if None.

    Returns:
        The n axes.

    Raises:
        ValueError: there is no such run, or an argument does not have one entry per coordinate.
    """
    run, n = index_of_run(run, len(runs)), runs.dimension
    labels = _coordinate_labels(n, units, names or runs.names)
    panels = _panels(n, 1, ax)[:, 0]
    curves = runs.smoothing(_BETWEEN - 1)
    ts, mean = np.asarray(curves.times[run]), np.asarray(curves.states[run])
    reach = _SIGMAS * np.asarray(curves.deviation[run])
    for c, panel in enumerate(panels):
        low, high = mean[:, c] - reach[:, c], mean[:, c] + reach[:, c]
        name = rf"$\pm{_SIGMAS:g}\sigma$"
        panel.fill_between(ts, low, high, color=BLUE, alpha=0.25, linewidth=0, label=name)
        panel.plot(ts, mean[:, c], color=BLUE, linewidth=1.4, label="smoothed")
        _draw_samples(panel, runs, run, c)
        _set_time_axis(panel, ts, labels[c])
    return _set_titles(panels, f"run {run}" if title is None else title, time_unit)


@refuse_tracers
def fitted(
    learned: Learned,
    run: int = 0,
    ax: Sequence[Sequence[Axes]] | None = None,
    *,
    units: Sequence[str | None] | None = None,
    names: Sequence[str | None] | None = None,
    time_unit: str | None = None,
    title: str | None = None,
) -> tuple[tuple[Axes, Axes], ...]:
    """Draw one run as measured and as the learned field explains it, with the residuals.

    Each coordinate has one row of panels. On the left are the samples and the fitted states; the
    flow of the field joins the states, also across gaps. On the right are the residuals
    (measured − fitted)/σ; about one in twenty lies outside the grey band of ±2. A wave in the
    residuals means that the structure misses part of the motion; a single outlier means that the
    sample is wrong. A coordinate that was never measured has no panel on the right.

    Args:
        learned: the result of `hk.learn`.
        run: which run, counted from 0, or from the end if negative.
        ax: n pairs of axes; new ones if None.
        units: the unit of each coordinate.
        names: the name of each coordinate; if None, the name of its column in the log, else q
            or p.
        time_unit: the unit of the times.
        title: above the first panel; if None, the number of the run and the share of it from which
            the field was learned.

    Returns:
        The axes, a pair for each coordinate.

    Raises:
        ValueError: there is no such run, or an argument does not have one entry per coordinate.
    """
    run, n = index_of_run(run, len(learned.runs)), learned.runs.dimension
    labels = _coordinate_labels(n, units, names or learned.runs.names)
    panels = _panels(n, 2, ax)
    ts, fit = np.asarray(learned.runs.times[run]), np.asarray(learned.states[run])
    grid = np.interp(np.arange(_BETWEEN * (len(ts) - 1) + 1) / _BETWEEN, np.arange(len(ts)), ts)
    spans = np.repeat(np.diff(ts)[:, None] / _BETWEEN, _BETWEEN, axis=1)
    ends = learned.runs.input_lines(run, grid)
    ends = ends.reshape(*spans.shape, 2, ends.shape[2])
    field = getattr(learned.field, "whole", learned.field)  # of the points (x, u) with inputs
    steps, starts = jnp.ones(_BETWEEN, int), jnp.asarray(fit[:-1])
    between = integrate(field, starts, jnp.asarray(spans), steps, jnp.asarray(ends)).x
    path = np.concatenate([np.asarray(between[:, :-1]).reshape(-1, n), fit[-1:]])
    residuals, misfit = np.asarray(learned.residuals[run]), np.asarray(learned.misfit[run])
    for c, (left, right) in enumerate(panels):
        left.plot(grid, path[:, c], color=BLUE, linewidth=1.4, label="fitted")
        _draw_samples(left, learned.runs, run, c)
        _set_time_axis(left, ts, labels[c])
        if not np.isfinite(misfit[c]):
            right.set_axis_off()
            continue
        right.axhspan(-_SIGMAS, _SIGMAS, color="0.9", linewidth=0)
        right.axhline(0.0, color="0.6", linewidth=0.8)
        right.plot(ts, residuals[:, c], "o", color=COLORS["true"], ms=3, clip_on=False)
        _set_time_axis(right, ts, r"residual / $\sigma$")
        far = max(1.6 * _SIGMAS, 1.1 * np.nanmax(np.abs(residuals[:, c])))
        right.set_ylim(-far, far)
        size = f"root mean square {misfit[c]:.2f}, grey: ±{_SIGMAS:g}"
        right.set_title(size, fontsize="small")
    if title is None:
        title = f"run {run}, {100 * float(learned.kept[run]):.0f} % of it used"
    _set_titles(panels[:, 0], title, time_unit)
    panels[-1, 1].set_xlabel(with_unit("time $t$", time_unit))
    return tuple((left, right) for left, right in panels)


def index_of_run(run: int, count: int) -> int:
    if not -count <= run < count:
        raise ValueError(f"there is no run {run}: there are {count}, counted from 0.")
    return range(count)[run]


def _coordinate_labels(
    n: int, units: Sequence[str | None] | None, names: Sequence[str | None] | None
) -> list[str]:
    """The label of each coordinate."""
    for name, values in (("units", units), ("names", names)):
        if values is not None and (isinstance(values, str) or len(values) != n):
            raise ValueError(f"{name} must have {n} entries, one a coordinate, got {values!r}.")
    symbols = [None] * n if names is None else names
    return [
        with_unit(name or coordinate(c, n), unit)
        for c, (name, unit) in enumerate(zip(symbols, units or [None] * n, strict=True))
    ]


def _panels(n: int, width: int, ax: object) -> np.ndarray:
    """The caller's axes, or new ones, as an array of panels of shape (n, width)."""
    if ax is None:
        import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

        ratios = [3, 2][:width] if width > 1 else None
        size = (5.6 if width == 1 else 8.8, 0.8 + 1.9 * n)
        options = {"figsize": size, "layout": "constrained", "squeeze": False}
        return plt.subplots(n, width, sharex=True, width_ratios=ratios, **options)[1]
    panels = np.asarray(ax, object)
    if panels.size != n * width:
        need = "axes, one" if width == 1 else "pairs of axes, one"
        raise ValueError(f"ax has {panels.size} axes; {n} {need} for each coordinate, are needed.")
    return panels.reshape(n, width)


def _draw_samples(panel: Axes, runs: Runs, run: int, c: int) -> None:
    ts, x = np.asarray(runs.times[run]), np.asarray(runs.states[run])[:, c]
    style = {"mec": "black", "mew": 0.4, "ms": 4, "zorder": 4, "clip_on": False}
    panel.plot(ts, x, "o", color=DATA, label="measured", **style)


def _set_time_axis(panel: Axes, ts: np.ndarray, label: str) -> None:
    panel.set_ylabel(label)
    panel.set_xlim(ts[0], ts[-1])
    panel.ticklabel_format(axis="x", scilimits=(-2, 5))  # microseconds would overlap
    panel.grid(True, color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)


def _set_titles(panels: np.ndarray, title: str, time_unit: str | None) -> tuple[Axes, ...]:
    panels[0].set_title(title, loc="left", fontsize="medium")
    panels[-1].set_xlabel(with_unit("time $t$", time_unit))
    # Above the panel: samples and curve of a log may fill all of it.
    above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 3, "frameon": False}
    legend(panels[0], **above, borderaxespad=0.1)
    return tuple(panels)
