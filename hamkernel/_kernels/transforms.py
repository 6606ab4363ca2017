"""Scalar kernels on transformed points: warped, selected, and averaged over a group."""

import operator
from collections.abc import Callable, Sequence
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
    ScalarSum,
    Scaled,
    as_scalar_kernel,
    one_point,
)
from hamkernel._kernels.functions import as_pytree

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
        maps: the linear maps g of the group, each (n,) -> (n,).
        characters: χ(g) = ±1 for each map.
        one_sided: whether k(gx, gz) = k(x, z) is known to hold for all g.

    Source: Krejník & Tyutin (2012) for the odd kernel k(x, z) − k(−x, z); the two-sided mean is
    the projection of the feature map onto the functions with the symmetry.
    """

    kernel: AbstractScalarKernel
    maps: tuple[Callable[[Array], Array], ...] = eqx.field(static=True)
    characters: tuple[float, ...] = eqx.field(static=True)
    one_sided: bool = eqx.field(static=True)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        group = tuple(zip(self.maps, self.characters, strict=True))
        left = group[:1] if self.one_sided else group
        pairs = [(g, h, a * b) for g, a in left for h, b in group]
        values = [sign * self.kernel(g(x), h(z)) for g, h, sign in pairs]
        return sum(values[1:], start=values[0]) / len(values)

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
        if self.parity is not None:  # whose maps mix no coordinates
            return self.kernel.supports(n)
        return (frozenset(range(n)),)


def without_symmetry(tree: T) -> T:
    """A kernel, or what holds some, before the terms of odd and even ones cancel: what rounds.

    (k(x, z) − k(−x, z))/2 of a long lengthscale is the small difference of large numbers.
    """

    def is_mean(node: object) -> bool:
        return isinstance(node, Symmetrised)

    return jax.tree.map(lambda node: node.kernel if is_mean(node) else node, tree, is_leaf=is_mean)


def identity(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The neutral element of every group of maps."""
    return x


def reflection(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The map x -> −x."""
    return -x


def with_parity(kernel: AbstractScalarKernel, parity: int) -> AbstractScalarKernel:
    """The kernel of the even (parity +1) or odd (−1) functions of the RKHS of `kernel`.

    The group is {1, −1}. A sum is symmetrised term by term, so that its terms stay visible.

    Raises:
        ValueError: a term has the other parity already, so that only zero is left of it.
    """
    if isinstance(kernel, Symmetrised) and kernel.parity is not None:
        if kernel.parity != parity:
            raise ValueError("Odd(Even(K)) and Even(Odd(K)) have no fields but zero: choose one.")
        return kernel
    if isinstance(kernel, ScalarSum):
        return ScalarSum(tuple(with_parity(k, parity) for k in kernel.terms))
    if isinstance(kernel, Scaled):
        return eqx.tree_at(lambda s: s.kernel, kernel, with_parity(kernel.kernel, parity))
    if isinstance(kernel, Select):
        return eqx.tree_at(lambda s: s.kernel, kernel, with_parity(kernel.kernel, parity))
    return Symmetrised(
        kernel,
        maps=(identity, reflection),
        characters=(1.0, float(parity)),
        one_sided=Invariance.REFLECTION in kernel.invariance,
    )


class _ParityRemoved(NamedTuple):
    kernel: AbstractScalarKernel
    parity: int
    one_sided: bool


def parity_removed(kernel: AbstractScalarKernel) -> _ParityRemoved | None:
    """The k and the parity of which `kernel` is `with_parity`, or None.

    Where it is one-sided, it is (k(x, z) + parity k(x, −z))/2.
    """
    if isinstance(kernel, Symmetrised) and kernel.parity is not None:
        return _ParityRemoved(kernel.kernel, kernel.parity, kernel.one_sided)
    if isinstance(kernel, Scaled | Select):
        inner = parity_removed(kernel.kernel)
        return inner and inner._replace(
            kernel=eqx.tree_at(lambda s: s.kernel, kernel, inner.kernel)
        )
    if isinstance(kernel, ScalarSum):
        found = [parity_removed(term) for term in kernel.terms]
        known = [each for each in found if each is not None]
        parities = {each.parity for each in known}
        if len(known) == len(found) and len(parities) == 1:
            terms = ScalarSum(tuple(each.kernel for each in known))
            return _ParityRemoved(terms, parities.pop(), all(each.one_sided for each in known))
    return None
