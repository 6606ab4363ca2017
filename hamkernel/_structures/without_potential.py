"""Structures whose fields have no scalar potential."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import Invariance
from hamkernel._kernels.symmetry import symmetries
from hamkernel._structures.structure import AbstractStructure, mixed, row


class Separable(AbstractStructure):
    """K(x, z) = k(x, z) I: the components share a kernel and no structure.

    The baseline of the paper. Works in every dimension; fields have no potential.

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

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        return row(self.kernel, x, Z) @ A

    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        return np.eye(len(S))


class DivergenceFree(AbstractStructure):
    """K(x, z) = tr(M) I − Mᵀ with M = ∂x ∂zᵀ k(x, z): fields with div f = 0, any n ≥ 2.

    The fields are f_a = Σ_b ∂_b Ψ_ab of an antisymmetric matrix Ψ whose entries above the
    diagonal are independent functions in the RKHS of k. For n = 2, K = J M Jᵀ.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().

    Raises:
        TypeError: `kernel` is not a scalar kernel. ValueError, with data: n is 1.

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
        along_both = jax.vmap(lambda e: mixed(self.kernel, x, e, z, e))
        trace = along_both(jnp.eye(len(x), dtype=x.dtype)).sum()
        return trace * (u @ v) - mixed(self.kernel, x, v, z, u)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
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
