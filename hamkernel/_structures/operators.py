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
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import Invariance
from hamkernel._structures.maps import check_symmetries
from hamkernel._structures.structure import AbstractStructure, mixed, row


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
        return mixed(self.kernel, x, self.apply_transpose(x, u), z, self.apply_transpose(z, v))

    def potential(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, ""]:
        directions = jax.vmap(self.apply_transpose)(Z, A)
        _, slopes = jax.jvp(lambda Z: row(self.kernel, x, Z), (Z,), (directions,))
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
        # S B(z)ᵀ = ± B(Sz)ᵀ S⁻ᵀ, where B(Sz) = ± S B(z) Sᵀ: of a B(x) the sign is not known here.
        if Invariance.TRANSLATION not in self.operator_invariance:
            return S if np.array_equal(S, np.eye(len(S))) else None
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
    """ValueError where states cannot be (q, p)."""
    if n % 2:
        raise ValueError(
            f"{whose} needs states x = (q, p) of even dimension, got n = {n}. "
            "Add the missing coordinate, or drop a column that is no state, such as time; for "
            "conservative systems of any dimension use Poisson(k, tensor), for others CurlFree, "
            "DivergenceFree or Separable."
        )


def canonical(v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """J v."""
    dq, dp = jnp.split(v, 2)
    return jnp.concatenate([dp, -dq])


class Symplectic(AbstractPotentialKernel):
    """K(x, z) = J [∂x ∂zᵀ k(x, z)] Jᵀ: Hamiltonian fields f = J∇H, J = [[0, I], [−I, 0]].

    The state is x = (q₁…q_m, p₁…p_m), so n = 2m is even. `field.hamiltonian(x)` is H.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel. ValueError, with data: n is odd.

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
