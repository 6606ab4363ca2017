"""The base of matrix-valued kernels, their sums, and their symmetries: odd, even, reversible, any.

To impose a symmetry we average the SCALAR kernel inside a structure over the group. If
B(Sx) = ± S B(x) Sᵀ, a potential with u(Sx) = u(x) gives a field with f(Sx) = ± S f(x).
"""

import abc
import functools
import operator
import reprlib
from collections.abc import Iterator
from typing import Any, ClassVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Bounds,
    Descriptor,
    Invariance,
    Point,
    Points,
    as_scalar_kernel,
    bounds_by_value,
    common_invariance,
    one_point,
)
from hamkernel._kernels.symmetry import LinearMap, linear_maps, symmetrise, time_reversal
from hamkernel._machine import full_precision
from hamkernel._show import call, describe, join_terms


class AbstractMatrixKernel(eqx.Module):
    """A positive definite kernel K(x, z) -> (n, n) of fields ℝⁿ -> ℝⁿ."""

    matrix_valued: ClassVar[bool] = True
    takes_inputs: ClassVar[bool] = False  # whether the points are (x, u)
    input_name: ClassVar[str] = "inputs"  # the name of u in `fit`; "parameters" for a family
    # Whether derivatives of the Gram are cheaper in reverse mode, as for some closed forms.
    differentiated_backward: ClassVar[bool] = False
    symplectic: eqx.AbstractVar[bool]  # whether flows conserve dq ∧ dp, as flows of J∇H do
    no_potential: eqx.AbstractVar[str | None]  # the reason why fields have no potential, or None

    @property
    def has_hamiltonian(self) -> bool:
        """Whether the potential is an energy H; the fields need not conserve it."""
        return self.symplectic

    @property
    def conserves(self) -> bool:
        """Whether every field conserves its H."""
        return self.symplectic

    def __repr__(self) -> str:
        return describe(self)

    def __hash__(self) -> int:
        # Arrays have no hash. Equal kernels have equal structure, so we hash the structure.
        return hash(jax.tree.structure(self))

    @abc.abstractmethod
    def form(self, x: Point, u: Point, z: Point, v: Point) -> Float[Array, ""]:
        """The form uᵀ K(x, z) v for one pair of points, shape ()."""

    @full_precision
    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The block K(x, z) for one pair of points, shape (n, n).

        Raises:
            ValueError: x or z is no single point, or the structure does not allow this n.
        """
        x, z = require.one_space(one_point(x)[None], one_point(z)[None])
        x, z = x[0], z[0]
        self.check_dimension(len(x))
        basis = jnp.eye(self.outputs(len(x)), dtype=x.dtype)
        columns = jax.vmap(self.form, in_axes=(None, None, None, 0))
        return jax.vmap(columns, in_axes=(None, 0, None, None))(x, basis, z, basis)

    @abc.abstractmethod
    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        """The field Σⱼ K(x, zⱼ) aⱼ at x, computed without the blocks."""

    def directions(self, Z: Points, A: Points) -> Points:
        """The directions vⱼ along which `expansion` differentiates at zⱼ; A if it does not."""
        return A

    def along(self, x: Point, Z: Points, V: Points) -> Point:
        """The field `expansion(x, Z, A)` for V = `directions(Z, A)`."""
        return self.expansion(x, Z, V)

    def potential(self, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
        """The potential of the field `expansion`; an AttributeError if there is none."""
        raise AttributeError(self.no_potential)

    def potential_covariance(self, x: Point, z: Point) -> Float[Array, ""]:
        """The kernel k of the potential, with K = B ∂x∂zᵀk Bᵀ; an AttributeError if none."""
        raise AttributeError(self.no_potential)

    def check_potential(self) -> None:
        """Raise an AttributeError with the reason if the fields have no potential."""
        if self.no_potential:
            raise AttributeError(self.no_potential)

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        """The power −dH/dt at x for ∇H = `slope`, shape (); for structures with a Hamiltonian."""
        raise AttributeError(self.no_potential)

    def check_dimension(self, n: int) -> None:
        """Raise a ValueError if fields on ℝⁿ cannot have this structure; by default all can."""

    def check_points(self, X: Float[Array, "N d"]) -> None:
        """Raise a ValueError if the structure cannot hold at the points X, which may be traced."""
        self.check_dimension(X.shape[1])

    def centre(self, Z: Float[Array, "M d"]) -> Float[Array, " d"] | None:
        """The mean of Z if K(x − c, z − c) = K(x, z) for all c; else None."""
        return Z.mean(axis=0) if Invariance.TRANSLATION in self.invariance else None

    def blocks(
        self, X: Float[Array, "N n"], Z: Float[Array, "M n"]
    ) -> Float[Array, "N n M n"] | None:
        """The Gram if K has a closed form for many points at once; else None."""
        return None

    def through_descriptor(self, n: int) -> Descriptor | None:
        """The descriptor and the directions of differentiation; None if K has no descriptor."""
        return None

    @property
    def state_kernel(self) -> "AbstractMatrixKernel":
        """The kernel of fields of x alone: K itself, unless its points are (x, u)."""
        return self

    def with_states(self, K: "AbstractMatrixKernel") -> "AbstractMatrixKernel":
        """This kernel with `state_kernel` replaced by K."""
        return K

    def outputs(self, inputs: int) -> int:
        """The number of components of a field at points with `inputs` coordinates."""
        return inputs

    def shares_potential(self, kernel: "AbstractMatrixKernel") -> bool:
        """Whether both kernels apply the same operator to a potential."""
        return False

    @abc.abstractmethod
    def with_parity(self, parity: int) -> "AbstractMatrixKernel":
        """The kernel of the even (+1) or odd (−1) FIELDS with this structure."""

    @abc.abstractmethod
    def average_over(self, maps: tuple[LinearMap, ...]) -> "AbstractMatrixKernel":
        """The kernel of the fields whose potential is invariant under the maps."""

    def bounds(self, name: str, X: Float[np.ndarray, "N d"], amplitude: float) -> Bounds:
        """The lower and upper bound of the array `name`, as `AbstractScalarKernel.bounds`."""
        return bounds_by_value(name, getattr(self, name))

    def transform_inputs(self, X: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "N n"]:
        """The data in the coordinates of the inner kernels."""
        return X

    @property
    @abc.abstractmethod
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """All scalar kernels inside the structure."""

    @property
    @abc.abstractmethod
    def invariance(self) -> Invariance:
        """The transformations of both arguments that leave every block unchanged."""

    def __add__(self, other: Any) -> "Sum":
        if not isinstance(other, AbstractMatrixKernel) or other.takes_inputs:
            return NotImplemented  # kernels of joined points define their sums
        return Sum(self, other)

    def __mul__(self, other: Any) -> Any:
        raise TypeError(
            "a structured kernel cannot be multiplied: scale or multiply the scalar kernel inside, "
            f"{type(self).__name__}(2.0 * k) or {type(self).__name__}(k1 * k2)."
        )

    __rmul__ = __mul__

    def __radd__(self, other: Any) -> "AbstractMatrixKernel":
        return self if isinstance(other, int) and other == 0 else NotImplemented


def nodes_of(kind: type, tree: Any) -> list[Any]:
    """The objects of the type `kind` within a PyTree."""

    def is_node(node: Any) -> bool:
        return isinstance(node, kind)

    return [node for node in jax.tree.leaves(tree, is_leaf=is_node) if is_node(node)]


def total(values: list[Array]) -> Array:
    """The sum of at least one value, without a start of zero."""
    return functools.reduce(operator.add, values)


class Sum(AbstractMatrixKernel):
    """K₁(x, z) + K₂(x, z) + …: fields that are sums of fields with different structures.

    `K1 + K2` numbers its parts; `Sum(conservative=K1, rest=K2)` names them. After a fit,
    `field.part(1)` or `field.part("rest")` is one part alone.

    Args:
        terms: matrix-valued kernels. A sum among them contributes its terms.
        named: matrix-valued kernels with names.

    Raises:
        TypeError: a term is no matrix-valued kernel, or takes inputs or parameters.
        ValueError: there is no term, two terms have the same name, or one has the name
            regularization, which belongs to λ.
    """

    terms: tuple[AbstractMatrixKernel, ...]
    names: tuple[str | None, ...] = eqx.field(static=True)

    def __init__(self, *terms: AbstractMatrixKernel, **named: AbstractMatrixKernel):
        flat: list[tuple[str | None, AbstractMatrixKernel]] = []
        for term in terms:
            is_sum = isinstance(term, Sum)
            flat += zip(term.names, term.terms, strict=True) if is_sum else [(None, term)]
        flat += named.items()
        for _, term in flat:
            if matrix_kernel(term, "a term of a Sum", "Symplectic(k) + CurlFree(k)").takes_inputs:
                raise TypeError(
                    "add the drifts of fields with inputs, Controlled(K1 + K2, …); families add up "
                    "themselves, Family(K1, k1) + Family(K2, k2)."
                )
        names = [name for name, _ in flat if name is not None]
        if "regularization" in names:
            raise ValueError(
                "a part is called regularization, the name of λ in tune: choose another name."
            )
        if not flat or len(set(names)) < len(names):
            raise ValueError(f"Sum needs at least one kernel and distinct names, got {names}.")
        self.terms = tuple(term for _, term in flat)
        self.names = tuple(name for name, _ in flat)

    def __repr__(self) -> str:
        if not any(self.names):
            return join_terms("+", [repr(K) for K in self.terms])
        pairs = zip(self.names, self.terms, strict=True)
        return call("Sum", [f"{name}={K!r}" if name else repr(K) for name, K in pairs])

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return total([K.form(x, u, z, v) for K in self.terms])

    def expansion(self, x: Array, Z: Array, A: Array) -> Float[Array, " n"]:
        return total([K.expansion(x, Z, A) for K in self.terms])

    def potential(self, x: Array, Z: Array, A: Array) -> Float[Array, ""]:
        self.check_potential()
        return total([K.potential(x, Z, A) for K in self.terms])

    def potential_covariance(self, x: Array, z: Array) -> Float[Array, ""]:
        self.check_potential()
        return total([K.potential_covariance(x, z) for K in self.terms])

    @property
    def no_potential(self) -> str | None:
        first, *rest = self._structures()
        if all(first.shares_potential(K) for K in rest):
            return first.no_potential
        names = " + ".join(type(K).__name__ for K in (first, *rest))
        return (
            f"the sum of structures {names} has no single potential: each has another operator. "
            "Ask one part, by position or name: field.part(0).potential(x)."
        )

    def _structures(self) -> Iterator[AbstractMatrixKernel]:
        """All terms, including the terms of inner named sums."""
        for K in self.terms:
            yield from K._structures() if isinstance(K, Sum) else (K,)

    def shares_potential(self, kernel: AbstractMatrixKernel) -> bool:
        return all(K.shares_potential(kernel) for K in self._structures())

    @property
    def symplectic(self) -> bool:
        return all(K.symplectic for K in self.terms)

    @property
    def has_hamiltonian(self) -> bool:
        return self.no_potential is None and all(K.has_hamiltonian for K in self.terms)

    @property
    def conserves(self) -> bool:
        return self.has_hamiltonian and all(K.conserves for K in self.terms)

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        self.check_potential()
        return self.terms[0].dissipated_power(x, slope)

    def check_points(self, X: Float[Array, "N d"]) -> None:
        for K in self.terms:
            K.check_points(X)

    def check_dimension(self, n: int) -> None:
        for K in self.terms:
            K.check_dimension(n)

    def with_parity(self, parity: int) -> "Sum":
        parts = tuple(K.with_parity(parity) for K in self.terms)
        return eqx.tree_at(lambda s: s.terms, self, parts)

    def average_over(self, maps: tuple[LinearMap, ...]) -> "Sum":
        return eqx.tree_at(lambda s: s.terms, self, tuple(K.average_over(maps) for K in self.terms))

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return tuple(k for K in self.terms for k in K.scalar_kernels)

    @property
    def invariance(self) -> Invariance:
        return common_invariance(self.terms)

    def part(self, which: int | str) -> AbstractMatrixKernel:
        """The term with this position or name; a KeyError with the choices if there is none."""
        return self.terms[self.position(which)]

    def position(self, which: int | str) -> int:
        """The position of the term with this position or name."""
        named = isinstance(which, str) and which in self.names
        index: Any = self.names.index(which) if named else which
        positions = range(len(self.terms))
        try:
            return positions[index]
        except (IndexError, TypeError):
            names = [name for name in self.names if name is not None]
            raise KeyError(
                f"no part {which!r}: this sum has positions 0 to {positions[-1]}"
                + (f" and the names {names}." if names else ".")
            ) from None


def matrix_kernel(
    K: Any,
    what: str = "K, the first argument,",
    example: str = "hk.Symplectic(k), hk.CurlFree(k), hk.DivergenceFree(k) or hk.Separable(k)",
) -> AbstractMatrixKernel:
    """The kernel K if it is matrix-valued; else a TypeError that says how to make one."""
    if isinstance(K, AbstractMatrixKernel):
        return K
    cure = f"Give a scalar kernel its structure first: {example}."
    if isinstance(K, type) and issubclass(K, AbstractMatrixKernel):
        cure = f"This is a class; make a kernel, such as hk.{K.__name__}(hk.Gaussian(1.0))."
    raise TypeError(f"{what} must be a matrix-valued kernel; got {reprlib.repr(K)}. {cure}")


def Odd(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the odd fields with the structure of K, f(−x) = −f(x).

    A field B∇u is odd if u is even, so we replace the SCALAR kernel k inside by its even part. The
    symmetry is exact for every k. Evaluating costs twice as much as K if the library knows that
    k(−x, −z) = k(x, z), else four times. In a sum `Odd` applies to each term.

    Args:
        K: a structured kernel whose B does not depend on x.

    Raises:
        TypeError: K is not matrix-valued, or its B depends on x.

    Source: Smith & Egeland (2023), section 4, there for k(x, z) = g(x − z).
    """
    return matrix_kernel(K, "the argument of Odd", "Odd(Symplectic(k))").with_parity(-1)


def Even(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the even fields with the structure of K, f(−x) = f(x).

    A field B∇u is even if u is odd, u(−x) = −u(x). The costs are those of `Odd`.

    Args:
        K: a structured kernel whose B does not depend on x.

    Raises:
        TypeError: K is not matrix-valued, or its B depends on x.
    """
    return matrix_kernel(K, "the argument of Even", "Even(Symplectic(k))").with_parity(+1)


def Reversible(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the reversible fields J∇H with H(q, −p) = H(q, p).

    With S = diag(I, −I) they obey f(Sx) = −S f(x): the time-reversed motion solves the same
    equation. Every H = T(p) + U(q) with an even T is reversible. Systems with friction, in magnetic
    fields and in rotating frames are not. Evaluating costs twice as much as K if the library knows
    that k(Sx, Sz) = k(x, z), else four times. `Reversible(Odd(K))` has both symmetries, a group of
    four maps.

    Args:
        K: `Symplectic(k)`, `Odd(Symplectic(k))`, `Even(Symplectic(k))`, or a sum of these.

    Raises:
        TypeError: K is not matrix-valued, or its fields are not J∇H.

    Example: `hk.Reversible(hk.Odd(hk.Symplectic(hk.Gaussian(2.0))))` for a pendulum.
    """
    K = matrix_kernel(K, "the argument of Reversible", "Reversible(Symplectic(k))")
    if not K.symplectic:
        raise TypeError(
            f"the fields of {type(K).__name__} are not reversible: time reversal holds for J∇H, "
            "Reversible(Symplectic(k)), and not with friction, magnetic fields or in rotating "
            "frames. In a sum make one part reversible: Reversible(Symplectic(k)) + CurlFree(k)."
        )
    return K.average_over((time_reversal,))


@overload
def Invariant(k: AbstractMatrixKernel, maps: Any) -> AbstractMatrixKernel: ...
@overload
def Invariant(k: Any, maps: Any) -> AbstractScalarKernel: ...


def Invariant(k: Any, maps: Any) -> Any:
    """The kernel of the functions with H(Sx) = H(x) for a finite group G of linear maps S.

    The kernel is the mean (1/|G|²) Σ k(gx, hz) over both arguments, which is right for every k. If
    the library knows that k(Sx, Sz) = k(x, z), it takes the mean over one argument, which costs |G|
    times as much as k instead of |G|² times. This holds for orthogonal S with one lengthscale for
    all coordinates, and for S that only change signs.

    Inside `Symplectic`, a map with SᵀJS = J gives fields f(Sx) = S f(x), and a map with SᵀJS = −J
    reversible fields f(Sx) = −S f(x). Other maps raise a ValueError.

    Args:
        k: a scalar kernel, or a structure, whose scalar kernels we average.
        maps: generators of the group, (n, n) arrays or linear functions x -> S x. The group may
            have up to 64 elements.

    Returns:
        A scalar kernel; a structure if `k` is a structure.

    Raises:
        TypeError: `k` is no kernel, or `maps` no list of maps.
        ValueError: a matrix is not square; or, when called, a map is not linear or of another
            dimension, the group does not close, or the structure does not allow the map.

    Example: `hk.Symplectic(hk.Invariant(hk.Gaussian(1.0), [rotation, mirror]))`.
    """
    generators = linear_maps(maps)
    if isinstance(k, AbstractMatrixKernel):
        return k.average_over(generators)
    return symmetrise(as_scalar_kernel(k), generators, (1.0,) * len(generators))
