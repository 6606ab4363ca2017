"""Poincaré sections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib import colormaps
from matplotlib.axes import Axes

from hamkernel.plot._style import Texts, axes, drawn, legend, line_styles, named, plane_labels


@drawn
def crossings(
    ys: Float[ArrayLike, "T n"], coordinate: int, value: float = 0.0, direction: int = 1
) -> Float[np.ndarray, "M n"]:
    """Return the points where a trajectory crosses the plane x[coordinate] = value.

    Interpolation between neighbouring states is linear, with an error of second order in their
    distance: save the trajectory densely.

    Args:
        ys: states along one trajectory, shape (T, n).
        coordinate: which coordinate has the value on the section, counted from 0.
        value: of that coordinate.
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


@drawn
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
        points: of one trajectory, shape (M, n); a list of such arrays, each in its own colour; or
            a mapping from names to arrays, which adds a legend.
        dims: the two coordinates, counted from 0.
        ax: axes to draw on; new ones if None.
        title: of the axes.
        units: of the two coordinates.
        names: of the two coordinates, if they are not q and p.
        size: of the dots, in points.

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
        groups = named(points)
        styles = [{k: s[k] for k in ("color", "label")} for s in line_styles(groups)]
        arrays = list(groups.values())
    if not arrays:
        raise ValueError("points is empty: one array (M, n) for each trajectory is needed.")
    labels = plane_labels(dims, arrays[0].shape[-1], units, names)
    ax = axes(ax, figsize=(5.0, 4.6))
    for style, array in zip(styles, arrays, strict=True):
        ax.plot(array[:, dims[0]], array[:, dims[1]], **dots, **style)
    ax.set(**labels)
    if title is not None:
        ax.set_title(title)
    legend(ax, markerscale=4)
    return ax
