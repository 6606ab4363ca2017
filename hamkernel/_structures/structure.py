"""Matrix-valued kernels whose fields obey a structure, from any scalar kernel.

A structure is a linear operator applied to a scalar potential, f = B(x) ∇u(x). If u is in the RKHS
of k, then f is in the RKHS of

    K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ          shape (n, n).

Automatic differentiation builds K from any k: uᵀK(x, z)v is the derivative of k along B(x)ᵀu in the
first argument and along B(z)ᵀv in the second. Given coefficients aⱼ at points zⱼ, the potential is
u(x) = Σⱼ ∂z k(x, zⱼ)·B(zⱼ)ᵀaⱼ, one forward derivative of a row of scalars. The field is B times the
gradient of u, so we form no (n, n) block. The paper's −∇∇ᵀg(x − z) is the case
k(x, z) = g(x − z). The mixed derivative is positive definite for every k.
"""

import abc
import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Descriptor,
    Invariance,
    Point,
    Points,
    as_scalar_kernel,
)
from hamkernel._kernels.symmetry import (
    LinearMap,
    drop_symmetry,
    matrix_of,
    symmetries,
    symmetrise,
    symmetry_removed,
    with_parity,
)
from hamkernel._kernels.transforms import Warp
from hamkernel._machine import precise_jit
from hamkernel._show import call, describe
from hamkernel._structures.base import AbstractMatrixKernel, nodes_of


class AbstractStructure(AbstractMatrixKernel):
    """A structure with one scalar kernel k."""

    kernel: AbstractScalarKernel = eqx.field(converter=as_scalar_kernel)
    # 1 if the fields have the parity of the potential, −1 if they have the opposite parity, 0 for
    # an operator of the caller, whose parity is unknown.
    field_parity: eqx.AbstractClassVar[int]
    # The symmetry of the operator: TRANSLATION if B is constant, REFLECTION if B(−x) = B(x).
    operator_invariance: eqx.AbstractClassVar[Invariance]

    def __repr__(self) -> str:
        symmetry_of_kernel = symmetry_removed(self.kernel)
        if symmetry_of_kernel is None or symmetry_of_kernel.parity is None:
            return describe(self, positional=("kernel",))
        symmetry = "Odd" if self.field_parity * symmetry_of_kernel.parity < 0 else "Even"
        return call(
            symmetry, [repr(eqx.tree_at(lambda K: K.kernel, self, symmetry_of_kernel.kernel))]
        )

    def with_parity(self, parity: int) -> "AbstractStructure":
        if Invariance.REFLECTION not in self.operator_invariance:
            raise TypeError(
                f"the fields of {type(self).__name__} cannot be odd or even: its operator B(x) "
                "depends on x. Use Invariant(k, maps) inside, with maps that B allows."
            )
        kernel = with_parity(self.kernel, self.field_parity * parity)
        return eqx.tree_at(lambda K: K.kernel, self, kernel)

    def check_points(self, X: Float[Array, "N d"]) -> None:
        super().check_points(X)
        k = drop_symmetry(self.kernel)
        # No single process has all rows of a sharded X.
        if not (require.is_concrete(X, k) and jnp.asarray(X).is_fully_addressable):
            return
        for warp, points in _warps(k, np.asarray(X)):
            smooth = np.asarray(_is_smooth(warp, jnp.asarray(points)))
            if not smooth.all():
                raise ValueError(
                    f"the map of Warp, or its derivative, is NaN or infinite at "
                    f"X[{smooth.argmin()}]: two atoms in one place have no inverse distance, and "
                    "roots and logarithms no derivative at 0. Leave such states out, or write a "
                    "map that is smooth there."
                )

    def average_over(self, maps: tuple[LinearMap, ...]) -> "AbstractStructure":
        kernel = symmetrise(self.kernel, maps, (1.0,) * len(maps))
        return eqx.tree_at(lambda K: K.kernel, self, kernel)

    def shares_potential(self, kernel: AbstractMatrixKernel) -> bool:
        """Whether both kernels have the same operator; False if an operator has trained arrays."""
        if type(self) is not type(kernel):
            return False
        (arrays, tree), (other_arrays, other_tree) = (
            jax.tree.flatten(_operator(K)) for K in (self, kernel)
        )
        return tree == other_tree and not any(map(eqx.is_array, arrays)) and arrays == other_arrays

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance & self.operator_invariance


def _warps(
    k: AbstractScalarKernel, X: Float[np.ndarray, "N n"]
) -> Iterator[tuple[Warp, Float[np.ndarray, "N m"]]]:
    """Each `Warp` within k, including k itself, with its arguments for the data X."""
    if isinstance(k, Warp):
        yield k, X

    def is_inside(node: object) -> bool:
        return node is not k and isinstance(node, AbstractScalarKernel)

    for inner in filter(is_inside, jax.tree.leaves(k, is_leaf=is_inside)):
        if nodes_of(Warp, inner):
            yield from _warps(inner, k.transform_inputs(X))


@precise_jit
def _is_smooth(warp: Warp, X: Float[Array, "N n"]) -> Bool[Array, " N"]:
    """Whether the map and its Jacobian are finite at each point."""

    def is_finite(x):
        return jnp.isfinite(warp.warp(x)).all() & jnp.isfinite(jax.jacfwd(warp.warp)(x)).all()

    return jax.lax.map(is_finite, X)


def _operator(K: AbstractMatrixKernel) -> dict[str, Any]:
    """The fields of a structure other than its scalar kernel, by name."""
    fields = dataclasses.fields(K)
    return {field.name: getattr(K, field.name) for field in fields if field.name != "kernel"}


def row(k: AbstractScalarKernel, x: Point, Z: Points) -> Float[Array, " M"]:
    """The row k(x, zⱼ) for all j."""
    return jax.vmap(k, in_axes=(None, 0))(x, Z)


def mixed_derivative(k: AbstractScalarKernel, x, u, z, v) -> Float[Array, ""]:
    """The mixed derivative uᵀ [∂x ∂zᵀ k(x, z)] v, in forward mode for both arguments.

    For k(x, z) = φ(s) this derivative is φ″(s) ds(u) ds(v) + φ′(s) dds(u, v). XLA computes factors
    of one point, or of a pair of points, once, so an entry of a Gram costs a few multiplications.
    """

    def slope(x):
        return jax.jvp(lambda z: k(x, z), (z,), (v,))[1]

    return jax.jvp(slope, (x,), (u,))[1]


def _operators(K: Any, X: Float[Array, "N n"]) -> Float[np.ndarray, "N n n"]:
    # Compiled code takes 0.05 ms instead of 2 ms. Under tracing we do not call compiled code, since
    # JAX would trace the call although B is known.
    evaluate = _compiled_operators_at if require.is_concrete(K, X) else _operators_at
    return np.asarray(evaluate(K, X))


def _operators_at(K: Any, X: Float[Array, "N n"]) -> Float[Array, "N n n"]:
    return jax.vmap(K.operator_at)(X)


_compiled_operators_at = precise_jit(_operators_at)


def check_symmetries(K: Any, X: Float[Array | np.ndarray, "N n"]) -> None:
    """Raise a ValueError unless B(Sx) = ± S B(x) Sᵀ for the maps S of the kernel, at points X."""
    n = X.shape[1]
    constant = Invariance.TRANSLATION in K.operator_invariance
    maps = dict.fromkeys(S_map for mean in symmetries(K.kernel) for S_map in mean.maps)
    matrices = {S_map: matrix_of(S_map, n) for S_map in maps}
    if constant:  # S = ±1 is a symmetry of every B
        matrices = {e: S for e, S in matrices.items() if not np.array_equal(S, S[0, 0] * np.eye(n))}
    if not matrices:
        return
    with jax.ensure_compile_time_eval():
        X = jnp.asarray(X)
        operators = _operators(K, X)
        for S in matrices.values():
            moved = jnp.asarray(np.asarray(X) @ S.T, X.dtype)
            moved_operators = operators if constant else _operators(K, moved)
            image = S @ operators @ S.T
            tolerance = 1e-5 * np.abs(operators).max()  # maps may have the rounding of float32
            if min(np.abs(moved_operators + sign * image).max() for sign in (1, -1)) > tolerance:
                raise ValueError(
                    f"a map of the symmetry is not one of the fields of {type(K).__name__}: with "
                    f"S = {np.round(S, 3).tolist()} neither B(Sx) = S B(x) Sᵀ nor -S B(x) Sᵀ holds."
                    " For J∇H the map must satisfy SᵀJS = ±J, so momenta move with their positions;"
                    " for gradients it must be orthogonal. Give all digits, not 0.866 for √3/2. "
                    "With friction time reversal is no symmetry."
                )


class AbstractPotentialKernel(AbstractStructure):
    """K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ: fields f = B ∇u of a potential u.

    A final class defines B and the symmetry of B; this class defines the rest.
    """

    field_parity: ClassVar[int] = -1
    no_potential: ClassVar[str | None] = None

    @abc.abstractmethod
    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """The product B(x) v with a vector (n,), or with each column of a matrix (n, m)."""

    @abc.abstractmethod
    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """The product B(x)ᵀ v."""

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return mixed_derivative(
            self.kernel, x, self.apply_transpose(x, u), z, self.apply_transpose(z, v)
        )

    def through_descriptor(self, n: int) -> Descriptor | None:
        descriptor = self.kernel.through_descriptor(n)
        if descriptor is None:
            return None

        def directions(x):
            return jax.vmap(lambda v: self.apply_transpose(x, v))(jnp.eye(n, dtype=x.dtype)).T

        return descriptor._replace(directions=directions)

    def potential(self, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
        return self._slope(x, Z, self.directions(Z, A))

    def _slope(self, x: Point, Z: Points, V: Points) -> Float[Array, ""]:
        return jax.jvp(lambda Z: row(self.kernel, x, Z), (Z,), (V,))[1].sum()

    def potential_covariance(self, x: Point, z: Point) -> Float[Array, ""]:
        return self.kernel(x, z)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        return self.along(x, Z, self.directions(Z, A))

    def directions(self, Z: Points, A: Points) -> Points:
        return jax.vmap(self.apply_transpose)(Z, A)

    def along(self, x: Point, Z: Points, V: Points) -> Point:
        return self.apply(x, jax.grad(self._slope)(x, Z, V))

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        if self.conserves:
            return jnp.zeros((), x.dtype)
        return -slope @ self.apply(x, slope)

    def operator_at(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The matrix B(x) with generic values in place of the trained parameters.

        A symmetry that holds for these values holds for all values.
        """
        return self.apply(x, jnp.eye(len(x), dtype=x.dtype))

    def check_dimension(self, n: int) -> None:
        if Invariance.TRANSLATION in self.operator_invariance:  # B is the same everywhere
            check_symmetries(self, np.zeros((1, n)))


class CurlFree(AbstractPotentialKernel):
    """K(x, z) = ∂x ∂zᵀ k(x, z): gradient fields f = ∇u, with a symmetric Jacobian.

    n ≥ 1. `field.potential(x)` is u.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel.

    Source: Smith & Egeland (2023), section 4; Fuselier (2006).
    """

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return v

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return v


def check_even(n: int, whose: str) -> None:
    """Raise a ValueError if n is odd, so that states cannot be (q, p)."""
    if n % 2:
        raise ValueError(
            f"{whose} needs states x = (q, p) of even dimension, got n = {n}. "
            "Add the missing coordinate, or drop a column that is no state, such as time. For "
            "positions alone, hk.learn(K, runs, mass=m) finds the momenta. For conservative "
            "systems of any dimension use Poisson(k, tensor), for others CurlFree, DivergenceFree "
            "or Separable."
        )


def canonical(v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """The product J v."""
    dq, dp = jnp.split(v, 2)
    return jnp.concatenate([dp, -dq])


class Symplectic(AbstractPotentialKernel):
    """K(x, z) = J [∂x ∂zᵀ k(x, z)] Jᵀ: Hamiltonian fields f = J∇H, J = [[0, I], [−I, 0]].

    The state is x = (q₁…q_m, p₁…p_m), so n = 2m is even. `field.hamiltonian(x)` is H.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel.
        ValueError: with data, if n is odd.

    Source: Smith & Egeland (2023), section 4; Boffi, Tu & Slotine (2022).
    """

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = True

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return canonical(v)

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return -canonical(v)

    def check_dimension(self, n: int) -> None:
        check_even(n, "a Symplectic kernel")
        super().check_dimension(n)


class Separable(AbstractStructure):
    """K(x, z) = k(x, z) I: independent components with one kernel, the paper's baseline.

    n ≥ 1. The fields have no potential.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel.

    Source: Smith & Egeland (2023), section 4.
    """

    field_parity: ClassVar[int] = 1
    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = (
        "a field of a Separable kernel has no potential: its components are independent. "
        "Use Symplectic or CurlFree to learn one."
    )

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return self.kernel(x, z) * (u @ v)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        return row(self.kernel, x, Z) @ A


class DivergenceFree(AbstractStructure):
    """K(x, z) = tr(M) I − Mᵀ with M = ∂x ∂zᵀ k(x, z): fields with div f = 0, n ≥ 2.

    The fields are f_a = Σ_b ∂_b Ψ_ab with an antisymmetric matrix potential Ψ. The entries of Ψ
    above the diagonal are independent functions in the RKHS of k. For n = 2, K = J M Jᵀ is the
    kernel of `Symplectic`.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel.
        ValueError: with data, if n is 1.

    Source: Fuselier (2006). For n = 3, f is the curl of a vector potential.
    """

    field_parity: ClassVar[int] = -1
    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = (
        "a field of a DivergenceFree kernel has a matrix potential, not a scalar one. In the plane "
        "use Symplectic(k), the same kernel, whose potential is the stream function."
    )

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        # uᵀ(tr(M) I − Mᵀ)v = tr(M) u·v − vᵀMu with M_ab = ∂x_a ∂z_b k
        along_both = jax.vmap(lambda e: mixed_derivative(self.kernel, x, e, z, e))
        trace = along_both(jnp.eye(len(x), dtype=x.dtype)).sum()
        return trace * (u @ v) - mixed_derivative(self.kernel, x, v, z, u)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        # W_ba(x) = Σⱼ ∂_{z_b} k(x, zⱼ) a_ja, Ψ = Wᵀ − W, and f_a = Σ_b ∂_b Ψ_ab. The slopes
        # ∂_{z_b} k(x, zⱼ) of all j come from one forward derivative along e_b.
        def slopes(x, e):
            return jax.jvp(lambda Z: row(self.kernel, x, Z), (Z,), (jnp.broadcast_to(e, Z.shape),))

        def term(e):  # ∂_b (W_b: − W_:b)
            def row_minus_column(x):
                W = jax.vmap(lambda d: slopes(x, d)[1] @ A)(basis)
                return e @ W - W @ e

            return jax.jvp(row_minus_column, (x,), (e,))[1]

        basis = jnp.eye(len(x), dtype=x.dtype)
        return jax.vmap(term)(basis).sum(axis=0)

    def __check_init__(self):
        if any(mean.parity is None for mean in symmetries(self.kernel)):
            self.average_over(())

    def average_over(self, maps: tuple[LinearMap, ...]) -> AbstractStructure:
        raise ValueError(
            "DivergenceFree has a matrix potential, and takes no symmetry but Odd and Even: use "
            "Symplectic(Invariant(k, maps)) or CurlFree(Invariant(k, maps))."
        )

    def check_dimension(self, n: int) -> None:
        if n < 2:
            raise ValueError(
                f"a DivergenceFree kernel needs n >= 2, got n = {n}: on a line such a field "
                "is constant."
            )


def expand_group(
    K: AbstractMatrixKernel, Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> tuple[AbstractMatrixKernel, Float[Array, "L n"], Float[Array, "L n"]]:
    """The kernel without its group, and the images of the points and of their directions.

    `along` with the result returns the same sum Σⱼ K(x, zⱼ) aⱼ. For a one-sided mean k_G of k,

        Σⱼ ∂_vⱼ k_G(x, zⱼ) = Σⱼ Σ_h χ(h)/|G| ∂_(h vⱼ) k(x, h zⱼ).

    In a sum over many pairs, more points are cheaper than more terms for each pair, which fill the
    registers. K and Z are unchanged if K has no group or a two-sided mean, or if the operator
    belongs to the caller.
    """
    V, n = K.directions(Z, A), Z.shape[1]
    if not isinstance(K, AbstractStructure) or K.field_parity == 0:
        return K, Z, V
    mean = symmetry_removed(K.kernel)
    if mean is None or not mean.is_one_sided(n):
        return K, Z, V
    group = mean.group(n)
    moves = K.field_parity < 0  # a sum of derivatives along V; otherwise a sum of values
    images = [h.character * (jax.vmap(h)(V) if moves else V) for h in group]
    K = eqx.tree_at(lambda K: K.kernel, K, mean.kernel)
    points = jnp.concatenate([jax.vmap(h)(Z) for h in group])
    return K, points, jnp.concatenate(images) / len(group)
