"""Which points cross-validation holds out together."""

from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from hamkernel import _require as require

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


class Group:
    """F folds of similar size, S points at most, padded so that they are worked on side by side.

    Attributes:
        members: the points of each fold, shape (F, S); the rows of smaller folds end in N, which
            is no point.
    """

    def __init__(self, N: int, folds: list[Int[np.ndarray, " _"]]):
        self.N = N
        self.members = np.full((len(folds), max(map(len, folds))), N)
        for row, fold in zip(self.members, folds, strict=True):
            row[: len(fold)] = fold

    def gather(self, array: Float[Array, "..."], axis: int = 0) -> Float[Array, "..."]:
        """The axis of all rows as two, (…, Nn, …) -> (…, F, Sn, …); zeros in the padding."""
        before, after = array.shape[:axis], array.shape[axis + 1 :]
        by_point = array.reshape(*before, self.N, -1, *after)
        if not np.array_equal(self.members.reshape(-1), np.arange(self.N)):
            by_point = jnp.take(
                by_point, self.members.reshape(-1), axis=axis, mode="fill", fill_value=0
            )
        return by_point.reshape(*before, len(self.members), -1, *after)

    def scattered(
        self, values: Float[Array, "F Sn"], into: Float[Array, " Nn"]
    ) -> Float[Array, " Nn"]:
        """`into` with the rows of these folds replaced; the padding is dropped."""
        by_point = values.reshape(*self.members.shape, -1)
        rows = into.reshape(self.N, -1).at[self.members].set(by_point, mode="drop")
        return rows.reshape(into.shape)

    def diagonal_blocks(self, C: Float[Array, "Nn Nn"]) -> Float[Array, "F Sn Sn"]:
        """The block of C that belongs to each fold, and the identity in the padding."""
        n = len(C) // self.N
        rows = (n * self.members[:, :, None] + np.arange(n)).reshape(len(self.members), -1)
        blocks = C.at[rows[:, :, None], rows[:, None, :]].get(mode="fill", fill_value=0)
        in_padding = jnp.asarray(rows >= len(C), C.dtype)
        diagonal = np.arange(rows.shape[1])
        return blocks.at[:, diagonal, diagonal].add(in_padding)


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
