"""Finite groups of linear maps of the states, and scalar kernels averaged over them.

A map is a function (n,) -> (n,) or an (n, n) array. We keep arrays as nested tuples, so that
kernels stay hashable, and generate the group once the dimension is known.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Descriptor,
    Invariance,
    ScalarProduct,
    Spectrum,
    one_point,
)
from hamkernel._kernels.transforms import Warp
from hamkernel._show import call, text

# A function (n,) -> (n,), or the rows of a matrix.
LinearMap = Callable[[Array], Array] | tuple[tuple[float, ...], ...]

# Two maps are equal to this tolerance, far above the rounding of 64 products and far below the
# distance of two elements of a group of 64.
_SAME_MAP = 1e-8


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
    """A map S of a group and its sign χ: functions obey u(Sx) = χ u(x)."""

    matrix: Float[np.ndarray, "n n"]
    character: float

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The image S x, without a matrix product if S only changes signs."""
        signs = np.diagonal(self.matrix)
        if np.array_equal(self.matrix, np.diag(signs)):
            if (signs == 1).all():
                return x
            return -x if (signs == -1).all() else x * jnp.asarray(signs, x.dtype)
        return jnp.asarray(self.matrix, x.dtype) @ x


def linear_maps(maps: Any) -> tuple[LinearMap, ...]:
    """The generators of a group, from an array, a function, or a list of these.

    Raises:
        TypeError: `maps` is neither a map nor a list of maps.
        ValueError: a matrix is not square and finite.
    """
    single = callable(maps) or getattr(maps, "ndim", None) == 2
    generators: Any = [maps] if single else maps
    if not isinstance(generators, Sequence | np.ndarray | jax.Array) or len(generators) == 0:
        raise TypeError(
            "maps must be a list of linear maps of the state, (n, n) arrays or functions "
            f"x -> S @ x; got {maps!r}."
        )
    rows: Any = tuple(g if callable(g) else _matrix_rows(g) for g in generators)
    return rows


def _matrix_rows(matrix: Any) -> tuple[tuple[float, ...], ...]:
    require.floating(matrix, "a map")
    array = np.asarray(matrix, float)  # all digits, even if JAX uses float32
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not np.isfinite(array).all():
        raise ValueError(
            f"a map has shape {array.shape}; a finite matrix (n, n) or a linear function x -> S @ x"
            " is needed."
        )
    return tuple(tuple(row) for row in array.tolist())


@functools.lru_cache(maxsize=1024)
def matrix_of(linear_map: LinearMap, n: int) -> Float[np.ndarray, "n n"]:
    """The matrix of a map on states of n coordinates.

    Raises:
        ValueError: the map is for states of another dimension, or a function is not linear.
    """
    if not callable(linear_map):
        if len(linear_map) != n:
            raise ValueError(
                f"a map of the symmetry is a {_name_of(linear_map)} and the states have {n} "
                "coordinates."
            )
        return np.asarray(linear_map)
    with jax.ensure_compile_time_eval():
        basis = np.eye(n)
        columns = [np.asarray(linear_map(jnp.asarray(e)), float) for e in basis]
        probe = np.cos(1.0 + np.arange(n))  # a generic state
        image = np.asarray(linear_map(jnp.asarray(probe)), float)
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
def close_group(
    maps: tuple[LinearMap, ...], characters: tuple[float, ...], n: int
) -> tuple[Element, ...]:
    """The group that the maps generate on states of n coordinates, the identity first.

    Raises:
        ValueError: a map is not invertible, there are more than 64 elements, or an element has both
            signs, so that zero is the only function with the symmetry.
    """
    generators = [
        Element(_clean(matrix_of(g, n)), sign) for g, sign in zip(maps, characters, strict=True)
    ]
    for g in generators:
        if abs(np.linalg.det(g.matrix)) < _SAME_MAP:
            raise ValueError(
                "a map of the symmetry is not invertible, so it is no element of a group: "
                f"S = {np.round(g.matrix, 3).tolist()}. To ignore a coordinate use Select(k, dims)."
            )
    group = [Element(np.eye(n), 1.0)]
    for element in group:  # the list grows inside the loop
        for g in generators:
            new = Element(_clean(g.matrix @ element.matrix), g.character * element.character)
            equal = [e for e in group if np.abs(e.matrix - new.matrix).max() < _SAME_MAP]
            if equal and equal[0].character != new.character:
                raise ValueError(
                    "only the zero function has all these symmetries: two products of the maps are "
                    "the same map, with opposite signs. Choose fewer symmetries."
                )
            if not equal:
                group.append(new)
            if len(group) > 64:  # the point group of the cube has 48
                raise ValueError(
                    "the maps generate more than 64 others, so they do not close to a finite group "
                    "that this library averages over. A rotation must be by 2π over a whole "
                    "number, given with all digits. Shears, stretches and continuous symmetries "
                    "generate infinite groups."
                )
    return tuple(group)


def _clean(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The matrix, with entries within rounding of an integer replaced by this integer."""
    integers = np.round(matrix)
    return np.where(np.abs(matrix - integers) < 1e-14, integers, matrix) + 0.0


def pairs(group: tuple[Element, ...], one_sided: bool) -> list[tuple[Element, Element, float]]:
    """The triples (g, h, χ(g)χ(h)) of the terms χ(g) χ(h) k(gx, hz) of a mean over the group."""
    first = group[:1] if one_sided else group
    return [(g, h, g.character * h.character) for g, h in itertools.product(first, group)]


def is_orthogonal(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S is orthogonal, so that it keeps distances and dot products."""
    return bool(np.abs(S @ S.T - np.eye(len(S))).max() < _SAME_MAP)


def is_diagonal(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S is diagonal."""
    return bool(np.abs(S - np.diag(np.diagonal(S))).max() < _SAME_MAP)


def is_permutation(S: Float[np.ndarray, "n n"]) -> bool:
    """Whether S permutes the coordinates, up to signs."""
    return is_orthogonal(S) and bool(np.abs(np.abs(S) - np.round(np.abs(S))).max() < _SAME_MAP)


Tree = TypeVar("Tree")


class Symmetrised(AbstractScalarKernel):
    """The mean of k over a finite group of linear maps.

    k_G(x, z) is the mean over g and h of χ(g) χ(h) k(gx, hz), and its functions obey
    u(gx) = χ(g) u(x). This mean over both arguments is symmetric and positive for EVERY k. If
    k(gx, gz) = k(x, z), it equals the one-sided mean over g of χ(g) k(x, gz). For other k the
    one-sided mean is not even symmetric.

    Args:
        kernel: the scalar kernel k.
        maps: linear maps that generate the group, functions (n,) -> (n,) or the rows of matrices.
        characters: χ(g) = ±1 for each map.
        one_sided: whether k(gx, gz) = k(x, z) for all g; if None, we ask `k.is_unchanged_by` once
            the dimension is known.

    Source: Krejník & Tyutin (2012) for the odd kernel k(x, z) − k(−x, z); the two-sided mean is
    the projection of the feature map onto the functions with the symmetry.
    """

    kernel: AbstractScalarKernel
    maps: tuple[LinearMap, ...] = eqx.field(static=True)
    characters: tuple[float, ...] = eqx.field(static=True)
    one_sided: bool | None = eqx.field(static=True, default=None)

    def __repr__(self) -> str:
        names = [_name_of(g) for g in self.maps if g is not identity]
        if self.parity is not None:  # a structure prints as Odd or Even
            return call("Symmetrised", [repr(self.kernel), f"parity={self.parity}"])
        return call("Invariant", [repr(self.kernel), f"[{', '.join(names)}]"])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        x, z = one_point(x), one_point(z)
        descriptor = self.through_descriptor(len(x))
        if descriptor is not None:
            return descriptor.kernel(descriptor.map(x), descriptor.map(z))
        terms = pairs(self.group(len(x)), self.is_one_sided(len(x)))
        values = [sign * self.kernel(g(x), h(z)) for g, h, sign in terms]
        return sum(values[1:], start=values[0]) / len(values)

    def group(self, n: int) -> tuple[Element, ...]:
        """All maps of the group on states of n coordinates, the identity first."""
        return close_group(self.maps, self.characters, n)

    def through_descriptor(self, n: int) -> Descriptor | None:
        """The mean over permutations of the entries of a warp; None if the warp has none."""
        if not isinstance(self.kernel, Warp):
            return None
        images = [self.kernel.image(matrix_of(g, n)) for g in self.maps]
        if any(image is None for image in images):
            return None
        inner = Symmetrised(self.kernel.kernel, tuple(map(_matrix_rows, images)), self.characters)
        return Descriptor(self.kernel.warp, inner)

    def is_one_sided(self, n: int) -> bool:
        """Whether k(gx, gz) = k(x, z) is known to hold for all g."""
        if self.one_sided is not None:
            return self.one_sided
        return all(self.kernel.is_unchanged_by(matrix_of(g, n)) for g in self.maps)

    @property
    def parity(self) -> int | None:
        """The sign in u(−x) = ±u(x) if the group is {1, −1}; None for other groups."""
        if set(self.maps) != {identity, reflection}:
            return None
        return int(self.characters[self.maps.index(reflection)])

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        inner = self.kernel.spectra(n, count, key, dtype)
        if self.parity is None or any(s.parity == -self.parity for s in inner):
            raise TypeError(
                "RandomFeatures takes one group for all of a structure, around all of its terms: "
                "hk.Odd(K), hk.Reversible(K), hk.Symplectic(hk.Invariant(k1 + k2, maps)). For "
                "others use hk.Cholesky() or hk.Nystrom()."
            )
        return tuple(Spectrum(s.frequencies, s.weights, self.parity) for s in inner)

    @property
    def invariance(self) -> Invariance:
        return Invariance.REFLECTION & self.kernel.invariance

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        inner = self.kernel.supports(n)
        if self.parity is not None:  # the maps do not mix coordinates
            return inner
        group = self.group(n)
        return tuple(
            frozenset(
                j for g in group for i in support for j in np.flatnonzero(g.matrix[i]).tolist()
            )
            for support in inner
        )


def drop_symmetry(tree: Tree) -> Tree:
    """The PyTree with each mean over a group replaced by its scalar kernel.

    The values of the result are as large as the terms of the mean, which determine its rounding
    errors. For a long lengthscale (k(x, z) − k(−x, z))/2 is a small difference of large numbers.
    """

    def is_mean(node: object) -> bool:
        return isinstance(node, Symmetrised)

    return jax.tree.map(lambda node: node.kernel if is_mean(node) else node, tree, is_leaf=is_mean)


def _name_of(linear_map: LinearMap) -> str:
    return (
        text(linear_map)
        if callable(linear_map)
        else f"{len(linear_map)} by {len(linear_map)} matrix"
    )


def symmetrise(
    kernel: AbstractScalarKernel, maps: tuple[LinearMap, ...], characters: tuple[float, ...]
) -> AbstractScalarKernel:
    """The kernel of the functions u in the RKHS of `kernel` with u(gx) = χ(g) u(x) for the maps g.

    We symmetrise a sum term by term, so that its terms stay visible. A kernel with a symmetry gets
    the group of all maps.

    Raises:
        ValueError: a map already has the other sign, so that zero is the only function.
    """
    reflects = set(maps) <= {identity, reflection}
    if kernel.summands(reflects):
        inner = tuple(symmetrise(k, maps, characters) for k in kernel.summands(reflects))
        return eqx.tree_at(lambda k: k.summands(reflects), kernel, inner)
    if isinstance(kernel, Symmetrised):
        signs = dict(zip(kernel.maps, kernel.characters, strict=True))
        new = dict(zip(maps, characters, strict=True))
        if any(signs.get(g, sign) != sign for g, sign in new.items()):
            raise ValueError("Odd(Even(K)) and Even(Odd(K)) have no fields but zero: choose one.")
        if new.keys() <= signs.keys():
            return kernel
        all_signs = signs | new
        return _with_closed_group(
            Symmetrised(kernel.kernel, tuple(all_signs), tuple(all_signs.values()))
        )
    one_sided = Invariance.REFLECTION in kernel.invariance if reflects else None
    return _with_closed_group(Symmetrised(kernel, maps, characters, one_sided))


def _with_closed_group(kernel: Symmetrised) -> Symmetrised:
    """The kernel, after a check that its group is finite.

    The check needs the dimension, which we read from a matrix. If all maps are functions, the first
    call of the kernel makes the check.
    """
    matrices = [g for g in kernel.maps if not callable(g)]
    if matrices:
        kernel.group(len(matrices[0]))
    return kernel


def with_parity(kernel: AbstractScalarKernel, parity: int) -> AbstractScalarKernel:
    """The kernel of the even (parity +1) or odd (−1) functions of the RKHS of `kernel`.

    The group is {1, −1}.

    Raises:
        ValueError: a term already has the other parity, so that zero is its only function.
    """
    return symmetrise(kernel, (identity, reflection), (1.0, float(parity)))


class Unsymmetrised(NamedTuple):
    """A scalar kernel k without its symmetry, and the means over a group that we removed."""

    kernel: AbstractScalarKernel
    means: tuple[Symmetrised, ...]  # over one group, one mean for each term of a sum

    @property
    def parity(self) -> int | None:
        return self.means[0].parity

    def group(self, n: int) -> tuple[Element, ...]:
        return self.means[0].group(n)

    def is_one_sided(self, n: int) -> bool:
        return all(mean.is_one_sided(n) for mean in self.means)


def symmetry_removed(kernel: AbstractScalarKernel) -> Unsymmetrised | None:
    """The k and the group with `kernel` = `symmetrise(k, …)`; None if there are none.

    If every mean is one-sided, `kernel` is the mean over h of χ(h) k(x, hz).
    """
    if isinstance(kernel, Symmetrised):
        return Unsymmetrised(kernel.kernel, (kernel,))
    parts = [symmetry_removed(k) for k in kernel.summands(True)]
    unsymmetrised = [part for part in parts if part is not None]
    means = tuple(mean for part in unsymmetrised for mean in part.means)
    if (
        len(unsymmetrised) < len(parts)
        or len({(mean.maps, mean.characters) for mean in means}) != 1
    ):
        return None
    reflects = means[0].parity is not None
    if not kernel.summands(reflects):
        return None
    inner = tuple(part.kernel for part in unsymmetrised)
    return Unsymmetrised(eqx.tree_at(lambda k: k.summands(reflects), kernel, inner), means)


def symmetries(kernel: AbstractScalarKernel) -> Iterator[Symmetrised]:
    """All means over groups in a kernel that act on the coordinates of the states."""
    if isinstance(kernel, Symmetrised):
        yield kernel
    terms = kernel.terms if isinstance(kernel, ScalarProduct) else kernel.summands(False)
    for term in terms:
        yield from symmetries(term)
