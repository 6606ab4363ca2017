"""Scalar kernels on transformed points: warped, selected, and averaged over a group."""

import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Invariance,
    ScalarProduct,
    ScalarSum,
    Scaled,
    as_scalar_kernel,
    one_point,
)
from hamkernel._kernels.functions import as_pytree
from hamkernel._kernels.groups import (
    Element,
    LinearMap,
    closed,
    identity,
    matrix_of,
    pairs,
    reflection,
)
from hamkernel._kernels.unchanged import known_unchanged
from hamkernel._show import call, text

T = TypeVar("T")


class Warp(AbstractScalarKernel):
    """k(fn(x), fn(z)): a kernel on warped coordinates, such as an angle as (cos, sin).

    Args:
        kernel: a scalar kernel on the warped coordinates, shape (m,).
        fn: a smooth map (n,) -> (m,), written with jax.numpy; the array leaves of an Equinox
            module are trained. Define it once: a lambda made anew for each kernel is another
            function to JAX, and compiles anew.

    Raises:
        TypeError: `kernel` is no scalar kernel, or `fn` no function. ValueError, when called: `fn`
            returns no vector.

    Example: `Warp(Gaussian(1.0), lambda x: jnp.array([jnp.cos(x[0]), jnp.sin(x[0]), x[1]]))`
    for a state (angle, momentum) on a cylinder.
    """

    kernel: AbstractScalarKernel
    fn: Callable[[Float[Array, " n"]], Any]

    def __init__(self, kernel: Any, fn: Callable[[Array], Array | Sequence[Array]]):
        if not callable(fn) or isinstance(fn, AbstractScalarKernel):
            raise TypeError(
                f"Warp needs a kernel and then a map (n,) -> (m,), Warp(k, fn); got {fn!r} as map."
            )
        self.kernel = as_scalar_kernel(kernel)
        self.fn = as_pytree(fn)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return self.kernel(self.warped(x), self.warped(z))

    def warped(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """fn(x), as a vector."""
        x = one_point(x)
        warped = self.fn(x)
        warped = jnp.stack(warped) if isinstance(warped, list | tuple) else warped
        if jnp.ndim(warped) != 1:
            raise ValueError(
                f"the map of Warp returned shape {jnp.shape(warped)} for a point of shape "
                f"{jnp.shape(x)}; a vector (m,) is needed. Return, for example, jnp.array([...])."
            )
        # The map's parameters may be more precise than the data.
        return require.floating(warped, "the value of the map of Warp").astype(x.dtype)

    @property
    def invariance(self) -> Invariance:
        return Invariance.NONE

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        return (frozenset(range(n)),)


class Select(AbstractScalarKernel):
    """k(x[dims], z[dims]): a kernel on some of the coordinates.

    `Select(k, (0, 1)) + Select(k, (2, 3))` is the kernel of H(q, p) = U(q) + T(p) for two
    degrees of freedom.

    Args:
        kernel: a scalar kernel on len(dims) coordinates.
        dims: distinct coordinates, integers ≥ 0.

    Raises:
        TypeError: `kernel` is no scalar kernel. ValueError: `dims` are no such coordinates, or,
            when called, the points have none of that number.
    """

    kernel: AbstractScalarKernel
    dims: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, kernel: Any, dims: Any):
        self.kernel = as_scalar_kernel(kernel)
        try:
            self.dims = tuple(operator.index(d) for d in np.atleast_1d(dims))
        except TypeError:
            self.dims = ()
        if not self.dims or min(self.dims) < 0 or len(set(self.dims)) < len(self.dims):
            raise ValueError(
                "Select needs distinct coordinates, integers >= 0, such as Select(k, (0, 1)); got "
                f"{dims!r}."
            )

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return self.kernel(self._selected(x), self._selected(z))

    def _selected(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        x = one_point(x)
        if max(self.dims) >= len(x):
            raise ValueError(
                f"Select has coordinates {self.dims} and the point has {len(x)}: "
                "coordinates are counted from 0."
            )
        # Slices, not a gather: their derivative is a pad, which XLA fuses into its neighbours.
        first, last = self.dims[0], self.dims[-1]
        if self.dims == tuple(range(first, last + 1)):
            return x[first : last + 1]
        return jnp.concatenate([x[d : d + 1] for d in self.dims])

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        inner = self.kernel.supports(len(self.dims))
        return tuple(frozenset(self.dims[i] for i in support) for support in inner)


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
        one_sided: whether k(gx, gz) = k(x, z) is known to hold for all g; if None, that is found
            out once the dimension is known.

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
        return all(known_unchanged(self.kernel, matrix_of(each, n)) for each in self.maps)

    @property
    def parity(self) -> int | None:
        """±1 with u(−x) = ±u(x), where the group is {1, −1}; None for other groups."""
        if set(self.maps) != {identity, reflection}:
            return None
        return int(self.characters[self.maps.index(reflection)])

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
    """A kernel, or what holds some, before the terms of odd and even ones cancel: what rounds.

    (k(x, z) − k(−x, z))/2 of a long lengthscale is the small difference of large numbers.
    """

    def is_mean(node: object) -> bool:
        return isinstance(node, Symmetrised)

    return jax.tree.map(lambda node: node.kernel if is_mean(node) else node, tree, is_leaf=is_mean)


def _name_of(given: LinearMap) -> str:
    return text(given) if callable(given) else f"{len(given)} by {len(given)} matrix"


@known_unchanged.register
def _(k: Select, S) -> bool:
    inside = list(k.dims)
    outside = [i for i in range(len(S)) if i not in inside]
    apart = not S[np.ix_(inside, outside)].any()
    return apart and known_unchanged(k.kernel, S[np.ix_(inside, inside)])


def symmetrised(
    kernel: AbstractScalarKernel, maps: tuple[LinearMap, ...], characters: tuple[float, ...]
) -> AbstractScalarKernel:
    """The kernel of the functions u(gx) = χ(g) u(x) of the RKHS of `kernel`, g in the maps.

    A sum is symmetrised term by term, so that its terms stay visible, and what has a symmetry
    already gets the group of both.

    Raises:
        ValueError: a map has the other sign already, so that only zero is left.
    """
    if isinstance(kernel, ScalarSum):
        return ScalarSum(tuple(symmetrised(k, maps, characters) for k in kernel.terms))
    reflects = set(maps) <= {identity, reflection}  # which the coordinates of a Select do, too
    if isinstance(kernel, Scaled) or (isinstance(kernel, Select) and reflects):
        inner = symmetrised(kernel.kernel, maps, characters)
        return eqx.tree_at(lambda k: k.kernel, kernel, inner)
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
    """The kernel of which another one is the mean over a group."""

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
    if isinstance(kernel, Scaled | Select):
        inner = symmetry_removed(kernel.kernel)
        if inner is None or (isinstance(kernel, Select) and inner.parity is None):
            return None
        return inner._replace(kernel=eqx.tree_at(lambda k: k.kernel, kernel, inner.kernel))
    if isinstance(kernel, ScalarSum):
        found = [symmetry_removed(term) for term in kernel.terms]
        known = [each for each in found if each is not None]
        means = tuple(mean for each in known for mean in each.means)
        if len(known) == len(found) and len({(m.maps, m.characters) for m in means}) == 1:
            return Removed(ScalarSum(tuple(each.kernel for each in known)), means)
    return None


def symmetries(kernel: AbstractScalarKernel) -> Iterator[Symmetrised]:
    """The groups over which terms of the kernel are means, in the coordinates of the states."""
    if isinstance(kernel, Symmetrised):
        yield kernel
    elif isinstance(kernel, Scaled):
        yield from symmetries(kernel.kernel)
    elif isinstance(kernel, ScalarSum | ScalarProduct):
        for term in kernel.terms:
            yield from symmetries(term)
