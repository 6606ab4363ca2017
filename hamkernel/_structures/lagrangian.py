"""`Lagrangian`: the Gaussian process of a Lagrangian whose mass matrix is not known."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, as_scalar_kernel
from hamkernel._show import call
from hamkernel._structures.friction import Friction

_CENTRES = 64  # positions that carry V and each entry of M


class Lagrangian(eqx.Module):
    """Machines with an unknown mass matrix: L = ½ vᵀM(q)v − V(q), with V and M learned.

        K = hk.Lagrangian(potential=100.0 * hk.Gaussian(1.5), inertia=10.0 * hk.Gaussian(1.5))
        field = hk.fit(K, X, torques, 1e-6, accelerations=A)  # X = (q, v)
        field.mass_matrix(q), field.gravity(q), field.inverse_dynamics(q, v, a)

    The equation of Euler and Lagrange, τ = d/dt ∂L/∂v − ∂L/∂q + friction(v), is linear in L, so
    torques are linear functionals of L ~ GP(0, k_V(q, q′) + k_M(q, q′) (v·v′)²) and one least
    squares finds V, M and the friction together. Both kernels are carried by 64 positions of the
    data.

    A constant in V is not determined. Without any torque the scale of L is not either, and L = 0
    would fit everything: such data are refused. Friction of the joints that is there and not asked
    for spoils M.

    Args:
        potential: the kernel k_V of V, on positions.
        inertia: the kernel k_M of the entries of ½M, on positions.
        angles: the coordinates that are angles, for which kernels see (cos, sin).
        friction: whether joints have friction d v + c tanh(v/ε) with unknown d and c, one pair
            each; its standard deviations are `viscous` and `coulomb` of a `Friction`. True is
            `Friction(1.0, 1.0)`.

    Raises:
        TypeError: a kernel is no scalar kernel. ValueError: `angles` are no coordinates.
    """

    potential: AbstractScalarKernel
    inertia: AbstractScalarKernel
    angles: tuple[int, ...] = eqx.field(static=True)
    friction: Friction | None

    def __init__(
        self, potential: Any, inertia: Any, angles: Any = (), friction: Friction | bool = False
    ):
        self.potential, self.inertia = as_scalar_kernel(potential), as_scalar_kernel(inertia)
        self.angles = require.coordinates(angles, "angles") if np.size(angles) else ()
        self.friction = Friction(1.0, 1.0) if friction is True else (friction or None)

    def __repr__(self) -> str:
        said = [f"potential={self.potential!r}", f"inertia={self.inertia!r}"]
        said += [f"angles={self.angles}"] if self.angles else []
        return call("Lagrangian", said + ([f"friction={self.friction!r}"] if self.friction else []))

    def placed(self, q: Float[Array, " m"]) -> Float[Array, " d"]:
        """The coordinates that the kernels see: (cos, sin) of angles, all others as they are."""
        parts = [
            jnp.stack([jnp.cos(q[i]), jnp.sin(q[i])]) if i in self.angles else q[i : i + 1]
            for i in range(len(q))
        ]
        return jnp.concatenate(parts)


class LagrangianFeatures(eqx.Module):
    """Features Φ of L and of friction, with L = Φ(x)·w and w ~ N(0, I).

    Those of V are −L⁻¹k_V(C, q). Those of Mᵢⱼ are L⁻¹k_M(C, q) times vᵢ² or √2 vᵢvⱼ, i < j, since
    (v·v′)² is the sum of their products.

    Attributes:
        kernel: the Lagrangian kernel.
        centres: what the kernels see of the positions that carry V and M, shape (c, d).
        rest_speed: ε of dry friction.
        count: m, the number of positions.
    """

    kernel: Lagrangian
    centres: Float[Array, "c d"]
    rest_speed: Float[Array, ""]
    count: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        """How many features there are, those of friction last."""
        m = self.count
        return len(self.centres) * (1 + m * (m + 1) // 2) + 2 * m * (
            self.kernel.friction is not None
        )

    def of_kernel(self, k: AbstractScalarKernel, q: Float[Array, " m"]) -> Float[Array, " c"]:
        """L⁻¹ k(C, q), L Lᵀ = k(C, C)."""
        C = self.centres
        G = jax.vmap(jax.vmap(k, (None, 0)), (0, None))(C, C)
        # A hundred times the rounding bounds how finely centres resolve, and biases nothing.
        rounding = 100 * jnp.finfo(G.dtype).eps * len(G) * jnp.diagonal(G).mean()
        L = jnp.linalg.cholesky(G + rounding * jnp.eye(len(G), dtype=G.dtype))
        return solve_triangular(L, jax.vmap(k, (None, 0))(self.kernel.placed(q), C), lower=True)

    def of_lagrangian(self, x: Float[Array, " n"]) -> Float[Array, " r"]:
        """Φ(q, v) without friction."""
        q, v = jnp.split(x, 2)
        i, j = np.triu_indices(self.count)
        squares = v[i] * v[j] * np.where(i == j, 1.0, np.sqrt(2.0))
        inertia = squares[:, None] * self.of_kernel(self.kernel.inertia, q)[None]
        return jnp.concatenate([-self.of_kernel(self.kernel.potential, q), inertia.reshape(-1)])

    def of_potential(self, q: Float[Array, " m"]) -> Float[Array, " r"]:
        """The features of V."""
        phi = self.of_kernel(self.kernel.potential, q)
        return jnp.pad(phi, (0, self.columns - len(phi)))

    def of_mass_matrix(self, q: Float[Array, " m"]) -> Float[Array, "m m r"]:
        """The features of M(q) = ∂²L/∂v²."""
        m, c = self.count, len(self.centres)
        i, j = np.triu_indices(m)
        phi = self.of_kernel(self.kernel.inertia, q)
        shares = np.zeros((m, m, len(i)))
        shares[i, j, np.arange(len(i))] = shares[j, i, np.arange(len(i))] = np.where(
            i == j, 2.0, np.sqrt(2.0)
        )
        found = jnp.einsum("ijp,c->ijpc", jnp.asarray(shares, phi.dtype), phi).reshape(m, m, -1)
        return jnp.pad(found, ((0, 0), (0, 0), (c, self.columns - c - found.shape[-1])))

    def of_friction(self, v: Float[Array, " m"]) -> Float[Array, "m r"]:
        """The features of the friction of each joint."""
        friction, m = self.kernel.friction, self.count
        if friction is None:
            return jnp.zeros((m, self.columns), v.dtype)
        slide = jnp.diag(jnp.broadcast_to(friction.viscous.astype(v.dtype), v.shape) * v)
        dry = jnp.broadcast_to(friction.coulomb.astype(v.dtype), v.shape)
        stick = jnp.diag(dry * jnp.tanh(v / self.rest_speed))
        both = jnp.concatenate([slide, stick], axis=1)
        return jnp.pad(both, ((0, 0), (self.columns - 2 * m, 0)))

    def of_torques(self, x: Float[Array, " n"], a: Float[Array, " m"]) -> Float[Array, "m r"]:
        """The features of τ = D_(v,a) ∂L/∂v − ∂L/∂q + friction."""
        m = self.count
        slopes = jax.jacfwd(self.of_lagrangian)
        here, along = jax.jvp(slopes, (x,), (jnp.concatenate([x[m:], a]),))
        torques = (along[:, m:] - here[:, :m]).T
        torques = jnp.pad(torques, ((0, 0), (0, self.columns - torques.shape[1])))
        return torques + self.of_friction(x[m:])


def lagrangian_features(K: Lagrangian, X: Float[Array, "N n"]) -> LagrangianFeatures:
    """The features of K with centres among the positions of the states X, far from one another."""
    m = X.shape[1] // 2
    placed = np.asarray(jax.vmap(K.placed)(X[:, :m]))
    unit = placed / np.where(np.ptp(placed, axis=0) > 0, np.ptp(placed, axis=0), 1.0)
    chosen, distance = [int(np.argmin(unit[:, 0]))], np.full(len(unit), np.inf)
    while len(chosen) < _CENTRES:
        distance = np.minimum(distance, np.linalg.norm(unit - unit[chosen[-1]], axis=1))
        if not distance.max() > 1e-6:
            break
        chosen.append(int(np.argmax(distance)))
    given = None if K.friction is None else K.friction.rest_speed
    # Dry friction changes its sign within a tenth of the speed of the slowest joint.
    rest = 0.1 * jnp.sqrt(jnp.mean(X[:, m:] ** 2, axis=0)).min() if given is None else given
    return LagrangianFeatures(K, jnp.asarray(placed[chosen]), jnp.asarray(rest, X.dtype), m)
