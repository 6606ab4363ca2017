"""Where the runs start: the best points of a space-filling design of the box."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

DESIGN_POINTS = 64  # for each direction of the box, and four at most


def design(directions: Sequence[int]) -> Float[np.ndarray, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d.

    Coordinates with the same direction move together, each through its own box. Were the
    lengthscales of n coordinates to move apart, almost every point would have some that is far
    too short or too long, and hardly a start would lead to a good optimum.
    """
    d = max(directions) + 1
    count = DESIGN_POINTS * min(d, 4)
    root = 2.0
    for _ in range(64):  # the positive solution of root^(d + 1) = root + 1
        root = (1 + root) ** (1 / (d + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, d + 1))) % 1.0
    return np.arcsin(2 * share - 1)[:, list(directions)]


def spread_out(
    design: Float[np.ndarray, "count P"], values: Float[np.ndarray, " count"], starts: int
) -> Float[np.ndarray, "starts P"]:
    """The best points of the design that are not neighbours of a better one already taken."""
    reach = 0.25 * design.shape[1] ** 0.5  # of a box of side 1
    order = np.argsort(values, kind="stable")
    taken: list[int] = []
    for i in order:
        if all(shares_apart(design[i], design[j]) >= reach for j in taken):
            taken.append(i)
    left = [i for i in order if i not in taken]  # of which the best, where the box is full
    return design[(taken + left)[:starts]]


def shares_apart(u: Float[np.ndarray, " P"], v: Float[np.ndarray, " P"]) -> float:
    """The distance of two points in a box of side 1."""
    return float(np.linalg.norm(np.sin(u) - np.sin(v)) / 2)
