"""Rows of a system that are held out together."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Group:
    """F folds of similar size, padded to S points each so that they can be worked on together.

    Attributes:
        members: the points of each fold, shape (F, S), padded with N, which is no point.
    """

    def __init__(self, N: int, folds: list[Int[np.ndarray, " _"]]):
        self.N = N
        self.members = np.full((len(folds), max(map(len, folds))), N)
        for row, fold in zip(self.members, folds, strict=True):
            row[: len(fold)] = fold

    def gather(self, array: Float[Array, "Nn *r"]) -> Float[Array, "F Sn *r"]:
        """The rows of each fold; zeros in the padding."""
        by_point, points = array.reshape(self.N, -1, *array.shape[1:]), self.members.reshape(-1)
        if not np.array_equal(points, np.arange(self.N)):
            by_point = jnp.take(by_point, points, axis=0, mode="fill", fill_value=0)
        return by_point.reshape(len(self.members), -1, *array.shape[1:])

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
