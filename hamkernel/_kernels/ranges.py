"""Where to look for hyperparameters: a box from the data, in stored coordinates.

A lengthscale far below the distance between neighbours, or far above the extent of the data,
changes nothing but rounding; an amplitude is compared with the scale of Y.
"""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float


def by_name(
    name: str, leaf: Any, X: Float[np.ndarray, "N n"], amplitude: float
) -> tuple[ArrayLike, ArrayLike]:
    """The box of a hyperparameter of a scalar kernel, whose name says what it is."""
    if name in ("log_lengthscale", "log_period"):
        spacing, extent = _spacing_and_extent(X, per_coordinate=leaf.ndim > 0)
        least, most = (0.3, 30) if name == "log_lengthscale" else (2, 10)
        return np.log(least * spacing), np.log(most * extent)
    if name == "log_scale":
        return np.log(1e-5 * amplitude), np.log(1e5 * amplitude)
    if name == "log_offset":
        square = np.mean(np.sum(X**2, axis=1)) or 1.0
        return np.log(1e-4 * square), np.log(1e4 * square)
    return by_value(name, leaf)


def by_value(name: str, leaf: Any) -> tuple[ArrayLike, ArrayLike]:
    """The box of a number of unknown meaning, around its value."""
    value = np.asarray(leaf)
    reach = np.log(1e3) if name.startswith("log_") else 10 * np.maximum(1.0, np.abs(value))
    return value - reach, value + reach


def _spacing_and_extent(X: np.ndarray, per_coordinate: bool) -> tuple[ArrayLike, ArrayLike]:
    """The typical distance of nearest neighbours and the extent of the data, 1 where it is 0.

    The distance of N points in an extent L is taken as L / N: a fair lower bound in any dimension,
    since points on a few trajectories lie close together along them.
    """
    ranges = np.ptp(X, axis=0)
    extent = ranges if per_coordinate else np.asarray(np.linalg.norm(ranges))
    extent = np.where(extent > 0, extent, 1.0)
    return extent / max(len(X), 2), extent
