"""The base of matrix-valued kernels, their sums, and their symmetries: odd, even, reversible, any.

A symmetry is imposed on the SCALAR kernel inside a structure, which is averaged over the group. The
potential then has the symmetry, and so has the field: where B(Sx) = ± S B(x) Sᵀ, a potential with
u(Sx) = u(x) gives f(Sx) = ± S f(x).
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
    takes_inputs: ClassVar[bool] = False  # whether its points are (x, u)
    given: ClassVar[str] = "inputs"  # the name of u in `fit`; "parameters" for a family
    # Whether derivatives of the Gram are cheaper in reverse mode, as for some closed forms.
    differentiated_backward: ClassVar[bool] = False
    symplectic: eqx.AbstractVar[bool]  # whether flows keep dq ∧ dp, as those of J∇H do
    no_potential: eqx.AbstractVar[str | None]  # why fields have no potential; None if they have one

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
        # Arrays have no hash. Equal kernels have equal structure, so this one fits `==`.
        return hash(jax.tree.structure(self))

    @abc.abstractmethod
    def form(self, x: Point, u: Point, z: Point, v: Point) -> Float[Array, ""]:
        """uᵀ K(x, z) v for one pair of points."""

    @full_precision
    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The block K(x, z) for one pair of points.

        Raises:
            ValueError: x or z is no single point, or n is not one that the structure allows.
        """
        x, z = require.one_space(one_point(x)[None], one_point(z)[None])
        x, z = x[0], z[0]
        self.check_dimension(len(x))
        basis = jnp.eye(self.outputs(len(x)), dtype=x.dtype)
        columns = jax.vmap(self.form, in_axes=(None, None, None, 0))
        return jax.vmap(columns, in_axes=(None, 0, None, None))(x, basis, z, basis)

    @abc.abstractmethod
    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        """Σⱼ K(x, zⱼ) aⱼ, without the blocks."""

    def directions(self, Z: Points, A: Points) -> Points:
        """The directions vⱼ along which `expansion` differentiates at zⱼ, if it does so; else A."""
        return A

    def along(self, x: Point, Z: Points, V: Points) -> Point:
        """`expansion` with `directions` in the place of A."""
        return self.expansion(x, Z, V)

    def potential(self, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
        """The potential of `expansion`; AttributeError if there is none."""
        raise AttributeError(self.no_potential)

    def potential_covariance(self, x: Point, z: Point) -> Float[Array, ""]:
        """The kernel of the potential, of which K is B ∂x∂zᵀ(·) Bᵀ; AttributeError if none."""
        raise AttributeError(self.no_potential)

    def check_potential(self) -> None:
        """AttributeError, with the reason, if the fields have no potential."""
        if self.no_potential:
            raise AttributeError(self.no_potential)

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        """The power −dH/dt at x for ∇H = `slope`, shape (); for structures with a Hamiltonian."""
        raise AttributeError(self.no_potential)

    def check_dimension(self, n: int) -> None:
        """ValueError if fields on ℝⁿ cannot have this structure; by default all can."""

    def check_points(self, X: Float[Array, "N d"]) -> None:
        """ValueError if the structure cannot hold at these points; their values may be traced."""
        self.check_dimension(X.shape[1])

    def centre(self, Z: Float[Array, "M d"]) -> Float[Array, " d"] | None:
        """The mean of Z if K(x − c, z − c) = K(x, z) for all c, else None."""
        return Z.mean(axis=0) if Invariance.TRANSLATION in self.invariance else None

    def blocks(
        self, X: Float[Array, "N n"], Z: Float[Array, "M n"]
    ) -> Float[Array, "N n M n"] | None:
        """The Gram, where K has a closed form for many points at once; else None."""
        return None

    def through_descriptor(self, n: int) -> Descriptor | None:
        """The descriptor and the directions of differentiation; None if K has no descriptor."""
        return None

    @property
    def of_states(self) -> "AbstractMatrixKernel":
        """The kernel of fields of x alone: this one, unless its points are (x, u)."""
        return self

    def with_states(self, K: "AbstractMatrixKernel") -> "AbstractMatrixKernel":
        """This kernel with `of_states` replaced by K."""
        return K

    def outputs(self, inputs: int) -> int:
        """The number of components of a field at points with `inputs` coordinates."""
        return inputs

    def shares_potential(self, other: "AbstractMatrixKernel") -> bool:
        """Whether the fields of both kernels are made from a potential by the same operator."""
        return False

    @abc.abstractmethod
    def with_parity(self, parity: int) -> "AbstractMatrixKernel":
        """The kernel of the even (+1) or odd (−1) FIELDS with this structure."""

    @abc.abstractmethod
    def average_over(self, maps: tuple[LinearMap, ...]) -> "AbstractMatrixKernel":
        """The kernel of the fields whose potential is invariant under these maps."""

    def bounds(self, name: str, X: Float[np.ndarray, "N d"], amplitude: float) -> Bounds:
        """The lower and upper bound of the array `name`, as `AbstractScalarKernel.bounds`."""
        return bounds_by_value(name, getattr(self, name))

    def transform_inputs(self, X: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "N n"]:
        """The data in the coordinates of the inner kernels."""
        return X

    @property
    @abc.abstractmethod
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """The scalar kernels inside the structure."""

    @property
    @abc.abstractmethod
    def invariance(self) -> Invariance:
        """The transformations of both arguments that leave every block unchanged."""

    def __add__(self, other: Any) -> "Sum":
        if not isinstance(other, AbstractMatrixKernel) or other.takes_inputs:
            return NotImplemented  # a kernel of joined points defines the sum
        return Sum(self, other)

    def __mul__(self, other: Any) -> Any:
        raise TypeError(
            f"a structured kernel is scaled inside: {type(self).__name__}(2.0 * k), and so it is "
            f"with products, {type(self).__name__}(k1 * k2)."
        )

    __rmul__ = __mul__

    def __radd__(self, other: Any) -> "AbstractMatrixKernel":
        return self if isinstance(other, int) and other == 0 else NotImplemented


def total(values: list[Array]) -> Array:
    """The sum of the values of the terms of a kernel, of which there is at least one."""
    return functools.reduce(operator.add, values)


class Sum(AbstractMatrixKernel):
    """K₁(x, z) + K₂(x, z) + …: fields that are sums of fields with different structures.

    `K1 + K2` numbers its parts; `Sum(conservative=K1, rest=K2)` names them. After a fit,
    `field.part(1)` or `field.part("rest")` is one part alone.

    Args:
        terms: matrix-valued kernels; a sum among them is taken apart.
        named: the same with names.

    Raises:
        TypeError: a term is no matrix-valued kernel. ValueError: there is no term, two have one
            name, or one is called regularization, as λ is.
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
            raise ValueError("a part cannot be called regularization: tune calls λ so.")
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
            f"the sum of structures {names} has no single potential: each has an operator of its "
            "own. Ask one part for its own: field.part(0).potential(x)."
        )

    def _structures(self) -> Iterator[AbstractMatrixKernel]:
        """All terms, including the terms of inner named sums."""
        for K in self.terms:
            yield from K._structures() if isinstance(K, Sum) else (K,)

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        return all(K.shares_potential(other) for K in self._structures())

    @property
    def symplectic(self) -> bool:
        return all(K.symplectic for K in self.terms)

    @property
    def has_hamiltonian(self) -> bool:
        return self.no_potential is None and all(K.has_hamiltonian for K in self.terms)

    @property
    def conserves(self) -> bool:
        return self.has_hamiltonian and all(K.conserves for K in self.terms)

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        self.check_potential()
        return self.terms[0].dissipated(x, slope)

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
        """The term with this position or name; KeyError, with the choices, if there is none."""
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
    """K, if it is matrix-valued; else a TypeError that says how to make one."""
    if isinstance(K, AbstractMatrixKernel):
        return K
    cure = f"Give a scalar kernel its structure first: {example}."
    if isinstance(K, type) and issubclass(K, AbstractMatrixKernel):
        cure = f"That is a class; make a kernel of it, such as hk.{K.__name__}(hk.Gaussian(1.0))."
    raise TypeError(f"{what} must be a matrix-valued kernel; got {reprlib.repr(K)}. {cure}")


def Odd(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the odd fields with the structure of K, f(−x) = −f(x).

    The SCALAR kernel inside is symmetrised: a field B∇u is odd when u is even. Exact for every
    kernel; twice the cost of K if k(−x, −z) = k(x, z) is known, else four times. A sum is
    symmetrised part by part.

    Args:
        K: a structured kernel whose B does not depend on x.

    Raises:
        TypeError: K is not matrix-valued.

    Source: Smith & Egeland (2023), section 4, there for k(x, z) = g(x − z).
    """
    return matrix_kernel(K, "the argument of Odd", "Odd(Symplectic(k))").with_parity(-1)


def Even(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the even fields with the structure of K, f(−x) = f(x).

    As `Odd`, with an odd potential: H(−x) = −H(x).

    Raises:
        TypeError: K is not matrix-valued.
    """
    return matrix_kernel(K, "the argument of Even", "Even(Symplectic(k))").with_parity(+1)


def Reversible(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the reversible fields J∇H: H(q, −p) = H(q, p), whose motions may run backwards.

    With S = diag(I, −I) they obey f(Sx) = −S f(x). True for every H = T(p) + U(q) with an even T;
    false with friction, in magnetic fields and in rotating frames. Twice the cost of K if
    k(Sx, Sz) = k(x, z) is known, else four times. `Reversible(Odd(K))` is both, with a group of
    four.

    Args:
        K: `Symplectic(k)`, an odd or even one, or a sum of them.

    Raises:
        TypeError: K is not matrix-valued, or its fields are not J∇H.

    Example: `hk.Reversible(hk.Odd(hk.Symplectic(hk.Gaussian(2.0))))` for a pendulum.
    """
    K = matrix_kernel(K, "the argument of Reversible", "Reversible(Symplectic(k))")
    if not K.symplectic:
        raise TypeError(
            f"the fields of {type(K).__name__} are not reversible: time reversal holds for J∇H, "
            "Reversible(Symplectic(k)), and not with friction, magnetic fields or in rotating "
            "frames. In a sum say it of the part: Reversible(Symplectic(k)) + CurlFree(k)."
        )
    return K.average_over((time_reversal,))


@overload
def Invariant(k: AbstractMatrixKernel, maps: Any) -> AbstractMatrixKernel: ...
@overload
def Invariant(k: Any, maps: Any) -> AbstractScalarKernel: ...


def Invariant(k: Any, maps: Any) -> Any:
    """The kernel of the functions that a finite group of linear maps leaves unchanged.

    H(Sx) = H(x) for every S that the maps generate: the mean (1/|G|²) Σ k(gx, hz) over both
    arguments, right for every k. Where k(Sx, Sz) = k(x, z) is known one side is enough, at |G|
    times the cost of k in place of |G|²: an orthogonal S and one lengthscale for all coordinates,
    or an S that only changes signs.

    Inside `Symplectic` a map with SᵀJS = J gives fields f(Sx) = S f(x), one with SᵀJS = −J
    reversible ones, f(Sx) = −S f(x); another one is an error there.

    Args:
        k: a scalar kernel, or a structure, inside which the scalar kernels are averaged.
        maps: generators of the group, (n, n) arrays or linear functions x -> S x. The group is
            closed from them, and may have up to 64 elements.

    Returns:
        A scalar kernel, or a structure where one was given.

    Raises:
        TypeError: `k` is no kernel, or `maps` no list of maps. ValueError: a matrix is not square;
            when called: a map is not linear or of another dimension, the group does not close, or
            a structure does not allow the map.

    Example: `hk.Symplectic(hk.Invariant(hk.Gaussian(1.0), [rotation, mirror]))`.
    """
    generators = linear_maps(maps)
    if isinstance(k, AbstractMatrixKernel):
        return k.average_over(generators)
    return symmetrise(as_scalar_kernel(k), generators, (1.0,) * len(generators))
