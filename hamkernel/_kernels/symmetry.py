"""Scalar kernels averaged over a finite group of linear maps."""

from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.arguments import one_point
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, ScalarProduct
from hamkernel._kernels.groups import (
    Element,
    LinearMap,
    closed,
    identity,
    matrix_of,
    pairs,
    reflection,
)
from hamkernel._show import call, text

T = TypeVar("T")


class Symmetrised(AbstractScalarKernel):
    """The mean of k over a finite group of linear maps.

    k_G(x, z) is the mean over g and h of χ(g) χ(h) k(gx, hz), and its functions obey
    u(gx) = χ(g) u(x). This mean over both arguments is symmetric and positive for EVERY k. Where
    k(gx, gz) = k(x, z) one side is enough, k_G(x, z) = mean over g of χ(g) k(x, gz); without that
    property the one-sided mean is not even symmetric.

    Args:
        kernel: the scalar kernel k.
        maps: linear maps that generate the group, functions (n,) -> (n,) or the rows of matrices.
        characters: χ(g) = ±1 for each map.
        one_sided: whether k(gx, gz) = k(x, z) for all g; None to find out once the dimension is
            known.

    Source: Krejník & Tyutin (2012) for the odd kernel k(x, z) − k(−x, z); the two-sided mean is
    the projection of the feature map onto the functions with the symmetry.
    """

    kernel: AbstractScalarKernel
    maps: tuple[LinearMap, ...] = eqx.field(static=True)
    characters: tuple[float, ...] = eqx.field(static=True)
    one_sided: bool | None = eqx.field(static=True, default=None)

    def __repr__(self) -> str:
        names = [_name_of(each) for each in self.maps if each is not identity]
        if self.parity is not None:  # a structure says Odd or Even of itself
            return call("Symmetrised", [repr(self.kernel), f"parity={self.parity}"])
        return call("Invariant", [repr(self.kernel), f"[{', '.join(names)}]"])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        x, z = one_point(x), one_point(z)
        terms = pairs(self.group(len(x)), self.is_one_sided(len(x)))
        values = [sign * self.kernel(g(x), h(z)) for g, h, sign in terms]
        return sum(values[1:], start=values[0]) / len(values)

    def group(self, n: int) -> tuple[Element, ...]:
        """All maps of the group on states of n coordinates, the identity first."""
        return closed(self.maps, self.characters, n)

    def is_one_sided(self, n: int) -> bool:
        """Whether k(gx, gz) = k(x, z) is known to hold for all g."""
        if self.one_sided is not None:
            return self.one_sided
        return all(self.kernel.is_unchanged_by(matrix_of(each, n)) for each in self.maps)

    @property
    def parity(self) -> int | None:
        """±1 with u(−x) = ±u(x), where the group is {1, −1}; None for other groups."""
        if set(self.maps) != {identity, reflection}:
            return None
        return int(self.characters[self.maps.index(reflection)])

    @property
    def has_amplitude(self) -> bool:
        return self.kernel.has_amplitude

    @property
    def invariance(self) -> Invariance:
        return Invariance.REFLECTION & self.kernel.invariance

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        inner = self.kernel.supports(n)
        if self.parity is not None:  # whose maps mix no coordinates
            return inner
        group = self.group(n)
        return tuple(
            frozenset(
                j for g in group for i in support for j in np.flatnonzero(g.matrix[i]).tolist()
            )
            for support in inner
        )


def without_symmetry(tree: T) -> T:
    """The tree with every mean over a group replaced by its kernel: the size of what rounds.

    (k(x, z) − k(−x, z))/2 of a long lengthscale is the small difference of large numbers.
    """

    def is_mean(node: object) -> bool:
        return isinstance(node, Symmetrised)

    return jax.tree.map(lambda node: node.kernel if is_mean(node) else node, tree, is_leaf=is_mean)


def _name_of(given: LinearMap) -> str:
    return text(given) if callable(given) else f"{len(given)} by {len(given)} matrix"


def symmetrised(
    kernel: AbstractScalarKernel, maps: tuple[LinearMap, ...], characters: tuple[float, ...]
) -> AbstractScalarKernel:
    """The kernel of the functions u(gx) = χ(g) u(x) of the RKHS of `kernel`, g in the maps.

    A sum is symmetrised term by term, so that its terms stay visible; a kernel with a symmetry
    gets the group of both.

    Raises:
        ValueError: a map has the other sign already, so that only zero is left.
    """
    reflects = set(maps) <= {identity, reflection}
    if kernel.summands(reflects):
        inner = tuple(symmetrised(k, maps, characters) for k in kernel.summands(reflects))
        return eqx.tree_at(lambda k: k.summands(reflects), kernel, inner)
    if isinstance(kernel, Symmetrised):
        known = dict(zip(kernel.maps, kernel.characters, strict=True))
        given = dict(zip(maps, characters, strict=True))
        if any(known.get(each, sign) != sign for each, sign in given.items()):
            raise ValueError("Odd(Even(K)) and Even(Odd(K)) have no fields but zero: choose one.")
        if given.keys() <= known.keys():
            return kernel
        both = known | given
        return Symmetrised(kernel.kernel, tuple(both), tuple(both.values()))
    known = Invariance.REFLECTION in kernel.invariance if reflects else None
    return Symmetrised(kernel, maps, characters, known)


def with_parity(kernel: AbstractScalarKernel, parity: int) -> AbstractScalarKernel:
    """The kernel of the even (parity +1) or odd (−1) functions of the RKHS of `kernel`.

    The group is {1, −1}.

    Raises:
        ValueError: a term has the other parity already, so that only zero is left of it.
    """
    return symmetrised(kernel, (identity, reflection), (1.0, float(parity)))


class Removed(NamedTuple):
    """A kernel, and the means over a group that were taken off it."""

    kernel: AbstractScalarKernel
    means: tuple[Symmetrised, ...]  # over one group; the terms of a sum have one each

    @property
    def parity(self) -> int | None:
        return self.means[0].parity

    def group(self, n: int) -> tuple[Element, ...]:
        return self.means[0].group(n)

    def is_one_sided(self, n: int) -> bool:
        return all(mean.is_one_sided(n) for mean in self.means)


def symmetry_removed(kernel: AbstractScalarKernel) -> Removed | None:
    """The k and the group of which `kernel` is `symmetrised`, or None.

    Where all of it is one-sided, it is the mean over h of χ(h) k(x, hz).
    """
    if isinstance(kernel, Symmetrised):
        return Removed(kernel.kernel, (kernel,))
    found = [symmetry_removed(k) for k in kernel.summands(True)]
    known = [each for each in found if each is not None]
    means = tuple(mean for each in known for mean in each.means)
    if len(known) < len(found) or len({(mean.maps, mean.characters) for mean in means}) != 1:
        return None
    reflects = means[0].parity is not None
    if not kernel.summands(reflects):
        return None
    inner = tuple(each.kernel for each in known)
    return Removed(eqx.tree_at(lambda k: k.summands(reflects), kernel, inner), means)


def symmetries(kernel: AbstractScalarKernel) -> Iterator[Symmetrised]:
    """All means over groups in a kernel, in the coordinates of the states."""
    if isinstance(kernel, Symmetrised):
        yield kernel
    terms = kernel.terms if isinstance(kernel, ScalarProduct) else kernel.summands(False)
    for term in terms:
        yield from symmetries(term)
