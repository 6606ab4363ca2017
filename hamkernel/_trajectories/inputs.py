"""What was applied between samples: a line in each interval, its ends of shape (…, 2, m).

Held inputs are lines that do not rise. Where samples were averaged an interval spans many of the
log, and its line is the best one in the mean square, so that the impulse ∫u dt is kept exactly.
"""

import numpy as np
from jaxtyping import Array, Float

from hamkernel._trajectories.flow import NODES


def in_intervals(
    t: Float[np.ndarray, " T"], u: Float[np.ndarray, "T m"], at: Float[np.ndarray, " R"], held: bool
) -> Float[np.ndarray, "R-1 2 m"]:
    """The best line in each interval of the times `at`, which lie within the times t of u.

    Of u(σ) with σ from −1 to 1 it is m₀ + 3 m₁ σ, the moments m₀ = ½∫u dσ and m₁ = ½∫uσ dσ.
    """
    grid = np.union1d(t, at)
    grid = grid[(grid >= at[0]) & (grid <= at[-1])]
    edges = np.column_stack([grid[:-1], grid[1:]])
    i = np.clip(np.searchsorted(t, grid[:-1], side="right") - 1, 0, len(t) - 2)
    share = 0 * edges if held else (edges - t[i, None]) / (t[i + 1] - t[i])[:, None]
    ends = u[i][:, None] + share[..., None] * (u[i + 1] - u[i])[:, None]
    k = np.searchsorted(at, grid[:-1], side="right") - 1
    span = np.diff(at)[k][:, None]
    sigma = (2 * (edges - at[k][:, None]) / span - 1)[..., None]
    # Simpson's rule on each piece, exact for products of two lines.
    middle, centre = ends.mean(axis=1), sigma.mean(axis=1)
    turning = ((ends * sigma).sum(axis=1) + 4 * middle * centre) / 6
    lengths = np.diff(edges, axis=1) / span
    first = np.searchsorted(grid, at[:-1])
    m0, m1 = (np.add.reduceat(lengths * part, first, axis=0) for part in (middle, turning))
    return np.stack([m0 - 3 * m1, m0 + 3 * m1], axis=1)


def at_samples(ends: Float[np.ndarray, "R-1 2 m"]) -> Float[np.ndarray, "R m"]:
    """U at the ends of the intervals, where it jumps the mean of both sides."""
    before, after = (
        np.concatenate([ends[:1, 0], ends[:, 1]]),
        np.concatenate([ends[:, 0], ends[-1:, 1]]),
    )
    return (before + after) / 2


def at_nodes(ends: Float[Array | np.ndarray, "*S 2 m"]) -> Float[Array | np.ndarray, "*S 3 m"]:
    """U at the Gauss nodes."""
    shares = NODES.reshape((1,) * (ends.ndim - 2) + (3, 1))
    first, last = ends[..., :1, :], ends[..., 1:, :]
    return first + shares * (last - first)
