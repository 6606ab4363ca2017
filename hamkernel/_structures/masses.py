"""`UnknownMasses`: kernels of states (q, q̇) instead of (q, p), with unknown masses."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, Point, Points
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._show import call, describe, text
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel


class UnknownMasses(AbstractMatrixKernel):
    """K′(y, z) = S⁻¹ K(Sy, Sz) S⁻ᵀ: the structure K of (q, p) = Sy, for states y = (q, q̇).

    S = diag(I, M) with a constant mass matrix M, so p = M q̇. A field f for (q, p) becomes S⁻¹f(Sy)
    for (q, q̇). M is a hyperparameter: diagonal, or a full symmetric positive definite matrix
    M = L D Lᵀ with a unit lower triangle L. The first entry of M is 1, since scaling H and M
    together changes no motion; `field.hamiltonian(y)` is H in this unit.

    Let q̈ = −M⁻¹∇U(q). Every M for which M ∂q̈/∂q is symmetric at all q explains the motion. The
    ratio of two masses is therefore identified only if the motion of one depends on the other. A
    full matrix needs nonlinear forces: every M for which the modes are orthogonal explains a linear
    oscillation.

    If this kernel is the drift of `Controlled`, G contains accelerations, M⁻¹ times the forces. If
    M is full, a force on one coordinate accelerates several.

    Args:
        kernel: K, a matrix-valued kernel, such as `Symplectic(k)`.
        masses: the first guess of M, for m ≥ 2 degrees of freedom: shape (m,) for a diagonal M,
            (m, m) for a full symmetric positive definite M. The unit does not matter.
        labels: the number of the body of each position, counted from 0, shape (m,), such as
            (0, 0, 1, 1) for two particles in a plane. `masses` then has one mass for each of the b
            bodies, shape (b,), and M is diagonal. None: each position has a mass of its own.

    Raises:
        TypeError: K is not matrix-valued, or takes inputs or parameters.
        ValueError: a mass is not positive and finite; a matrix is not symmetric and positive
            definite; there is only one degree of freedom; or labels do not fit.

    Example: `hk.tune(hk.UnknownMasses(hk.Symplectic(k), [1.0, 1.0]), X, Y)`, or
    `hk.learn(hk.UnknownMasses(hk.Symplectic(k), np.eye(2)), runs)`.
    """

    kernel: AbstractMatrixKernel
    log_masses: Float[Array, " b-1"]  # log D_aa/D_11 for a ≥ 2, or of bodies
    coupling: Float[Array, " c"] | None  # the m(m − 1)/2 entries of L below its diagonal, by row
    labels: tuple[int, ...] | None = eqx.field(static=True)

    symplectic: ClassVar[bool] = False  # flows conserve dq ∧ dp, not dq ∧ dq̇

    def __init__(self, kernel: AbstractMatrixKernel, masses: ArrayLike, labels: Any = None):
        self.kernel = matrix_kernel(kernel, "the kernel of UnknownMasses", "Symplectic(k)")
        if self.kernel.takes_inputs:
            raise TypeError(
                "UnknownMasses takes no kernel with inputs: put it inside, "
                "Controlled(UnknownMasses(K, masses), …)."
            )
        guess = require.floating(masses, "masses")
        if guess.shape not in ((len(guess),) * k for k in (1, 2)) or len(guess) < 2:
            raise ValueError(
                f"masses has shape {guess.shape}; two or more masses, shape (m,), or a matrix "
                "(m, m), are needed. With one degree of freedom every mass explains the same "
                "motion, and is only a unit of the energy: leave UnknownMasses out."
            )
        self.coupling = None
        if guess.ndim == 2:
            guess, self.coupling = _factors(guess)
        else:
            guess = require.positive(guess, "masses", "Give one for each degree of freedom.")
        self.labels = None if labels is None else tuple(int(label) for label in labels)
        if labels is not None and (
            self.coupling is not None or set(self.labels or ()) != set(range(len(guess)))
        ):
            raise ValueError(
                f"labels={labels} and there are {len(guess)} masses: for a diagonal M give each "
                "position the number of its body, counted from 0."
            )
        self.log_masses = jnp.log(guess[1:] / guess[0])

    def __repr__(self) -> str:
        if not eqx.is_array(self.log_masses):
            return describe(self, positional=("kernel",))
        masses = text(self._ratios)
        if self.coupling is not None:
            masses = f"[{', '.join(map(text, self.masses))}]"
        labels = [] if self.labels is None else [f"labels={self.labels}"]
        return call("UnknownMasses", [text(self.kernel), f"masses={masses}", *labels])

    @property
    def masses(self) -> Float[Array, " m"] | Float[Array, "m m"]:
        """The masses divided by the first mass, shape (m,), or M divided by M₁₁, shape (m, m)."""
        D = self._diagonal
        if self.coupling is None:
            return D
        L = self._triangle(D.dtype)
        return jnp.einsum("ab,b,cb->ac", L, D, L)

    @property
    def _ratios(self) -> Float[Array, " b"]:
        """The masses of the bodies divided by the first of them."""
        return jnp.exp(jnp.pad(self.log_masses, (1, 0)))

    @property
    def _diagonal(self) -> Float[Array, " m"]:
        """The diagonal of D, whose first entry is 1."""
        D = self._ratios
        return D if self.labels is None else D[np.array(self.labels)]

    def _triangle(self, dtype: Any) -> Float[Array, "m m"]:
        """The unit lower triangle L."""
        m = len(self.log_masses) + 1  # a full M has no labels
        below = jnp.asarray(self.coupling, dtype)
        return jnp.eye(m, dtype=dtype).at[jnp.tril_indices(m, -1)].set(below)

    def to_momenta(self, y: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """The states S y = (q, M q̇), for one state or many."""
        q, v = jnp.split(y, 2, axis=-1)
        M = self.masses.astype(y.dtype)
        p = v * M.reshape((1,) * (v.ndim - 1) + M.shape) if M.ndim == 1 else v @ M
        return jnp.concatenate([q, p], axis=-1)

    def to_velocities(self, x: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """The states S⁻¹ x = S⁻ᵀ x = (q, M⁻¹ p), for one state or many."""
        q, p = jnp.split(x, 2, axis=-1)
        M = self.masses.astype(x.dtype)
        if M.ndim == 1:
            return jnp.concatenate([q, p / M.reshape((1,) * (p.ndim - 1) + M.shape)], axis=-1)
        L, one = self._triangle(M.dtype), jnp.eye(len(M), dtype=M.dtype)
        inverse = solve_triangular(L, one, lower=True, unit_diagonal=True)
        scaled = inverse / self._diagonal.astype(M.dtype)[:, None]
        return jnp.concatenate([q, p @ (inverse.T @ scaled)], axis=-1)  # M⁻¹ = L⁻ᵀ D⁻¹ L⁻¹

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        u, v = self.to_velocities(u), self.to_velocities(v)
        return self.kernel.form(self.to_momenta(x), u, self.to_momenta(z), v)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        x, Z, A = self.to_momenta(x), self.to_momenta(Z), self.to_velocities(A)
        return self.to_velocities(self.kernel.expansion(x, Z, A))

    def potential(self, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
        x, Z, A = self.to_momenta(x), self.to_momenta(Z), self.to_velocities(A)
        return self.kernel.potential(x, Z, A)

    def potential_covariance(self, x: Point, z: Point) -> Float[Array, ""]:
        return self.kernel.potential_covariance(self.to_momenta(x), self.to_momenta(z))

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        # ∂H/∂x = S⁻ᵀ ∂H/∂y
        return self.kernel.dissipated_power(self.to_momenta(x), self.to_velocities(slope))

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
        count = len(self.labels or ()) or len(self.log_masses) + 1
        if n != 2 * count:
            raise ValueError(
                f"states have {n} coordinates and there are {count} masses: states (q, q̇) of "
                f"{2 * count} coordinates are needed, or one mass for each degree of freedom."
            )
        self.kernel.check_dimension(n)

    def check_points(self, X: Float[Array, "N n"]) -> None:
        self.check_dimension(X.shape[1])
        self.kernel.check_points(self.to_momenta(X))

    def with_parity(self, parity: int) -> "UnknownMasses":
        return eqx.tree_at(lambda K: K.kernel, self, self.kernel.with_parity(parity))

    def average_over(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(
            "a symmetry belongs inside: give it to K, UnknownMasses(Invariant(K, maps), masses)."
        )

    def transform_inputs(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        return np.asarray(self.to_momenta(jnp.asarray(X)))

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """The scalar kernels, functions of (q, p)."""
        return self.kernel.scalar_kernels

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance  # S is linear


def _factors(M: Array) -> tuple[Float[Array, " m"], Float[Array, " c"]]:
    """The diagonal of D and the entries of L below its diagonal, with M = L D Lᵀ."""
    guess = np.asarray(M)
    if not np.isfinite(guess).all() or np.abs(guess - guess.T).max() > 1e-6 * np.abs(guess).max():
        raise ValueError(
            "masses is a matrix that is not symmetric or not finite: give a symmetric positive "
            "definite matrix (m, m), or one mass for each degree of freedom, shape (m,)."
        )
    try:
        C = np.linalg.cholesky(guess)
    except np.linalg.LinAlgError:
        lowest = np.linalg.eigvalsh(guess)[0]
        raise ValueError(
            f"masses, as a matrix, must be positive definite, as kinetic energy is; its lowest "
            f"eigenvalue is {lowest:.3g}."
        ) from None
    L = C / np.diag(C)[None]
    return jnp.asarray(np.diag(C) ** 2), jnp.asarray(L[np.tril_indices(len(L), -1)])
