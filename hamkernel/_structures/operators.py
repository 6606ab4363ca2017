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
import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import AbstractScalarKernel, Invariance, as_scalar_kernel
from hamkernel._kernels.transforms import symmetries, symmetry_removed, with_parity
from hamkernel._show import call, described
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.maps import check_symmetries


class AbstractStructure(AbstractMatrixKernel):
    """A structure made from one scalar kernel k."""

    kernel: AbstractScalarKernel = eqx.field(converter=as_scalar_kernel)
    # 1 if the fields have the parity of the functions of k, −1 if the other; a derivative flips it.
    field_parity: eqx.AbstractClassVar[int]
    # Of the operator: TRANSLATION where B is constant, REFLECTION where B(−x) = B(x).
    operator_invariance: eqx.AbstractClassVar[Invariance]

    def __repr__(self) -> str:
        found = symmetry_removed(self.kernel)
        if found is None or found.parity is None:
            return described(self, positional=("kernel",))
        symmetry = "Odd" if self.field_parity * found.parity < 0 else "Even"
        return call(symmetry, [repr(eqx.tree_at(lambda K: K.kernel, self, found.kernel))])

    def with_parity(self, parity: int) -> "AbstractStructure":
        if Invariance.REFLECTION not in self.operator_invariance:
            raise TypeError(
                f"the fields of {type(self).__name__} have no parity with any potential: its "
                "operator B(x) is another one at -x."
            )
        kernel = with_parity(self.kernel, self.field_parity * parity)
        return eqx.tree_at(lambda K: K.kernel, self, kernel)

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        """By what the operators hold: two with arrays, which are trained, are never the same."""
        if type(self) is not type(other):
            return False
        (own, tree), (others, other_tree) = (jax.tree.flatten(_operator(K)) for K in (self, other))
        return tree == other_tree and not any(map(eqx.is_array, own)) and own == others

    @abc.abstractmethod
    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"] | None:
        """T such that what k(x, Sz) in place of k(x, z) makes of a is the same of Sz and Ta."""

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance & self.operator_invariance


def _operator(K: AbstractMatrixKernel) -> dict[str, Any]:
    """What a structure has beside its scalar kernel."""
    fields = dataclasses.fields(K)
    return {field.name: getattr(K, field.name) for field in fields if field.name != "kernel"}


class Separable(AbstractStructure):
    """K(x, z) = k(x, z) I: the components share a kernel and no structure.

    The baseline of the paper. Works in every dimension; fields have no potential.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is no scalar kernel.

    Source: Smith & Egeland (2023), eq. (separable_gaussian_kernel).
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

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return _row(self.kernel, x, Z) @ A

    def potential(self, x: Array, Z: Array, A: Array) -> Float[Array, ""]:
        raise AttributeError(self.no_potential)

    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        return np.eye(len(S))


class AbstractPotentialKernel(AbstractStructure):
    """K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ: fields f = B ∇u of a potential u.

    A final class adds B, and says what B is invariant to; everything else is here.
    """

    field_parity: ClassVar[int] = -1
    no_potential: ClassVar[str | None] = None

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

    def potential_covariance(
        self, x: Float[Array, " n"], z: Float[Array, " n"]
    ) -> Float[Array, ""]:
        return self.kernel(x, z)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return self.apply(x, jax.grad(self.potential)(x, Z, A))

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        if self.conserves:
            return jnp.zeros((), x.dtype)
        return -slope @ self.apply(x, slope)

    def operator_at(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """B(x) for all values of what is trained in it: where a symmetry of B must hold."""
        return self.apply(x, jnp.eye(len(x), dtype=x.dtype))

    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"] | None:
        # S B(z)ᵀ = ± B(Sz)ᵀ S⁻ᵀ, where B(Sz) = ± S B(z) Sᵀ
        if Invariance.TRANSLATION not in self.operator_invariance:
            return S if np.array_equal(S, S[0, 0] * np.eye(len(S))) else None
        with jax.ensure_compile_time_eval():
            B = np.asarray(self.operator_at(jnp.zeros(len(S))))
        image = S @ B @ S.T
        sign = 1.0 if np.abs(image - B).max() < np.abs(image + B).max() else -1.0
        return sign * np.linalg.inv(S).T

    def check_dimension(self, n: int) -> None:
        if Invariance.TRANSLATION in self.operator_invariance:  # B is the same everywhere
            check_symmetries(self, np.zeros((1, n)))


class CurlFree(AbstractPotentialKernel):
    """K(x, z) = ∂x ∂zᵀ k(x, z): gradient fields f = ∇u, so Df is symmetric.

    Works in every dimension n ≥ 1. `field.potential(x)` is u.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is no scalar kernel.

    Source: Smith & Egeland (2023), eq. (curl_free_kernel_base); Fuselier (2006).
    """

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return v

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return v


def check_even(n: int, whose: str) -> None:
    """ValueError where states cannot be (q, p)."""
    if n % 2:
        raise ValueError(
            f"{whose} needs states x = (q, p) of even dimension, got n = {n}. "
            "Add the missing coordinate, or drop a column that is no state, such as time; for "
            "conservative systems of any dimension use Poisson(k, tensor), for others CurlFree, "
            "DivergenceFree or Separable."
        )


class Symplectic(AbstractPotentialKernel):
    """K(x, z) = J [∂x ∂zᵀ k(x, z)] Jᵀ: Hamiltonian fields f = J∇H, J = [[0, I], [−I, 0]].

    The state is x = (q₁…q_m, p₁…p_m), so n = 2m is even. `field.hamiltonian(x)` is H.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is no scalar kernel. ValueError, with data: n is odd.

    Source: Smith & Egeland (2023), eq. (symplectic_kernel_base); Boffi, Tu & Slotine (2022).
    """

    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = True

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        dq, dp = jnp.split(v, 2)
        return jnp.concatenate([dp, -dq])

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        dq, dp = jnp.split(v, 2)
        return jnp.concatenate([-dp, dq])

    def check_dimension(self, n: int) -> None:
        check_even(n, "a Symplectic kernel")
        super().check_dimension(n)


class DivergenceFree(AbstractStructure):
    """K(x, z) = tr(M) I − Mᵀ with M = ∂x ∂zᵀ k(x, z): fields with div f = 0, any n ≥ 2.

    The fields are f_a = Σ_b ∂_b Ψ_ab of an antisymmetric matrix Ψ whose entries above the
    diagonal are independent functions in the RKHS of k. For n = 2, K = J M Jᵀ.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is no scalar kernel. ValueError, with data: n is 1.

    Source: Fuselier (2006); for n = 3 it is the curl of a vector potential.
    """

    field_parity: ClassVar[int] = -1
    operator_invariance: ClassVar[Invariance] = Invariance.TRANSLATION
    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = (
        "a field of a DivergenceFree kernel has a matrix potential, not a scalar one. In the plane "
        "use Symplectic(k), the same kernel, whose potential is the stream function."
    )

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
        raise AttributeError(self.no_potential)

    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        return S  # ±1, see `check_dimension`

    def check_dimension(self, n: int) -> None:
        if n < 2:
            raise ValueError(
                f"a DivergenceFree kernel needs n >= 2, got n = {n}: on a line such a field "
                "is constant."
            )
        if any(mean.parity is None for mean in symmetries(self.kernel)):
            raise ValueError(
                "a DivergenceFree field gets no symmetry from its matrix potential but Odd and "
                "Even: use Symplectic(Invariant(k, maps)) or CurlFree(Invariant(k, maps))."
            )


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
