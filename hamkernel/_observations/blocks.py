"""Rows of linear functionals of a field f = B∇u and of its potential u, as maps from points.

A block has points z and maps the values f(z) or u(z) to rows: the measured components, weighted
sums over groups of points, or the values of u. Each row is divided by its relative noise, so that
the noise of all rows has the same variance. The transpose of this map turns coefficients of the
rows into coefficients at the points, so the representer of any observation is again Σ K(x, z) a.
"""

import abc
import math
from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int


class AbstractBlock(eqx.Module):
    """Rows of one kind of observation, as a linear map of the values at its points."""

    of_values: eqx.AbstractClassVar[bool]  # of the potential; else of the field

    points: eqx.AbstractVar[Float[Array, "P d"]]
    noise: eqx.AbstractVar[Float[Array, " D"] | None]  # of each row; None if it is 1

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the components of the field; points (x, u) have d = n + m coordinates."""

    @property
    @abc.abstractmethod
    def values_shape(self) -> tuple[int, ...]:
        """The shape of the values of the field, or of the potential, at all points."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """D, the number of rows."""

    @property
    def scale(self) -> Float[Array, " D"]:
        """The relative noise of each row; the row is divided by its noise."""
        return jnp.ones(self.size, self.points.dtype) if self.noise is None else self.noise

    @property
    def count(self) -> int:
        """The number of observations in this block; N is the sum over the blocks."""
        return self.size

    def labels(self) -> Int[np.ndarray, " D"]:
        """The index of the observation of each row, from 0 to `count` − 1."""
        return np.arange(self.count)

    @abc.abstractmethod
    def rows(self, values: Float[Array, "P *rest"]) -> Float[Array, "D *below"]:
        """The rows of a field, (P, n, …) -> (D, …), or of a potential, (P, …) -> (D, …)."""

    @abc.abstractmethod
    def coefficients(self, c: Float[Array, " D"]) -> Float[Array, "P *n"]:
        """The transpose of `rows`."""

    @abc.abstractmethod
    def merge(self, following: "AbstractBlock") -> "AbstractBlock | None":
        """One block of the rows here, then the rows of `following`; None if the kinds differ."""

    @abc.abstractmethod
    def with_points(self, points: Float[Array, "P d"]) -> "AbstractBlock":
        """All components of the field, or the potential, at other points, without noise."""

    @abc.abstractmethod
    def subset(self, chosen: Int[np.ndarray, " C"]) -> "Subset":
        """The block of the observations `chosen`, indices from 0 in increasing order.

        Returns:
            The new block, the indices of its rows in this block, and the indices of the
            observations of these rows.
        """


class Components(AbstractBlock):
    """Components of the field at points.

    Attributes:
        kept: the rows that were measured, as indices into all P·n, shape (D,); None if all were.
        noise: the relative noise of each measured row; None if it is 1.
        outputs: the number of components of the field at a point; None if it is the number of
            coordinates. At points (x, u) of a field with inputs it is smaller.
    """

    points: Float[Array, "P n"]
    kept: Int[Array, " D"] | None = None
    noise: Float[Array, " D"] | None = None
    outputs: int | None = eqx.field(static=True, default=None)
    of_values: ClassVar[bool] = False

    @property
    def dimension(self) -> int:
        return self.points.shape[1] if self.outputs is None else self.outputs

    @property
    def values_shape(self) -> tuple[int, int]:
        return len(self.points), self.dimension

    @property
    def size(self) -> int:
        return math.prod(self.values_shape) if self.kept is None else len(self.kept)

    @property
    def count(self) -> int:
        return len(self.points)

    def labels(self) -> Int[np.ndarray, " D"]:
        P, n = self.values_shape
        return (np.arange(P * n) if self.kept is None else np.asarray(self.kept)) // n

    def rows(self, values: Float[Array, "P n *rest"]) -> Float[Array, "D *rest"]:
        rows = values.reshape(math.prod(values.shape[:2]), *values.shape[2:])
        rows = rows if self.kept is None else rows[self.kept]
        return rows if self.noise is None else rows / _broadcast_noise(self.noise, rows)

    def coefficients(self, c: Float[Array, " D"]) -> Float[Array, "P n"]:
        c = c if self.noise is None else c / self.noise
        if self.kept is not None:
            c = jnp.zeros(math.prod(self.values_shape), c.dtype).at[self.kept].set(c)
        return c.reshape(self.values_shape)

    def merge(self, following: AbstractBlock) -> "Components | None":
        if not isinstance(following, Components) or self.outputs != following.outputs:
            return None
        kept = None
        sizes = [math.prod(block.values_shape) for block in (self, following)]
        if self.kept is not None or following.kept is not None:
            first_kept, second_kept = (
                jnp.arange(size) if b.kept is None else b.kept
                for b, size in zip((self, following), sizes, strict=True)
            )
            kept = jnp.concatenate([first_kept, second_kept + sizes[0]])
        points = jnp.concatenate([self.points, following.points])
        return Components(points, kept, _join_noise(self, following), self.outputs)

    def with_points(self, points: Float[Array, "P d"]) -> "Components":
        return Components(points, outputs=self.outputs)

    def subset(self, chosen: Int[np.ndarray, " C"]) -> "Subset":
        rows = np.flatnonzero(np.isin(self.labels(), chosen))
        kept = self.kept
        if kept is not None:
            n = self.values_shape[1]
            all_kept = np.asarray(kept)[rows]
            kept = jnp.asarray(np.searchsorted(chosen, all_kept // n) * n + all_kept % n)
        points, noise = _take(self.points, chosen), _take(self.noise, rows)
        return Components(points, kept, noise, self.outputs), rows, chosen


class Combinations(AbstractBlock):
    """The rows Σ_q weights[s, r, q] · f(groups[s, q]): R rows for each of S groups of Q points."""

    groups: Float[Array, "S Q d"]
    weights: Float[Array, "S R Q n"]
    of_values: ClassVar[bool] = False

    @property
    def dimension(self) -> int:
        return self.weights.shape[3]

    @property
    def points(self) -> Float[Array, "SQ d"]:
        return self.groups.reshape(-1, self.groups.shape[2])

    @property
    def values_shape(self) -> tuple[int, int]:
        S, _, Q, n = self.weights.shape
        return S * Q, n

    @property
    def size(self) -> int:
        return self.weights.shape[0] * self.weights.shape[1]

    @property
    def noise(self) -> None:
        return None

    def rows(self, values: Float[Array, "SQ n *rest"]) -> Float[Array, "SR *rest"]:
        rest = values.shape[2:]
        S, R, Q, n = self.weights.shape
        # (S, R, Q n) @ (S, Q n, rest) -> (S, R, rest)
        rows = self.weights.reshape(S, R, Q * n) @ values.reshape(S, Q * n, -1)
        return rows.reshape(S * R, *rest)

    def coefficients(self, c: Float[Array, " SR"]) -> Float[Array, "SQ n"]:
        S, R, Q, n = self.weights.shape
        return jnp.einsum("srqa,sr->sqa", self.weights, c.reshape(S, R)).reshape(S * Q, n)

    def merge(self, following: AbstractBlock) -> "Combinations | None":
        shape = self.weights.shape[1:]
        if not isinstance(following, Combinations) or following.weights.shape[1:] != shape:
            return None
        pairs = (self.groups, following.groups), (self.weights, following.weights)
        return Combinations(*map(jnp.concatenate, pairs))

    def with_points(self, points: Float[Array, "P d"]) -> Components:
        return Components(points, outputs=self.weights.shape[3])

    def subset(self, chosen: Int[np.ndarray, " C"]) -> "Subset":
        # Groups are chosen completely, since all rows of a group share its points.
        R = self.weights.shape[1]
        groups = np.unique(chosen // R)
        rows = (groups[:, None] * R + np.arange(R)).reshape(-1)
        arrays = {"groups": _take(self.groups, groups), "weights": _take(self.weights, groups)}
        return Combinations(**arrays), rows, rows


class Values(AbstractBlock):
    """The potential at points; `noise` is the relative noise of each value, None if it is 1.

    At points (x, u) it is the potential of the drift, and u has no effect.
    """

    points: Float[Array, "E d"]
    noise: Float[Array, " E"] | None = None
    outputs: int | None = eqx.field(static=True, default=None)
    of_values: ClassVar[bool] = True

    @property
    def values_shape(self) -> tuple[int]:
        return (len(self.points),)

    @property
    def dimension(self) -> int:
        return self.points.shape[1] if self.outputs is None else self.outputs

    @property
    def size(self) -> int:
        return len(self.points)

    def rows(self, values: Float[Array, "E *rest"]) -> Float[Array, "E *rest"]:
        return values if self.noise is None else values / _broadcast_noise(self.noise, values)

    def coefficients(self, c: Float[Array, " E"]) -> Float[Array, " E"]:
        return c if self.noise is None else c / self.noise

    def merge(self, following: AbstractBlock) -> "Values | None":
        if not isinstance(following, Values):
            return None
        points = jnp.concatenate([self.points, following.points])
        return Values(points, _join_noise(self, following), self.outputs)

    def with_points(self, points: Float[Array, "E d"]) -> "Values":
        return Values(points, outputs=self.outputs)

    def subset(self, chosen: Int[np.ndarray, " C"]) -> "Subset":
        points, noise = _take(self.points, chosen), _take(self.noise, chosen)
        return Values(points, noise, self.outputs), chosen, chosen


def _take(array: Array | None, index: Int[np.ndarray, " C"]) -> Any:
    """The entries array[index], by NumPy, since JAX would compile for every number of entries."""
    if array is None or isinstance(array, Tracer):
        return None if array is None else array[index]
    return jnp.asarray(np.asarray(array)[index])


Subset = tuple[AbstractBlock, Int[np.ndarray, " rows"], Int[np.ndarray, " observations"]]


def merge(blocks: Iterable[AbstractBlock]) -> tuple[AbstractBlock, ...]:
    """The same rows, with neighbours of one kind merged, since fewer blocks compile faster."""
    groups: list[AbstractBlock] = []
    for block in blocks:
        both = groups[-1].merge(block) if groups else None
        groups = [*groups[:-1], both] if both is not None else [*groups, block]
    return tuple(groups)


def _join_noise(first: AbstractBlock, second: AbstractBlock) -> Float[Array, " D"] | None:
    """The noise of the rows of both blocks; None if all of it is 1."""
    if first.noise is None and second.noise is None:
        return None
    return jnp.concatenate([first.scale, second.scale])


def _broadcast_noise(noise: Float[Array, " D"], rows: Float[Array, "D *rest"]) -> Array:
    return noise.reshape(-1, *[1] * (rows.ndim - 1))
