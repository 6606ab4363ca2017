"""Fields in positions and velocities (q, q̇) where the structure asks for momenta."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Invariance
from hamkernel._kernels.groups import LinearMap
from hamkernel._show import described
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel


class UnknownMasses(AbstractMatrixKernel):
    """K′(y, z) = S⁻¹ K(Sy, Sz) S⁻ᵀ: states y = (q, q̇) of a structure for x = Sy = (q, p).

    S = diag(1, …, 1, m₁, …, mₘ), one mass for each degree of freedom, and a field f of K for (q, p)
    is S⁻¹f(Sy) for (q, q̇). The masses are hyperparameters; only their ratios can be identified,
    since scaling H and all masses together changes no motion, so the first one is 1.
    `field.hamiltonian(y)` is H in that unit.

    Args:
        kernel: K, a matrix-valued kernel, such as `Symplectic(k)`.
        masses: the first guess, one for each degree of freedom, shape (m,), m ≥ 2. Its unit does
            not matter.

    Raises:
        TypeError: K is not matrix-valued. ValueError: a mass is not positive and finite, or there
            is one degree of freedom only.

    Example: `hk.tune(hk.UnknownMasses(hk.Symplectic(k), [1.0, 1.0]), X, Y)`, or
    `hk.learn(hk.Symplectic(k), runs, masses=True)`.
    """

    kernel: AbstractMatrixKernel
    log_masses: Float[Array, " m-1"]  # over the first

    symplectic: ClassVar[bool] = False  # dq ∧ dp is kept, dq ∧ dq̇ is not

    def __init__(self, kernel: AbstractMatrixKernel, masses: ArrayLike):
        self.kernel = matrix_kernel(kernel, "the kernel of UnknownMasses", "Symplectic(k)")
        masses = jnp.asarray(require.positive(masses, "masses", "One for each degree of freedom."))
        if masses.ndim != 1 or len(masses) < 2:
            raise ValueError(
                f"masses has shape {masses.shape}; two or more, shape (m,), are needed. With one "
                "degree of freedom there is nothing to find: every mass explains the same motion, "
                "and is only a unit of the energy. Leave UnknownMasses out."
            )
        self.log_masses = jnp.log(masses[1:] / masses[0])

    def __repr__(self) -> str:
        return described(self, positional=("kernel",))

    @property
    def masses(self) -> Float[Array, " m"]:
        """The masses over the first one, shape (m,)."""
        return jnp.concatenate([jnp.ones(1, self.log_masses.dtype), jnp.exp(self.log_masses)])

    def scales(self, dtype: Any) -> Float[Array, " n"]:
        """The diagonal of S."""
        masses = self.masses.astype(dtype)
        return jnp.concatenate([jnp.ones_like(masses), masses])

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        s = self.scales(x.dtype)
        return self.kernel.form(s * x, u / s, s * z, v / s)

    def expansion(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, " n"]:
        s = self.scales(x.dtype)
        return self.kernel.expansion(s * x, s[None] * Z, A / s[None]) / s

    def potential(
        self, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
    ) -> Float[Array, ""]:
        s = self.scales(x.dtype)
        return self.kernel.potential(s * x, s[None] * Z, A / s[None])

    def potential_covariance(
        self, x: Float[Array, " n"], z: Float[Array, " n"]
    ) -> Float[Array, ""]:
        s = self.scales(x.dtype)
        return self.kernel.potential_covariance(s * x, s * z)

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        s = self.scales(x.dtype)
        return self.kernel.dissipated(s * x, slope / s)  # ∂H/∂x = S⁻ᵀ ∂H/∂y

    @property
    def no_potential(self) -> str | None:
        return self.kernel.no_potential

    @property
    def has_hamiltonian(self) -> bool:
        return self.kernel.has_hamiltonian

    @property
    def conserves(self) -> bool:
        return self.kernel.conserves

    def check_dimension(self, n: int) -> None:
        count = len(self.log_masses) + 1
        if n != 2 * count:
            raise ValueError(
                f"states have {n} coordinates and there are {count} masses: states (q, q̇) of "
                f"{2 * count} coordinates are needed, or one mass for each degree of freedom."
            )
        self.kernel.check_dimension(n)

    def check_points(self, X: Float[Array, "N n"]) -> None:
        self.check_dimension(X.shape[1])
        self.kernel.check_points(self.scales(X.dtype)[None] * X)

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        return False

    def with_parity(self, parity: int) -> "UnknownMasses":
        return eqx.tree_at(lambda K: K.kernel, self, self.kernel.with_parity(parity))

    def averaged(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError("say the symmetry inside: UnknownMasses(Invariant(K, maps), masses).")

    def seen(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        return X * np.asarray(self.scales(X.dtype))[None]

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """In the coordinates (q, p)."""
        return self.kernel.scalar_kernels

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance  # S is linear
