"""The folds of cross-validation: which points are held out together."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import ArrayLike, Int

from hamkernel import _require as require
from hamkernel._solvers.factors import Group

Folds = int | Literal["loo"] | Int[ArrayLike, " N"] | Sequence[int]


class Partition:
    """N points in F folds: what `folds` means, as a static argument of compiled functions.

    Attributes:
        folds: the points of each of the F folds.
        groups: the folds again, those of similar size together.
        weights: 1 / (F |fold of i|) for each point, so that `weights @ squares` is the mean over
            folds of the mean over points, shape (N,).
    """

    def __init__(self, N: int, folds: Folds):
        names, index, sizes = np.unique(_labels(N, folds), return_inverse=True, return_counts=True)
        self.labels = index
        if len(names) < 2:
            raise ValueError(
                f"cross-validation needs at least two folds, and these {N} points are in one. "
                "Give each point the label of its trajectory, a number of folds, or 'loo'."
            )
        self.folds = np.split(np.argsort(index, kind="stable"), np.cumsum(sizes)[:-1])
        self.weights = 1.0 / (len(names) * sizes[index])
        # Within a factor of two of the largest of them: the padding never doubles the points.
        octave = np.floor(np.log2(sizes.max() / sizes)).astype(int)
        self.groups = [
            Group(N, [self.folds[i] for i in np.flatnonzero(octave == each)])
            for each in np.unique(octave)
        ]

    def __hash__(self) -> int:
        return hash(self.labels.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Partition) and np.array_equal(self.labels, other.labels)


def _labels(N: int, folds: Folds) -> Int[np.ndarray, " N"]:
    """One integer for each point, the same within a fold."""
    if isinstance(folds, str):
        if folds != "loo":
            raise ValueError(f"folds must be a number, 'loo' or an array of labels; got {folds!r}.")
        return np.arange(N)
    if not require.is_concrete(folds):
        raise TypeError(
            "folds is traced: the labels decide the shapes of the computation, so they must be "
            "concrete. Close over them, or mark the argument static under jax.jit."
        )
    array = np.asarray(folds)
    if not np.issubdtype(array.dtype, np.integer):
        cure = " Names become integers by np.unique(names, return_inverse=True)[1]."
        raise ValueError(
            "folds must be a whole number, 'loo' or an array of integer labels; got "
            + (f"{folds!r}." if array.ndim == 0 else f"dtype {array.dtype}.{cure}")
        )
    if array.ndim == 0:
        if not 2 <= array <= N:
            raise ValueError(f"folds must be between 2 and the number of points, {N}; got {folds}.")
        parts = np.array_split(np.arange(N), int(array))
        return np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    if array.shape != (N,):
        raise ValueError(
            f"folds has shape {array.shape}; one integer label for each of the {N} points is "
            "needed, shape (N,), or a number of folds, or 'loo'."
        )
    return array
