"""Finite groups of linear maps of the states, from a few of their elements.

A map is a function (n,) -> (n,) or an (n, n) array, kept as nested tuples so that kernels stay
hashable. The group is closed once the dimension is known.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require

# A function, or the rows of a matrix.
LinearMap = Callable[[Array], Array] | tuple[tuple[float, ...], ...]

MOST = 64  # elements of a group; the largest point group of space, that of the cube, has 48
_SAME = 1e-8  # far above the rounding of 64 products, far below the steps of a group of 64


def identity(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The neutral element of every group of maps."""
    return x


def reflection(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The map x -> −x."""
    return -x


def time_reversal(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The map (q, p) -> (q, −p)."""
    q, p = jnp.split(x, 2)
    return jnp.concatenate([q, -p])


class Element(NamedTuple):
    """One map of a group, and the sign χ by which functions change under it."""

    matrix: Float[np.ndarray, "n n"]
    character: float

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """S x, without a product where S only changes signs."""
        signs = np.diagonal(self.matrix)
        if np.array_equal(self.matrix, np.diag(signs)):
            if (signs == 1).all():
                return x
            return -x if (signs == -1).all() else x * jnp.asarray(signs, x.dtype)
        return jnp.asarray(self.matrix, x.dtype) @ x


def linear_maps(maps: Any) -> tuple[LinearMap, ...]:
    """The generators of a group, a list of arrays and functions.

    Raises:
        TypeError: `maps` is no list of maps. ValueError: a matrix is not square, finite and
            invertible.
    """
    single = callable(maps) or getattr(maps, "ndim", None) == 2
    given: Any = [maps] if single else maps
    if not isinstance(given, Sequence | np.ndarray | jax.Array) or len(given) == 0:
        raise TypeError(
            "maps must be a list of linear maps of the state, (n, n) arrays or functions "
            f"x -> S @ x; got {maps!r}."
        )
    rows: Any = tuple(each if callable(each) else _rows(each) for each in given)
    return rows


def _rows(matrix: Any) -> tuple[tuple[float, ...], ...]:
    require.floating(matrix, "a map")
    array = np.asarray(matrix, float)  # all digits, also where JAX would keep those of float32
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not np.isfinite(array).all():
        raise ValueError(
            f"a map has shape {array.shape}; a finite matrix (n, n) or a linear function x -> S @ x"
            " is needed."
        )
    return tuple(tuple(row) for row in array.tolist())


@functools.lru_cache(maxsize=1024)
def matrix_of(given: LinearMap, n: int) -> Float[np.ndarray, "n n"]:
    """The matrix of a map on states of n coordinates.

    Raises:
        ValueError: it is for states of another dimension, or a function is not linear.
    """
    if not callable(given):
        if len(given) != n:
            raise ValueError(
                f"a map of the symmetry is a {len(given)} by {len(given)} matrix and the states "
                f"have {n} coordinates."
            )
        return np.asarray(given)
    with jax.ensure_compile_time_eval():
        basis = np.eye(n)
        columns = [np.asarray(given(jnp.asarray(e)), float) for e in basis]
        probe = np.cos(1.0 + np.arange(n))  # no symmetry of its own
        image = np.asarray(given(jnp.asarray(probe)), float)
    if any(column.shape != (n,) for column in columns):
        raise ValueError(
            f"a map of the symmetry takes a state of shape ({n},) to shape {columns[0].shape}; a "
            "linear map (n,) -> (n,) is needed."
        )
    matrix = np.stack(columns, axis=1)
    if not np.allclose(matrix @ probe, image, rtol=1e-5, atol=1e-5):  # float32 without x64
        raise ValueError("a map of the symmetry is not linear: f(x) differs from the sum of f(eᵢ).")
    return matrix


@functools.lru_cache(maxsize=1024)
def closed(
    maps: tuple[LinearMap, ...], characters: tuple[float, ...], n: int
) -> tuple[Element, ...]:
    """The group that the maps generate on states of n coordinates, the identity first.

    Raises:
        ValueError: a map is not invertible; there are more than 64 elements; or one of them comes
            with both signs, so that zero is the only function with the symmetry.
    """
    generators = [
        Element(_clean(matrix_of(each, n)), sign)
        for each, sign in zip(maps, characters, strict=True)
    ]
    for g in generators:
        if abs(np.linalg.det(g.matrix)) < _SAME:
            raise ValueError(
                "a map of the symmetry is not invertible, so it is no element of a group: "
                f"S = {np.round(g.matrix, 3).tolist()}. To ignore a coordinate use Select(k, dims)."
            )
    group = [Element(np.eye(n), 1.0)]
    for known in group:  # which grows
        for g in generators:
            new = Element(_clean(g.matrix @ known.matrix), g.character * known.character)
            found = [e for e in group if np.abs(e.matrix - new.matrix).max() < _SAME]
            if found and found[0].character != new.character:
                raise ValueError(
                    "no function but zero has all these symmetries: a product of the maps is the "
                    "identity, or another product, and would change the sign. Choose fewer."
                )
            if not found:
                group.append(new)
            if len(group) > MOST:
                raise ValueError(
                    f"the maps generate more than {MOST} others, so they do not close to a finite "
                    "group of use here. Rotations must be by 2π over a whole number; a continuous "
                    "symmetry cannot be averaged over so. Give the (n, n) matrices all digits."
                )
    return tuple(group)


def _clean(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The matrix with entries within rounding of a whole number replaced by it."""
    whole = np.round(matrix)
    return np.where(np.abs(matrix - whole) < 1e-14, whole, matrix) + 0.0


def pairs(group: tuple[Element, ...], one_sided: bool) -> list[tuple[Element, Element, float]]:
    """The g, h and χ(g)χ(h) of the terms χ(g) χ(h) k(gx, hz) of a mean over the group."""
    left = group[:1] if one_sided else group
    return [(g, h, g.character * h.character) for g, h in itertools.product(left, group)]


def is_orthogonal(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S keeps distances and dot products."""
    return bool(np.abs(S @ S.T - np.eye(len(S))).max() < _SAME)


def is_diagonal(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S takes every coordinate to a multiple of itself."""
    return bool(np.abs(S - np.diag(np.diagonal(S))).max() < _SAME)


def is_permutation(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S permutes the coordinates, up to signs."""
    return is_orthogonal(S) and bool(np.abs(np.abs(S) - np.round(np.abs(S))).max() < _SAME)
