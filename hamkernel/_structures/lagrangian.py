"""`Lagrangian`: the Gaussian process of a Lagrangian with an unknown mass matrix."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Scaled, as_scalar_kernel
from hamkernel._kernels.parts import far_apart, root_at
from hamkernel._machine import precise_jit
from hamkernel._show import call
from hamkernel._structures.base import nodes_of
from hamkernel._structures.friction import Friction

_CENTRES = 64  # positions whose kernels span V and each entry of M


class Lagrangian(eqx.Module):
    """Machines with an unknown mass matrix: L = ½ vᵀM(q)v − V(q), with V and M learned.

        K = hk.Lagrangian(potential=hk.Gaussian(1.5), inertia=hk.Gaussian(1.5), angles=(0, 1))
        learned = hk.learn(K, hk.Runs(times, q, inputs=torques))
        field = hk.fit(K, X, torques, 1e-6, accelerations=A)  # X = (q, v), where q̈ is known
        field.mass_matrix(q), field.gravity(q), field.inverse_dynamics(q, v, a)

    The Euler-Lagrange equation τ = d/dt ∂L/∂v − ∂L/∂q + friction(v) is linear in L. Torques are
    therefore linear functionals of L ~ GP(0, k_V(q, q′) + k_M(q, q′) (v·v′)²), and one
    least-squares solve finds V, M and the friction together. V and M lie in the span of kernels at
    64 positions of the data. A joint without a motor has zero torque.

    Torques determine V up to a constant. If all torques are zero, L = 0 fits, so `fit` and `learn`
    need a known entry of M. If a joint has no torque and is not coupled to the others, its inertia
    stays near zero, and `hk.simulate` refuses the field. If the joints have friction, pass
    `friction=True`: otherwise M is wrong.

    If inputs uᵢ are currents or voltages and not torques, name their joints in `unknown_gains`. The
    torque is then gᵢ uᵢ, and the fit finds gᵢ together with L. The data determine the gains and the
    scale of L if one joint has a known gain, or if an entry of M is known.

        K = hk.Lagrangian(k, k, unknown_gains=(0, 1), known_mass_matrix=(q, M))
        learned = hk.learn(K, hk.Runs(times, q, inputs=currents))
        learned.field.gains, learned.field.gains_deviation

    Args:
        potential: the kernel k_V of V, on positions. `Lagrangian` adds an amplitude if there is
            none.
        inertia: the kernel k_M of the entries of ½M, on positions. A kernel without an amplitude
            gets one. For links on revolute joints add `1.0 * hk.Polynomial(1)`, whose entries are
            a + b cos q + c sin q: M of an arm was wrong by .19 % instead of .29 % (two runs).
        angles: the coordinates that are angles; the kernels take (cos q, sin q) for them.
        friction: whether joints have friction d v + c tanh(v/ε), with unknown d and c for each
            joint. A `Friction` gives the prior standard deviations `viscous` of d and `coulomb` of
            c; True means `Friction(1.0, 1.0)`. `Friction(1.0, 1.0, stribeck=1.0)` adds the term
            s exp(−(v/w)²) tanh(v/ε), with an unknown s for each joint; `tune` and `learn` find w.
        known_mass_matrix: a pair (q, M) of one position, shape (m,), and the mass matrix M(q),
            shape (m, m), with NaN for unknown entries. One known entry, from a known load or a
            weighed link, fixes the scale of L.
        unknown_gains: the joints whose inputs are proportional to their torques.

    Raises:
        TypeError: a kernel is no scalar kernel.
        ValueError: `angles` or `unknown_gains` are no coordinates; `known_mass_matrix` has other
            shapes, or no known nonzero entry; or the friction has `damped` coordinates.
    """

    potential: AbstractScalarKernel
    inertia: AbstractScalarKernel
    angles: tuple[int, ...] = eqx.field(static=True)
    friction: Friction | None
    known_mass_matrix: tuple[tuple[float, ...], tuple[tuple[float | None, ...], ...]] | None = (
        eqx.field(static=True)
    )
    unknown_gains: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        potential: Any,
        inertia: Any,
        angles: Any = (),
        friction: Friction | bool = False,
        known_mass_matrix: tuple[Any, Any] | None = None,
        unknown_gains: Any = (),
    ):
        self.potential, self.inertia = map(_with_amplitude, (potential, inertia))
        self.angles = require.coordinates(angles, "angles") if np.size(angles) else ()
        joints = unknown_gains
        self.unknown_gains = require.coordinates(joints, "unknown_gains") if np.size(joints) else ()
        self.friction = Friction(1.0, 1.0) if friction is True else (friction or None)
        if self.friction is not None and self.friction.damped is not None:
            raise ValueError(
                "the friction of a Lagrangian is one of all joints, each with its own numbers: "
                "leave out damped=. A joint without friction gets numbers near zero."
            )
        self.known_mass_matrix = None if known_mass_matrix is None else _known(known_mass_matrix)

    def __repr__(self) -> str:
        said = [f"potential={self.potential!r}", f"inertia={self.inertia!r}"]
        said += [f"angles={self.angles}"] if self.angles else []
        said += [f"friction={self.friction!r}"] if self.friction else []
        said += ["known_mass_matrix=…"] if self.known_mass_matrix else []
        said += [f"unknown_gains={self.unknown_gains}"] if self.unknown_gains else []
        return call("Lagrangian", said)

    def embed(self, q: Float[Array, " m"]) -> Float[Array, " d"]:
        """The arguments of the kernels: (cos q, sin q) for angles, q for other coordinates."""
        parts = [
            jnp.stack([jnp.cos(q[i]), jnp.sin(q[i])]) if i in self.angles else q[i : i + 1]
            for i in range(len(q))
        ]
        return jnp.concatenate(parts)


def _with_amplitude(k: Any) -> AbstractScalarKernel:
    k = as_scalar_kernel(k)
    return k if nodes_of(Scaled, k) else 1.0 * k


def _known(pair: Any) -> tuple[tuple[float, ...], tuple[tuple[float | None, ...], ...]]:
    """The checked position, and the symmetric mass matrix with None for unknown entries."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError("known_mass_matrix must be a pair (q, M) of a position and M there.")
    q = require.doubles(pair[0], "the position of known_mass_matrix")
    M = require.doubles(pair[1], "known_mass_matrix")
    if q.ndim != 1 or M.shape != (len(q), len(q)):
        raise ValueError(
            f"known_mass_matrix has a position of shape {q.shape} and a matrix of shape {M.shape}; "
            "(m,) and (m, m) are needed, with NaN for entries that are not known."
        )
    M = np.where(np.isnan(M), M.T, M)
    entries = M[np.isfinite(M)]
    if not (np.isfinite(q).all() and entries.size and np.any(entries != 0)):
        raise ValueError(
            "known_mass_matrix must have a finite position and at least one known entry that is "
            "not zero."
        )
    rows = (tuple(None if np.isnan(x) else x for x in row) for row in M.tolist())
    return tuple(q.tolist()), tuple(rows)


# The prior standard deviation of a gain, in torque per input. If 1e4 rows have a noise of a tenth
# of the torques, this prior changes a gain of 1 by 1e-18.
_GAIN = 1e6


class LagrangianFeatures(eqx.Module):
    """The features Φ of L, of friction and of gains, with L = Φ(x)·w and w ~ N(0, I).

    Let R be the Cholesky factor of a Gram, R Rᵀ = k(C, C). V contributes the features
    −R⁻¹k_V(C, q) to L. Mᵢⱼ contributes R⁻¹k_M(C, q) times vᵢ² or √2 vᵢvⱼ, i < j, since
    (v·v′)² = Σᵢ vᵢ²v′ᵢ² + Σ_{i<j} (√2 vᵢvⱼ)(√2 v′ᵢv′ⱼ). Rows "in kernels" are rows without R⁻¹. We
    differentiate and integrate such rows, and then multiply by R⁻¹ in `whiten`.

    Attributes:
        kernel: the Lagrangian kernel.
        centres: C, the embedded positions whose kernels span V and M, shape (c, d).
        roots: the factors R of k_V and k_M at the centres, each of shape (c, c).
        rest_speed: ε of dry friction, shape ().
        count: the number m of joints.
    """

    kernel: Lagrangian
    centres: Float[Array, "c d"]
    roots: tuple[Float[Array, "c c"], Float[Array, "c c"]]
    rest_speed: Float[Array, ""]
    count: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        """The number r of features: of the centres, then of friction, then of gains."""
        m = self.count
        return len(self.centres) * (1 + m * (m + 1) // 2) + self.global_columns

    @property
    def global_columns(self) -> int:
        """The number of features of friction and of gains, which have no centres."""
        friction = self.kernel.friction
        terms = 0 if friction is None else 2 + (friction.stribeck is not None)
        return terms * self.count + len(self.kernel.unknown_gains)

    def with_kernel(self, kernel: Lagrangian) -> "LagrangianFeatures":
        """The features of another kernel on the same centres."""
        C = self.centres
        roots = root_at(kernel.potential, C), root_at(kernel.inertia, C)
        return LagrangianFeatures(kernel, C, roots, self.rest_speed, self.count)

    def kernel_values(self, k: AbstractScalarKernel, q: Float[Array, " m"]) -> Float[Array, " c"]:
        """The values k(C, q) of a kernel at the centres."""
        return jax.vmap(k, (None, 0))(self.kernel.embed(q), self.centres)

    def whiten(self, rows: Float[Array, "*k r"]) -> Float[Array, "*k r"]:
        """The rows in features of rows in kernels: R⁻¹ times each block of centres."""
        c, shape = len(self.centres), rows.shape[:-1]
        rows = rows.reshape(-1, self.columns)
        last = self.columns - self.global_columns
        blocks = rows[:, :last].reshape(len(rows), -1, c)
        V = solve_triangular(self.roots[0], blocks[:, 0].T, lower=True).T
        M = solve_triangular(self.roots[1], blocks[:, 1:].reshape(-1, c).T, lower=True).T
        done = jnp.concatenate([V, M.reshape(len(rows), -1), rows[:, last:]], axis=1)
        return done.reshape(*shape, self.columns)

    def kernel_coefficients(self, weights: Float[Array, " r"]) -> Float[Array, " r"]:
        """The coefficients c with `whiten(rows) @ weights` = rows @ c."""
        return jax.linear_transpose(self.whiten, weights)(weights)[0]

    def features_at(self, x: Float[Array, " n"]) -> Float[Array, " r"]:
        """The row of L(q, v), in kernels."""
        q, v = jnp.split(x, 2)
        i, j = np.triu_indices(self.count)
        squares = v[i] * v[j] * np.where(i == j, 1.0, np.sqrt(2.0))
        inertia = squares[:, None] * self.kernel_values(self.kernel.inertia, q)[None]
        V, none = -self.kernel_values(self.kernel.potential, q), jnp.zeros(self.global_columns)
        return jnp.concatenate([V, inertia.reshape(-1), none.astype(V.dtype)])

    def potential_features(self, q: Float[Array, " m"]) -> Float[Array, " r"]:
        """The row of V(q), in kernels."""
        phi = self.kernel_values(self.kernel.potential, q)
        return jnp.pad(phi, (0, self.columns - len(phi)))

    def mass_matrix_features(self, q: Float[Array, " m"]) -> Float[Array, "m m r"]:
        """The rows of M(q) = ∂²L/∂v², in kernels."""
        m, c = self.count, len(self.centres)
        i, j = np.triu_indices(m)
        phi = self.kernel_values(self.kernel.inertia, q)
        shares = np.zeros((m, m, len(i)))
        shares[i, j, np.arange(len(i))] = shares[j, i, np.arange(len(i))] = np.where(
            i == j, 2.0, np.sqrt(2.0)
        )
        rows = jnp.einsum("ijp,c->ijpc", jnp.asarray(shares, phi.dtype), phi).reshape(m, m, -1)
        return jnp.pad(rows, ((0, 0), (0, 0), (c, self.global_columns)))

    def friction_features(self, v: Float[Array, " m"]) -> Float[Array, "m r"]:
        """The row of the friction of each joint, in kernels."""
        if self.kernel.friction is None:
            return jnp.zeros((self.count, self.columns), v.dtype)
        terms = friction_of_joints(self.kernel.friction, v, self.rest_speed)
        before = self.columns - self.global_columns
        return jnp.pad(terms, ((0, 0), (before, len(self.kernel.unknown_gains))))

    def with_gains(
        self, rows: Float[Array, "*k m r"], inputs: Float[Array, "*k m"]
    ) -> tuple[Float[Array, "*k m r"], Float[Array, "*k m"]]:
        """The rows and their torques. With an unknown gain g we move g u to the rows: torque 0."""
        joints = np.asarray(self.kernel.unknown_gains, int)
        columns = self.columns - len(joints) + np.arange(len(joints))
        rows = rows.at[..., joints, columns].set(-_GAIN * inputs[..., joints])
        return rows, inputs.at[..., joints].set(0.0)

    def gain_features(self) -> Float[Array, "g r"]:
        """The rows of the unknown gains, in kernels."""
        g = len(self.kernel.unknown_gains)
        return _GAIN * jnp.eye(g, self.columns, k=self.columns - g, dtype=self.centres.dtype)

    def motion_features(
        self, x: Float[Array, " n"]
    ) -> tuple[Float[Array, "m r"], Float[Array, "m r"]]:
        """The rows of p = ∂L/∂v and b = friction − ∂L/∂q in ṗ + b = τ, in kernels."""
        m = self.count
        slopes = jax.jacfwd(self.features_at)(x).T
        return slopes[m:], self.friction_features(x[m:]) - slopes[:m]

    def torque_features(self, x: Float[Array, " n"], a: Float[Array, " m"]) -> Float[Array, "m r"]:
        """The rows of τ = D_(v,a) ∂L/∂v − ∂L/∂q + friction, in kernels."""
        momentum = lambda x: self.motion_features(x)[0]  # noqa: E731
        rate = jax.jvp(momentum, (x,), (jnp.concatenate([x[self.count :], a]),))[1]
        return rate + self.motion_features(x)[1]


def friction_of_joints(
    friction: Friction, v: Float[Array, " m"], rest_speed: Float[Array, ""]
) -> Float[Array, "m k"]:
    """The friction terms of each joint, times their prior standard deviations, k = 2m or 3m."""
    return jnp.concatenate([jnp.diag(term) for term in friction.terms(v, rest_speed)], axis=1)


def lagrangian_features(K: Lagrangian, X: Float[Array, "N n"]) -> LagrangianFeatures:
    """The features of K, with centres far apart among the positions of the states X."""
    m = X.shape[1] // 2
    embedded = np.asarray(_embed(K, X[:, :m]))
    unit = embedded / np.where(np.ptp(embedded, axis=0) > 0, np.ptp(embedded, axis=0), 1.0)
    rest_speed = None if K.friction is None else K.friction.rest_speed
    # The rest speed is a tenth of the root mean square velocity of the slowest joint.
    speed = (
        0.1 * jnp.sqrt(jnp.mean(X[:, m:] ** 2, axis=0)).min() if rest_speed is None else rest_speed
    )
    centres = jnp.asarray(embedded[far_apart(unit, _CENTRES)])
    none = jnp.zeros((0, 0), X.dtype)
    start = LagrangianFeatures(K, centres, (none, none), jnp.asarray(speed, X.dtype), m)
    return _with_kernel(start, K)


_with_kernel = precise_jit(lambda features, K: features.with_kernel(K))
_embed = precise_jit(lambda K, Q: jax.vmap(K.embed)(Q))
