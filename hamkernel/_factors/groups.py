"""Rows of a system that are held out together."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


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
        self, values: Float[Array, "F Sn *r"], into: Float[Array, "Nn *r"]
    ) -> Float[Array, "Nn *r"]:
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
