"""Learned Lagrangian mechanics: a mass matrix, a potential, friction, and both dynamics."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._machine import EqualToItself, full_precision, precise_jit
from hamkernel._show import Shown, has_arrays, text
from hamkernel._structures.lagrangian import Lagrangian, LagrangianFeatures


class LagrangianField(Shown, EqualToItself, eqx.Module):
    """Learned Lagrangian mechanics, M(q) a + C(q, v) v + ∂V/∂q + friction(v) = τ.

    `fit` and `learn` return this field for a `Lagrangian` kernel. `field(x, u)` is ẋ = (v, a) for
    the state x = (q, v) and the torques u, so `hk.simulate(field, x0, ts, inputs=u)` simulates the
    machine. A call raises a RuntimeError if M(q) is not positive definite.

    The field contains its posterior: methods that end in `_deviation` return standard deviations.

    Attributes:
        features: the features of L and of friction, with the kernel.
        coefficients: the coefficients of the kernels at the centres, then of friction, shape (r,).
        triangle: R with RᵀR = BᵀB + I, where B are the feature rows of the torques divided by their
            noise, shape (r, r).
        noise: the standard deviation of the torque of each joint, shape (m,).
        residual: measured minus learned torques, shape (N, m); after `learn`, means over windows.
        least_inertia: the smallest eigenvalue λ of M, with standard deviation σ, at the state of
            the data with the smallest λ − 2σ, shape ().
        least_inertia_deviation: σ at this state, shape ().
        least_direction: the eigenvector of λ, shape (m,).
    """

    features: LagrangianFeatures
    coefficients: Float[Array, " r"]
    triangle: Float[Array, "r r"]
    noise: Float[Array, " m"]
    residual: Float[Array, "N m"]
    least_inertia: Float[Array, ""]
    least_inertia_deviation: Float[Array, ""]
    least_direction: Float[Array, " m"]

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [("kernel", text(self.kernel))]
        if has_arrays(self.noise) and require.is_concrete(self):
            least, deviation = text(self.least_inertia), text(self.least_inertia_deviation)
            rows.append(("torque noise", text(self.noise)))
            rows.append(("least inertia", f"{least} with a deviation of {deviation}"))
            if self.kernel.unknown_gains:
                rows.append(("gains", text(self.gains)))
        rows.append(("next", ".mass_matrix(q), .gravity(q), .inverse_dynamics(q, v, a)"))
        return f"LagrangianField of {self.features.count} joints", rows

    @property
    def kernel(self) -> Lagrangian:
        """The kernel of the fit."""
        return self.features.kernel

    @property
    def dimension(self) -> int:
        """The number n = 2m of coordinates of a state (q, v)."""
        return 2 * self.features.count

    @property
    def is_identified(self) -> bool:
        """Whether all eigenvalues of M exceed two standard deviations at all states of the data."""
        return bool(self.least_inertia > 2 * self.least_inertia_deviation)

    @property
    def refusal(self) -> str:
        """The reason why `hk.simulate` refuses this field; "" if M is identified."""
        if not require.is_concrete(self.least_inertia) or self.is_identified:
            return ""
        joint = int(np.argmax(np.abs(np.asarray(self.least_direction))))
        return (
            "the mass matrix is not identified: its smallest eigenvalue at the data is "
            f"{float(self.least_inertia):.3g}, with a standard deviation of "
            f"{float(self.least_inertia_deviation):.3g}, mostly of joint {joint}. Motions along "
            "one path do not tell inertia from gravity and friction: add other motions, or "
            "hk.Lagrangian(…, friction=True) if the joints have friction. A joint without a torque "
            "that is not coupled to the others needs a torque or an entry of known_mass_matrix."
        )

    @full_precision
    def __call__(self, x: Num[ArrayLike, " n"], u: ArrayLike | None = None) -> Float[Array, " n"]:
        """The velocity (v, a) of the state x under the torques u, zero if None, shape (n,).

        If gains are unknown, u are the logged inputs, and the torques are `gains` times u.

        Raises:
            ValueError: x or u has another shape.
            RuntimeError: M(q) is not positive definite.
        """
        velocity, is_positive = self._velocity(x, u)
        return require.value(
            velocity,
            ~is_positive,
            "the mass matrix is not positive definite at this state, so there is no acceleration: "
            "the data do not identify M there. Compare field.least_inertia with "
            "field.least_inertia_deviation. Add motions, friction=True, or a longer lengthscale.",
            RuntimeError,
        )

    def _velocity(self, x: ArrayLike, u: ArrayLike | None) -> tuple[Float[Array, " n"], Array]:
        """(v, a), and whether M(q) is positive definite, without which there is no a."""
        x = self._state(x)
        q, v = jnp.split(x, 2)
        torques = jnp.zeros_like(v) if u is None else self.gains * self._position(u, "u")
        M = self.mass_matrix(q)
        a = jnp.linalg.solve(M, torques - self.rest_torques(x))
        return jnp.concatenate([v, a]), jnp.linalg.eigvalsh(M)[0] > 0

    @property
    def gains(self) -> Float[Array, " m"]:
        """The ratio torque/input of each joint: learned for `unknown_gains`, else 1, shape (m,)."""
        return self._fill_joints(1.0, self.features.gain_features() @ self.coefficients)

    @property
    def gains_deviation(self) -> Float[Array, " m"]:
        """The standard deviation of each gain, 0 for known gains, shape (m,)."""
        return self._fill_joints(0.0, jnp.sqrt(self._variance(self.features.gain_features())))

    def _fill_joints(self, value: float, unknown: Float[Array, " g"]) -> Float[Array, " m"]:
        joints = np.asarray(self.kernel.unknown_gains, int)
        return jnp.full(self.features.count, value, unknown.dtype).at[joints].set(unknown)

    @full_precision
    def mass_matrix(self, q: Num[ArrayLike, " m"]) -> Float[Array, "m m"]:
        """The symmetric mass matrix M(q), shape (m, m)."""
        return self.features.mass_matrix_features(self._position(q)) @ self.coefficients

    @full_precision
    def mass_matrix_deviation(self, q: Num[ArrayLike, " m"]) -> Float[Array, "m m"]:
        """The standard deviation of each entry of M(q), shape (m, m)."""
        q = self._position(q)
        rows = self.features.mass_matrix_features(q)
        missing = self._missing(self.kernel.inertia, q, q)
        return jnp.sqrt(self._variance(rows) + missing * (2 + 2 * jnp.eye(len(q), dtype=q.dtype)))

    @full_precision
    def potential(self, q: Num[ArrayLike, " m"]) -> Float[Array, ""]:
        """The potential V(q), up to a constant, shape ()."""
        return self.features.potential_features(self._position(q)) @ self.coefficients

    @full_precision
    def gravity(self, q: Num[ArrayLike, " m"]) -> Float[Array, " m"]:
        """The torques ∂V/∂q that hold the machine at rest at q, shape (m,)."""
        return jax.grad(self.potential)(self._position(q))

    @full_precision
    def gravity_deviation(self, q: Num[ArrayLike, " m"]) -> Float[Array, " m"]:
        """The standard deviation of each entry of `gravity`, shape (m,)."""
        q, k = self._position(q), self.kernel.potential
        rows = jax.jacfwd(self.features.potential_features)(q).T
        mixed = jax.jacfwd(jax.jacrev(lambda a, b: self._missing(k, a, b)), argnums=1)(q, q)
        return jnp.sqrt(self._variance(rows) + jnp.maximum(jnp.diagonal(mixed), 0.0))

    @full_precision
    def energy_deviation(
        self, x: Num[ArrayLike, " n"], x0: Num[ArrayLike, " n"]
    ) -> Float[Array, ""]:
        """The standard deviation of H(x) − H(x₀), shape ()."""

        def row(x):
            q, v = jnp.split(self._state(x), 2)
            kinetic = jnp.einsum("i,j,ijr->r", v, v, self.features.mass_matrix_features(q)) / 2
            return kinetic + self.features.potential_features(q)

        # T and V are independent a priori, so T + V has the prior covariance of L = T − V.
        missing = self._missing_lagrangian
        here, there = self._state(x), self._state(x0)
        rest = missing(here, here) + missing(there, there) - 2 * missing(here, there)
        return jnp.sqrt(self._variance(row(x) - row(x0)) + jnp.maximum(rest, 0.0))

    @full_precision
    def torque_deviation(
        self, q: Num[ArrayLike, " m"], v: Num[ArrayLike, " m"], a: Num[ArrayLike, " m"]
    ) -> Float[Array, " m"]:
        """The standard deviation of each torque of `inverse_dynamics`, noise excluded, (m,)."""
        m, a = self.features.count, self._position(a, "a")
        x = jnp.concatenate([self._position(q), self._position(v, "v")])

        def torques(u):
            """D ∂u/∂v − ∂u/∂q, linear in u."""
            momentum = lambda x: jax.grad(lambda v: u(jnp.append(x[:m], v)))(x[m:])  # noqa: E731
            rate = jax.jvp(momentum, (x,), (jnp.append(x[m:], a),))[1]
            return rate - jax.grad(lambda q: u(jnp.append(q, x[m:])))(x[:m])

        def rest(e):
            missing = self._missing_lagrangian
            return e @ torques(lambda z: e @ torques(lambda x: missing(x, z)))

        rests = jax.vmap(rest)(jnp.eye(m, dtype=x.dtype))
        rows = self.features.torque_features(x, a)
        return jnp.sqrt(self._variance(rows) + jnp.maximum(rests, 0.0))

    @full_precision
    def friction(self, v: Num[ArrayLike, " m"]) -> Float[Array, " m"]:
        """The friction torques of the joints at the velocities v, shape (m,)."""
        return self.features.friction_features(self._position(v, "v")) @ self.coefficients

    @full_precision
    def momentum(self, x: Num[ArrayLike, " n"]) -> Float[Array, " m"]:
        """The momentum p = ∂L/∂v = M(q) v of the state x = (q, v), shape (m,)."""
        q, v = jnp.split(self._state(x), 2)
        return self.mass_matrix(q) @ v

    @full_precision
    def lagrangian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """L(q, v) = ½ vᵀM(q)v − V(q), shape ()."""
        q, v = jnp.split(self._state(x), 2)
        return 0.5 * v @ self.mass_matrix(q) @ v - self.potential(q)

    @full_precision
    def hamiltonian(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The energy ½ vᵀM(q)v + V(q) of the state x = (q, v), up to a constant, shape ()."""
        q, v = jnp.split(self._state(x), 2)
        return 0.5 * v @ self.mass_matrix(q) @ v + self.potential(q)

    @full_precision
    def inverse_dynamics(
        self, q: Num[ArrayLike, " m"], v: Num[ArrayLike, " m"], a: Num[ArrayLike, " m"]
    ) -> Float[Array, " m"]:
        """The torques τ = M(q) a + C(q, v) v + ∂V/∂q + friction(v), shape (m,).

        If gains are unknown, the inputs are these torques divided by `gains`.
        """
        x = jnp.concatenate([self._position(q), self._position(v, "v")])
        return self.features.torque_features(x, self._position(a, "a")) @ self.coefficients

    @full_precision
    def rest_torques(self, x: Num[ArrayLike, " n"]) -> Float[Array, " m"]:
        """The torques at which the state x = (q, v) has no acceleration, shape (m,)."""
        q, v = jnp.split(self._state(x), 2)
        return self.inverse_dynamics(q, v, jnp.zeros_like(v))

    @property
    def offset(self) -> Float[Array, ""]:
        """The constant of the potential: 0. Other fields have this attribute too."""
        return jnp.zeros_like(self.least_inertia)

    def _variance(self, rows: Float[Array, "*k r"]) -> Float[Array, "*k"]:
        """The posterior variance of linear forms of the kernels, in the span of the centres."""
        done = self.features.whiten(rows).reshape(-1, rows.shape[-1])
        whitened = solve_triangular(self.triangle, done.T, trans="T")
        return jnp.sum(whitened**2, axis=0).reshape(rows.shape[:-1])

    def _missing(self, k, q, q2) -> Float[Array, ""]:
        """The prior covariance k(q, q₂) outside the span of the centres."""
        root = self.features.roots[0 if k is self.kernel.potential else 1]
        whitened, whitened2 = (
            solve_triangular(root, self.features.kernel_values(k, at), lower=True) for at in (q, q2)
        )
        missing = k(self.kernel.embed(q), self.kernel.embed(q2)) - whitened @ whitened2
        return jnp.maximum(missing, 0.0) if q is q2 else missing

    def _missing_lagrangian(self, x: Array, z: Array) -> Float[Array, ""]:
        """The prior covariance of L at two states, outside the span of the centres."""
        (q, v), (q2, w) = jnp.split(x, 2), jnp.split(z, 2)
        K, missing = self.kernel, self._missing
        return missing(K.potential, q, q2) + (v @ w) ** 2 * missing(K.inertia, q, q2)

    def _state(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        return require.point(x, self.dimension).astype(self.coefficients.dtype)

    def _position(self, q: ArrayLike, name: str = "q") -> Float[Array, " m"]:
        return require.point(q, self.features.count, name).astype(self.coefficients.dtype)


class MachineOfPoints(eqx.Module):
    """A machine as a function of the points (x, u), NaN where M(q) is not positive definite."""

    machine: LagrangianField

    def __call__(self, s: Float[Array, " d"]) -> Float[Array, " n"]:
        n = self.machine.dimension
        velocity, is_positive = self.machine._velocity(s[:n], s[n:] if len(s) > n else None)
        return jnp.where(is_positive, velocity, jnp.nan)


def lagrangian_field(
    features: LagrangianFeatures,
    weights: Float[Array, " r"],
    triangle: Float[Array, "r r"],
    noise: Float[Array, " m"],
    residual: Float[Array, "N m"],
    X: Float[Array, "N n"],
) -> LagrangianField:
    """The field of the weights, with the smallest eigenvalue of M over the states X."""
    none = jnp.zeros((), weights.dtype), jnp.zeros((), weights.dtype), jnp.zeros_like(noise)
    coefficients = features.kernel_coefficients(weights)
    field = LagrangianField(features, coefficients, triangle, noise, residual, *none)
    least = lambda f: (f.least_inertia, f.least_inertia_deviation, f.least_direction)  # noqa: E731
    return eqx.tree_at(least, field, _least_inertia(field, X[:, : features.count]))


@precise_jit
def _least_inertia(field: LagrangianField, Q: Float[Array, "N m"]) -> tuple[Array, Array, Array]:
    def least_eigenvalue(q):
        values, vectors = jnp.linalg.eigh(field.mass_matrix(q))
        e = vectors[:, 0]
        row = jnp.einsum("i,j,ijr->r", e, e, field.features.mass_matrix_features(q))
        missing = 4 * field._missing(field.kernel.inertia, q, q)  # Var ½eᵀMe = k_M(q, q)
        return values[0], jnp.sqrt(field._variance(row) + missing), e

    # We take 64 positions at a time: with 400 features the arrays take 200 KB.
    value, deviation, e = jax.lax.map(least_eigenvalue, Q, batch_size=64)
    at = jnp.argmin(value - 2 * deviation)
    return value[at], deviation[at], e[at]
