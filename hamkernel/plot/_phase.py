"""Pictures in the plane of two coordinates, and Poincaré sections."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib import colormaps
from matplotlib.axes import Axes

from hamkernel.plot._style import (
    BENEATH,
    STREAM,
    Limits,
    Texts,
    axes,
    curves_by_name,
    dots,
    evaluate_at,
    evaluate_in_plane,
    grid,
    legend,
    line_styles,
    plane_data,
    plane_labels,
    refuse_tracers,
)

# Each (T, n), or (B, T, n) for trajectories under one name.
Curves = ArrayLike | Mapping[str, ArrayLike]


@refuse_tracers
def phase_portrait(
    field: Callable[[Float[Array, "2"]], Float[Array, "2"]],
    xlim: Limits,
    ylim: Limits,
    data: Float[ArrayLike, "N 2"] | None = None,
    trajectories: Curves | None = None,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    density: float = 0.9,
    resolution: int = 41,
    show_legend: bool = True,
) -> Axes:
    """Draw the stream lines of a field in the plane, trajectories over them, data on top.

    Args:
        field: x (2,) -> ẋ (2,), learned or true.
        xlim: limits of q.
        ylim: limits of p.
        data: measured states, shape (N, 2).
        trajectories: shape (T, 2) or (B, T, 2), or a mapping from names to such arrays, as in
            `trajectories`.
        ax: axes to draw on; new ones if None.
        title: the title of the axes.
        units: the units of q and p.
        names: the names of the coordinates; q and p if None.
        density: the density of the stream lines, as in Matplotlib.
        resolution: points on each axis of the grid where the field is evaluated.
        show_legend: whether named trajectories and data get a legend.

    Raises:
        ValueError: the field, the data or a trajectory is not in the plane, the limits do not
            rise, or an argument is not a pair.
    """
    labels = plane_labels((0, 1), 2, units, names)
    q, p, points = grid(xlim, ylim, resolution)
    velocities = evaluate_in_plane(field, points, (2,), "a field")
    X = plane_data(data)
    curves = {} if trajectories is None else _checked_curves(trajectories, 2)
    ax = axes(ax, figsize=(5.2, 4.6))
    _stream(ax, q, p, velocities, density)
    _curves(ax, curves, (0, 1))
    dots(ax, X)
    _finish(ax, labels, title, xlim, ylim)
    if show_legend:
        legend(ax, loc=_widest_corner(ax))
    return ax


@refuse_tracers
def trajectories(
    ys: Curves,
    ax: Axes | None = None,
    *,
    dims: tuple[int, int] = (0, 1),
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    show_legend: bool = True,
) -> Axes:
    """Draw trajectories in the plane of two coordinates, for example true and learned ones.

    Args:
        ys: shape (T, n) or (B, T, n), or a mapping from names to such arrays. A dot marks where
            each starts. "true", or else the first name, is drawn wide, beneath the others.
        ax: axes to draw on; new ones if None.
        dims: the two coordinates, counted from 0.
        title: the title of the axes.
        units: the units of the two coordinates.
        names: the names of the two coordinates, if not q and p.
        show_legend: whether named trajectories get a legend.

    Raises:
        ValueError: an array is of another shape, there is none, `dims` are not two of the
            coordinates, or an argument is not a pair.
    """
    curves = _checked_curves(ys)
    n = next(iter(curves.values())).shape[-1]
    labels = plane_labels(dims, n, units, names)
    ax = axes(ax, figsize=(4.6, 4.2))
    _curves(ax, curves, dims)
    if show_legend:
        legend(ax)
    return _finish(ax, labels, title)


@refuse_tracers
def plane_slice(
    fn: Callable[[Float[Array, " n"]], Array],
    point: Float[ArrayLike, " n"],
    dims: tuple[int, int],
    xlim: Limits,
    ylim: Limits,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    label: str | None = None,
    levels: int | Float[ArrayLike, " L"] = 15,
    resolution: int = 61,
) -> Axes:
    """Draw a function of n coordinates on the plane through a point along two of them.

    A scalar function, such as H, is drawn as filled contours relative to its minimum on the plane;
    a field as the stream lines of its two components in the plane, over its speed out of the plane.
    Where a function is not finite, such as at the centre of Kepler's problem, the picture stays
    white.

    Args:
        fn: x (n,) -> () or (n,).
        point: values of the other coordinates, shape (n,).
        dims: the two coordinates that vary, counted from 0.
        xlim: limits of the first coordinate.
        ylim: limits of the second coordinate.
        ax: axes to draw on; new ones if None.
        title: the title of the axes.
        units: the units of the two coordinates.
        names: the names of the two coordinates, if not q and p.
        label: the name of the colours; H − min H, or the speed out of the plane, if None.
        levels: number of contours, or the levels themselves; colours continue beyond them.
        resolution: points on each axis of the grid.

    Raises:
        ValueError: the function is neither scalar nor a field on n coordinates, it is nowhere
            finite on the grid, `dims` are not two of the coordinates, the limits do not rise, or
            an argument is not a pair.
    """
    point = np.asarray(point, float)
    labels = plane_labels(dims, len(point), units, names)
    x, y, plane = grid(xlim, ylim, resolution)
    states = np.tile(point, (len(plane), 1))
    states[:, list(dims)] = plane
    values = evaluate_at(fn, states)
    if values.shape not in {(len(plane),), states.shape}:
        raise ValueError(
            f"plane_slice needs a function ({len(point)},) -> () or ({len(point)},), this one "
            f"returns {values.shape[1:]}."
        )
    if not np.isfinite(values).any():
        raise ValueError("the function is finite nowhere on the grid.")
    ax = axes(ax, figsize=(5.2, 4.3))
    if values.ndim == 2:
        _stream(ax, x, y, values[:, list(dims)], 0.9, "white")
        background = np.linalg.norm(np.delete(values, dims, axis=1), axis=1)
        label = label or "speed out of the plane"
    else:
        background, label = values - values[np.isfinite(values)].min(), label or "$H - \\min H$"
    background = np.ma.masked_invalid(background).reshape(resolution, resolution)
    extend = "both" if np.ndim(levels) else "neither"
    filled = ax.contourf(x, y, background, levels, cmap="cividis", extend=extend, zorder=0)
    if values.ndim == 1:
        ax.contour(x, y, background, levels, colors="white", linewidths=0.4)
    ax.figure.colorbar(filled, ax=ax, label=label)
    return _finish(ax, labels, title, xlim, ylim)


def _stream(
    ax: Axes,
    x: np.ndarray,
    y: np.ndarray,
    velocities: np.ndarray,
    density: float,
    color: str = STREAM,
) -> None:
    u, v = np.moveaxis(velocities.reshape(len(y), len(x), 2), -1, 0)
    ax.streamplot(x, y, u, v, color=color, linewidth=0.7, arrowsize=0.7, density=density, zorder=1)


def _checked_curves(curves: Curves, n: int | None = None) -> dict[str | None, np.ndarray]:
    """The curves by name, if all of them are trajectories of n coordinates, those of the first."""
    try:
        arrays = curves_by_name(curves)
    except ValueError as error:  # rows of unequal length
        raise ValueError(
            "trajectories of unequal length are not one array: name them, {name: (T, n), ...}."
        ) from error
    if not arrays:
        raise ValueError("there is no trajectory to draw: the mapping is empty.")
    for name, ys in arrays.items():
        n = ys.shape[-1] if n is None and ys.ndim in (2, 3) else n
        if ys.ndim not in (2, 3) or ys.size == 0 or ys.shape[-1] != n:
            of_name = "" if name is None else f" {name!r}"
            width = "n" if n is None else n
            raise ValueError(
                f"the trajectory{of_name} has shape {ys.shape}; (T, {width}) or (B, T, {width}) is "
                "needed, such as the .ys of hk.simulate."
            )
    return arrays


def _curves(ax: Axes, curves: Mapping[str | None, np.ndarray], dims: tuple[int, int]) -> None:
    styles = list(line_styles(curves))
    if len({style["linewidth"] for style in styles}) == 1 < len(styles):  # none is "true"
        styles[0].update(BENEATH)
    for style, ys in zip(styles, curves.values(), strict=True):
        batch = ys if ys.ndim == 3 else ys[None]  # (B, T, n)
        for i, y in enumerate(batch):
            label = style["label"] if i == 0 else None
            ax.plot(y[:, dims[0]], y[:, dims[1]], **{**style, "label": label})
            ax.plot(*y[0, list(dims)], "o", color=style["color"], ms=4, zorder=4)


def _finish(
    ax: Axes,
    labels: Mapping[str, str],
    title: str | None,
    xlim: Limits | None = None,
    ylim: Limits | None = None,
) -> Axes:
    options = {**labels, "title": title, "xlim": xlim, "ylim": ylim}
    ax.set(**{key: value for key, value in options.items() if value is not None})
    return ax


def _widest_corner(ax: Axes) -> str:
    """The corner with the largest box, twice as wide as high, free of curves and data.

    Matplotlib's own choice counts the arrows of the stream lines, and so may cover a curve.
    """
    points = np.concatenate([np.empty((0, 2)), *(line.get_xydata() for line in ax.lines)])
    points = (ax.transData - ax.transAxes).transform(points)
    points = points[((points >= 0) & (points <= 1)).all(axis=1)]

    def width(corner: str) -> float:
        x_y = ("right" in corner, "upper" in corner)
        return (np.abs(points - x_y) * (1, 2)).max(axis=1).min(initial=np.inf)

    return max(("upper right", "upper left", "lower left", "lower right"), key=width)


@refuse_tracers
def crossings(
    ys: Float[ArrayLike, "T n"], coordinate: int, value: float = 0.0, direction: int = 1
) -> Float[np.ndarray, "M n"]:
    """Return the points where a trajectory crosses the plane x[coordinate] = value.

    Interpolation between neighbouring states is linear, with an error of second order in their
    distance: save the trajectory densely.

    Args:
        ys: states along one trajectory, shape (T, n).
        coordinate: the number of the coordinate that is fixed on the section, counted from 0.
        value: the value of this coordinate on the section.
        direction: +1 for crossings from below, −1 from above, 0 for both.

    Returns:
        States, shape (M, n), in order of time; M may be 0.

    Raises:
        ValueError: ys is not one trajectory, or has no such coordinate.
    """
    ys = np.asarray(ys)
    if ys.ndim != 2:
        raise ValueError(f"ys has shape {ys.shape}; one trajectory (T, n) is needed.")
    if not -ys.shape[1] <= coordinate < ys.shape[1]:
        raise ValueError(f"there is no coordinate {coordinate} in states of {ys.shape[1]}.")
    height = ys[:, coordinate] - value
    before, after = height[:-1], height[1:]
    # A state exactly on the section counts as above it, so that no crossing is met twice.
    up, down = (before < 0) & (after >= 0), (before >= 0) & (after < 0)
    index = np.flatnonzero({1: up, -1: down, 0: up | down}[int(np.sign(direction))])
    weight = (before[index] / (before[index] - after[index]))[:, None]
    return (1 - weight) * ys[index] + weight * ys[index + 1]


@refuse_tracers
def poincare_section(
    points: ArrayLike | Sequence[ArrayLike] | Mapping[str, ArrayLike],
    dims: tuple[int, int],
    ax: Axes | None = None,
    *,
    title: str | None = None,
    units: Texts | None = None,
    names: Texts | None = None,
    size: float = 3.0,
) -> Axes:
    """Draw the points of a Poincaré section in the plane of two coordinates.

    Args:
        points: crossings of one trajectory, shape (M, n); a list of such arrays, each drawn in
            its own colour; or a mapping from names to arrays, which adds a legend.
        dims: the two coordinates, counted from 0.
        ax: axes to draw on; new ones if None.
        title: the title of the axes.
        units: the units of the two coordinates.
        names: the names of the two coordinates, if not q and p.
        size: the size of the dots, in points.

    Raises:
        ValueError: there is no trajectory to draw, `dims` are not two of the coordinates, or an
            argument is not a pair.
    """
    dots: dict[str, Any] = {"linestyle": "none", "marker": ".", "ms": size, "mew": 0}
    if isinstance(points, list | tuple):
        arrays = [np.asarray(group) for group in points]
        shades = colormaps["viridis"](np.linspace(0, 0.9, len(arrays)))
        styles = [{"color": shade} for shade in shades]
    else:
        groups = curves_by_name(points)
        styles = [{k: s[k] for k in ("color", "label")} for s in line_styles(groups)]
        arrays = list(groups.values())
    if not arrays:
        raise ValueError("points is empty: one array (M, n) for each trajectory is needed.")
    labels = plane_labels(dims, arrays[0].shape[-1], units, names)
    ax = axes(ax, figsize=(5.0, 4.6))
    for style, array in zip(styles, arrays, strict=True):
        ax.plot(array[:, dims[0]], array[:, dims[1]], **dots, **style)
    legend(ax, markerscale=4)
    return _finish(ax, labels, title)
