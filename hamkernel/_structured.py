"""Matrix-valued kernels whose fields obey a structure, from any scalar kernel.

A structure is a linear operator applied to a scalar potential, f = B(x) ∇u(x). If u lives in the
RKHS of k, then f lives in the RKHS of

    K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ          shape (n, n),

and automatic differentiation builds it from any k: uᵀK(x, z)v is the derivative of k along B(x)ᵀu
in its first argument and B(z)ᵀv in its second. With representer coefficients aⱼ at points zⱼ
the potential is u(x) = Σⱼ ∂z k(x, zⱼ)·B(zⱼ)ᵀaⱼ: one forward derivative of a row of scalars. The
field is its gradient, so evaluating it never forms an (n, n) block. The paper's −∇∇ᵀg(x − z) is
the case k(x, z) = g(x − z); the mixed derivative is the one that is positive for every k.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._scalar import AbstractScalarKernel, Invariance, as_scalar_kernel
from hamkernel._scalar_transform import parity_removed, with_parity


class AbstractMatrixKernel(eqx.Module):
    """A positive definite kernel K(x, z) -> (n, n) of fields ℝⁿ -> ℝⁿ."""

    matrix_valued: ClassVar[bool] = True
    symplectic: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def form(
        self,
        x: Float[Array, " n"],
        u: Float[Array, " n"],
        z: Float[Array, " n"],
        v: Float[Array, " n"],
    ) -> Float[Array, ""]:
        """uᵀ K(x, z) v for one pair of points."""

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The block K(x, z) for one pair of points."""
        basis = jnp.eye(len(x), dtype=x.dtype)
        columns = jax.vmap(self.form, in_axes=(None, None, None, 0))
        return jax.vmap(columns, in_axes=(None, 0, None, None))(x, basis, z, basis)

    @abc.abstractmethod
    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        """Σⱼ K(x, zⱼ) aⱼ, without the blocks."""

    @abc.abstractmethod
    def potential(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, ""]:
        """The potential of `expansion`; AttributeError, with the reason, if there is none."""

    @abc.abstractmethod
    def check_dimension(self, n: int) -> None:
        """ValueError if fields on ℝⁿ cannot have this structure."""

    @abc.abstractmethod
    def with_parity(self, parity: int) -> "AbstractMatrixKernel":
        """The kernel of the even (+1) or odd (−1) FIELDS with this structure."""

    @property
    @abc.abstractmethod
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """The scalar kernels that the structure is made from."""

    @property
    def invariance(self) -> Invariance:
        common = Invariance.TRANSLATION
        for kernel in self.scalar_kernels:
            common &= kernel.invariance
        return common

    def __add__(self, other: Any) -> "Sum":
        return Sum(self, other) if isinstance(other, AbstractMatrixKernel) else NotImplemented

    def __radd__(self, other: Any) -> "AbstractMatrixKernel":
        return self if isinstance(other, int) and other == 0 else NotImplemented


def _row(k: AbstractScalarKernel, x: Float[Array, " n"], Z: Float[Array, "M n"]):
    return jax.vmap(k, in_axes=(None, 0))(x, Z)


def _mixed(k: AbstractScalarKernel, x, u, z, v) -> Float[Array, ""]:
    """uᵀ [∂x ∂zᵀ k(x, z)] v, forward in both arguments.

    For k(x, z) = φ(s) this is φ″(s) ds(u) ds(v) + φ′(s) dds(u, v): in a Gram an entry costs a few
    multiplications, since what belongs to one point or to the pair alone is made once.
    """

    def slope(x):
        return jax.jvp(lambda z: k(x, z), (z,), (v,))[1]

    return jax.jvp(slope, (x,), (u,))[1]


class Separable(AbstractMatrixKernel):
    """K(x, z) = k(x, z) I: the components share a kernel and no structure.

    The baseline of the paper. Works in every dimension; fields have no potential.

    Source: Smith & Egeland (2023), eq. (separable_gaussian_kernel).
    """

    kernel: AbstractScalarKernel
    symplectic: ClassVar[bool] = False

    def __init__(self, kernel: Any):
        self.kernel = as_scalar_kernel(kernel)

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return self.kernel(x, z) * (u @ v)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return _row(self.kernel, x, Z) @ A

    def potential(self, x: Array, Z: Array, A: Array) -> Float[Array, ""]:
        raise AttributeError(
            "a field of a Separable kernel has no potential: its components are independent. "
            "Use Symplectic or CurlFree to learn one."
        )

    def check_dimension(self, n: int) -> None:
        pass

    def with_parity(self, parity: int) -> "Separable":
        return Separable(with_parity(self.kernel, parity))  # the field IS the scalar function

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)


class AbstractPotentialKernel(AbstractMatrixKernel):
    """K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ: fields f = B ∇u of a potential u.

    A final class adds B; everything else is here.
    """

    kernel: eqx.AbstractVar[AbstractScalarKernel]

    @abc.abstractmethod
    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """B(x) v, of a vector (n,) or of each column of a matrix (n, m)."""

    @abc.abstractmethod
    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """B(x)ᵀ v."""

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return _mixed(self.kernel, x, self.apply_transpose(x, u), z, self.apply_transpose(z, v))

    def potential(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, ""]:
        directions = jax.vmap(self.apply_transpose)(Z, A)
        _, slopes = jax.jvp(lambda Z: _row(self.kernel, x, Z), (Z,), (directions,))
        return slopes.sum()

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return self.apply(x, jax.grad(self.potential)(x, Z, A))

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)


class CurlFree(AbstractPotentialKernel):
    """K(x, z) = ∂x ∂zᵀ k(x, z): gradient fields f = ∇u, so Df is symmetric.

    Works in every dimension n ≥ 1. `field.potential(x)` is u.

    Source: Smith & Egeland (2023), eq. (curl_free_kernel_base); Fuselier (2006).
    """

    kernel: AbstractScalarKernel
    symplectic: ClassVar[bool] = False

    def __init__(self, kernel: Any):
        self.kernel = as_scalar_kernel(kernel)

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return v

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return v

    def check_dimension(self, n: int) -> None:
        pass

    def with_parity(self, parity: int) -> "CurlFree":
        return CurlFree(with_parity(self.kernel, -parity))


class Symplectic(AbstractPotentialKernel):
    """K(x, z) = J [∂x ∂zᵀ k(x, z)] Jᵀ: Hamiltonian fields f = J∇H, J = [[0, I], [−I, 0]].

    The state is x = (q₁…q_m, p₁…p_m), so n = 2m is even. `field.hamiltonian(x)` is H.

    Source: Smith & Egeland (2023), eq. (symplectic_kernel_base); Boffi, Tu & Slotine (2022).
    """

    kernel: AbstractScalarKernel
    symplectic: ClassVar[bool] = True

    def __init__(self, kernel: Any):
        self.kernel = as_scalar_kernel(kernel)

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        dq, dp = jnp.split(v, 2)
        return jnp.concatenate([dp, -dq])

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        dq, dp = jnp.split(v, 2)
        return jnp.concatenate([-dp, dq])

    def check_dimension(self, n: int) -> None:
        if n % 2:
            raise ValueError(
                f"a Symplectic kernel needs states x = (q, p) of even dimension, got n = {n}. "
                "Add the missing coordinate, or use CurlFree, DivergenceFree or Separable."
            )

    def with_parity(self, parity: int) -> "Symplectic":
        return Symplectic(with_parity(self.kernel, -parity))


class DivergenceFree(AbstractMatrixKernel):
    """K(x, z) = tr(M) I − Mᵀ with M = ∂x ∂zᵀ k(x, z): fields with div f = 0, any n ≥ 2.

    The fields are f_a = Σ_b ∂_b Ψ_ab of an antisymmetric matrix Ψ whose entries above the
    diagonal are independent functions in the RKHS of k. For n = 2, K = J M Jᵀ.

    Source: Fuselier (2006); for n = 3 it is the curl of a vector potential.
    """

    kernel: AbstractScalarKernel
    symplectic: ClassVar[bool] = False

    def __init__(self, kernel: Any):
        self.kernel = as_scalar_kernel(kernel)

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        along_both = jax.vmap(lambda e: _mixed(self.kernel, x, e, z, e))
        trace = along_both(jnp.eye(len(x), dtype=x.dtype)).sum()
        return trace * (u @ v) - _mixed(self.kernel, x, v, z, u)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        # W_ba(x) = Σⱼ ∂_{z_b} k(x, zⱼ) a_ja, Ψ = Wᵀ − W, and f_a = Σ_b ∂_b Ψ_ab. The slopes
        # ∂_{z_b} k(x, zⱼ) of all j come from one forward derivative along e_b.
        def slopes(x, e):
            return jax.jvp(lambda Z: _row(self.kernel, x, Z), (Z,), (jnp.broadcast_to(e, Z.shape),))

        def term(e):  # ∂_b (W_b: − W_:b)
            def row_minus_column(x):
                W = jax.vmap(lambda d: slopes(x, d)[1] @ A)(basis)
                return e @ W - W @ e

            return jax.jvp(row_minus_column, (x,), (e,))[1]

        basis = jnp.eye(len(x), dtype=x.dtype)
        return jax.vmap(term)(basis).sum(axis=0)

    def potential(self, x: Array, Z: Array, A: Array) -> Float[Array, ""]:
        raise AttributeError(
            "a field of a DivergenceFree kernel has a matrix potential, not a scalar one. "
            "In the plane use Symplectic(k), the same kernel, whose potential is the "
            "stream function."
        )

    def check_dimension(self, n: int) -> None:
        if n < 2:
            raise ValueError(
                f"a DivergenceFree kernel needs n >= 2, got n = {n}: on a line such a field "
                "is constant."
            )

    def with_parity(self, parity: int) -> "DivergenceFree":
        return DivergenceFree(with_parity(self.kernel, -parity))

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)


class Sum(AbstractMatrixKernel):
    """K₁(x, z) + K₂(x, z) + …: fields that are sums of fields with different structures.

    `K1 + K2` makes one with positions; `Sum(conservative=K1, rest=K2)` one with names. After a
    fit `field.part("rest")` or `field.part(1)` is the part alone.

    Raises:
        TypeError: a term is no matrix-valued kernel.
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
            if not isinstance(term, AbstractMatrixKernel):
                raise TypeError(
                    f"Sum adds matrix-valued kernels, got {term!r}. Wrap a scalar kernel in a "
                    "structure first, for example Symplectic(k)."
                )
        names = [name for name, _ in flat if name is not None]
        if not flat or len(set(names)) < len(names):
            raise ValueError(f"Sum needs at least one kernel and distinct names, got {names}.")
        self.terms = tuple(term for _, term in flat)
        self.names = tuple(name for name, _ in flat)

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        first, *rest = (K.form(x, u, z, v) for K in self.terms)
        return sum(rest, start=first)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        first, *rest = (K.expansion(x, Z, A) for K in self.terms)
        return sum(rest, start=first)

    def potential(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, ""]:
        kinds = {type(K) for K in self.terms}
        if len(kinds) > 1:
            raise AttributeError(
                "the sum of structures "
                + " + ".join(type(K).__name__ for K in self.terms)
                + " has no single potential. Ask one part for its own: field.part(0).potential(x)."
            )
        first, *rest = (K.potential(x, Z, A) for K in self.terms)
        return sum(rest, start=first)

    @property
    def symplectic(self) -> bool:
        return all(K.symplectic for K in self.terms)

    def check_dimension(self, n: int) -> None:
        for K in self.terms:
            K.check_dimension(n)

    def with_parity(self, parity: int) -> "Sum":
        parts = tuple(K.with_parity(parity) for K in self.terms)
        return eqx.tree_at(lambda s: s.terms, self, parts)

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return tuple(k for K in self.terms for k in K.scalar_kernels)

    def part(self, which: int | str) -> AbstractMatrixKernel:
        """The term with this position or name; KeyError, with the choices, if there is none."""
        index = self.names.index(which) if which in self.names else which
        if not isinstance(index, int) or not -len(self.terms) <= index < len(self.terms):
            named = [name for name in self.names if name is not None]
            raise KeyError(
                f"no part {which!r}: this sum has positions 0 to {len(self.terms) - 1}"
                + (f" and the names {named}." if named else ".")
            )
        return self.terms[index]


def unfolded(
    K: AbstractMatrixKernel, Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> tuple[AbstractMatrixKernel, Float[Array, "L n"], Float[Array, "L n"]]:
    """A kernel, points and coefficients with the expansion of K, Z, A, without its odd kernels.

    An odd or even field Σⱼ ½[K₀(x, zⱼ) ± K₀(x, −zⱼ)] aⱼ is one of K₀ with twice the points. In a
    sum over many pairs this is cheaper than the two terms at once, which fill the registers.
    K, Z and A themselves where K is of another form.
    """
    if not isinstance(K, Separable | CurlFree | Symplectic | DivergenceFree):
        return K, Z, A
    simple = parity_removed(K.kernel)
    if simple is None:
        return K, Z, A
    kernel, parity = simple
    # A derivative of an even function is odd.
    sign = parity if isinstance(K, Separable) else -parity
    K = eqx.tree_at(lambda s: s.kernel, K, kernel)
    return K, jnp.concatenate([Z, -Z]), jnp.concatenate([A, sign * A]) / 2


def Odd(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the odd fields with the structure of K, f(−x) = −f(x).

    The SCALAR kernel inside is symmetrised: a field B∇u is odd when u is even. Exact for every
    kernel, also without k(−x, −z) = k(x, z); twice the cost of K where that is known, four times
    where it is not. A sum is symmetrised part by part.

    Args:
        K: a structured kernel whose B does not depend on x.

    Raises:
        TypeError: K is not matrix-valued.

    Source: Smith & Egeland (2023), eq. (odd_symplectic_kernel), there for k(x, z) = g(x − z).
    """
    return _matrix_kernel(K, "Odd").with_parity(-1)


def Even(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the even fields with the structure of K, f(−x) = f(x).

    As `Odd`, with an odd potential: H(−x) = −H(x).

    Raises:
        TypeError: K is not matrix-valued.
    """
    return _matrix_kernel(K, "Even").with_parity(+1)


def _matrix_kernel(K: Any, caller: str) -> AbstractMatrixKernel:
    if not isinstance(K, AbstractMatrixKernel):
        raise TypeError(
            f"{caller} needs a matrix-valued kernel, got {K!r}. Give a scalar kernel its "
            f"structure first, for example {caller}(Symplectic(k))."
        )
    return K
