"""The least squares of a Lagrangian: torques are linear in V, in the entries of M, in friction."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.lagrangian import LagrangianField, least_inertia
from hamkernel._machine import compiled
from hamkernel._structures.lagrangian import Lagrangian, lagrangian_features


def fit_lagrangian(
    K: Lagrangian, X: Any, torques: Any, regularization: Any, accelerations: Any
) -> LagrangianField:
    """The field of a `Lagrangian` from states (q, v), torques and accelerations; see `fit`.

    It warns where the mass matrix is not positive definite at the data by two deviations.
    """
    if accelerations is None or torques is None:
        raise TypeError(
            "a Lagrangian is learned from states (q, v), torques and accelerations: "
            "hk.fit(K, X, torques, 1e-6, accelerations=A)."
        )
    X, torques = require.points(X, "X"), require.points(torques, "the torques")
    A = require.points(accelerations, "accelerations")
    N, m = torques.shape
    if X.shape != (N, 2 * m) or A.shape != (N, m):
        raise ValueError(
            f"X has shape {X.shape}, the torques {torques.shape} and accelerations {A.shape}: "
            "states (q, v) of shape (N, 2m), and torques and accelerations (N, m), are needed."
        )
    if K.angles and max(K.angles) >= m:
        raise ValueError(f"angles are {K.angles} and there are {m} positions, counted from 0.")
    require.untraced("hk.fit of a Lagrangian", "Call it outside.", K, X, torques, A)
    X, torques = require.one_dtype(X, torques)
    X, A = require.one_dtype(X, A)
    X, torques = require.finite(X, "X"), require.finite(torques, "the torques")
    A = require.finite(A, "accelerations")
    if not np.asarray(torques).any():
        raise ValueError(
            "all torques are zero: without a force the scale of L is not determined, and L = 0 "
            "fits everything. Add motions with a torque or a known load."
        )
    require.warn_of_float32(torques)
    ridge = N * require.ridge(regularization, torques.dtype)
    features = lagrangian_features(K, X)
    R, weights, residual = _solved(features, X, A, torques, ridge)
    unknown = jnp.zeros((), weights.dtype)
    field = LagrangianField(features, weights, R, jnp.sqrt(ridge), residual, unknown, unknown)
    least, deviation = least_inertia(field, X)
    both = lambda f: (f.least_inertia, f.least_inertia_deviation)  # noqa: E731
    field = eqx.tree_at(both, field, (least, deviation))
    if not field.is_identified:
        require.warn(
            f"the mass matrix is not identified: its smallest eigenvalue at the data is "
            f"{float(least):.3g}, with a standard deviation of {float(deviation):.3g}. Motions "
            "along one path do not tell inertia from gravity and friction: add others, or "
            "hk.Lagrangian(…, friction=True) where joints have friction."
        )
    return field


@compiled
def _solved(features, X, A, torques, ridge: Float[Array, ""]) -> tuple[Array, Array, Array]:
    rows = jax.lax.map(lambda point: features.of_torques(*point), (X, A), batch_size=64)
    design, y = rows.reshape(-1, rows.shape[-1]), torques.reshape(-1)
    r = design.shape[1]
    above = jnp.sqrt(ridge) * jnp.eye(r, dtype=y.dtype)
    both = jnp.concatenate(
        [jnp.column_stack([above, jnp.zeros(r, y.dtype)]), jnp.column_stack([design, y])]
    )
    Q = jnp.linalg.qr(both, mode="r")
    R = Q[:r, :r]
    weights = solve_triangular(R, Q[:r, r])
    return R, weights, (y - design @ weights).reshape(torques.shape)
