"""The least squares of a Lagrangian: torques are linear in V, in the entries of M, in friction.

Rows B w = y + ε have independent errors of variance one, and w ~ N(0, I).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.lagrangian import LagrangianField, lagrangian_field
from hamkernel._machine import precise_jit
from hamkernel._solvers.triangle import append_rows, no_rows
from hamkernel._structures.friction import Friction
from hamkernel._structures.lagrangian import (
    Lagrangian,
    LagrangianFeatures,
    friction_of_joints,
    lagrangian_features,
)

# The error of a known entry of M, as a share of the entry.
_ANCHOR = 1e-4


class TorqueData(NamedTuple):
    """States (q, v) of shape (N, 2m), torques (N, m) and accelerations (N, m)."""

    states: Float[Array, "N n"]
    torques: Float[Array, "N m"]
    accelerations: Float[Array, "N m"]


def torque_data(K: Lagrangian, X: Any, torques: Any, accelerations: Any) -> TorqueData:
    """States, torques and accelerations, checked."""
    if accelerations is None or torques is None:
        raise TypeError(
            "a Lagrangian is learned from states (q, v), torques and accelerations, "
            "hk.fit(K, X, torques, 1e-6, accelerations=A), or from positions alone, "
            "hk.learn(K, hk.Runs(times, q, inputs=torques))."
        )
    X, torques = require.points(X, "X"), require.points(torques, "the torques")
    A = require.points(accelerations, "accelerations")
    N, m = torques.shape
    if X.shape != (N, 2 * m) or A.shape != (N, m):
        raise ValueError(
            f"X has shape {X.shape}, the torques {torques.shape} and accelerations {A.shape}: "
            "states (q, v) of shape (N, 2m), and torques and accelerations (N, m), are needed."
        )
    check_machine(K, torques, m)
    require.no_tracers("hk.fit of a Lagrangian", "Call it outside.", K, X, torques, A)
    X, torques = require.one_dtype(X, torques)
    X, A = require.one_dtype(X, A)
    X, torques = require.finite(X, "X"), require.finite(torques, "the torques")
    require.warn_of_float32(torques)
    return TorqueData(X, torques, require.finite(A, "accelerations"))


def check_machine(K: Lagrangian, torques: Any, m: int) -> None:
    """Raise unless K is of m positions, and there is a torque or a known entry of M."""
    for name in ("angles", "unknown_gains"):
        if max(getattr(K, name), default=0) >= m:
            raise ValueError(
                f"{name} are {getattr(K, name)} and there are {m} positions, counted from 0."
            )
    if K.known_mass_matrix is not None:
        if len(K.known_mass_matrix[0]) != m:
            raise ValueError(
                f"known_mass_matrix is of {len(K.known_mass_matrix[0])} positions and the data of "
                f"{m}."
            )
    elif not np.delete(np.asarray(torques), np.asarray(K.unknown_gains, int), axis=-1).any():
        which = "all torques" if not K.unknown_gains else "all torques of known gains"
        raise ValueError(
            f"{which} are zero: without a force the scale of L is not determined, and L = 0 "
            "fits everything. Add motions with a torque or a known load, or give a known entry of "
            "M, hk.Lagrangian(…, known_mass_matrix=(q, M)), with NaN for unknown entries."
        )


def fit_lagrangian(
    K: Lagrangian, X: Any, torques: Any, regularization: Any, accelerations: Any
) -> LagrangianField:
    """The field of a `Lagrangian` from states (q, v), torques and accelerations; see `fit`.

    A warning says if the mass matrix is not positive definite at the data by two deviations, or if
    friction of the joints is missing.
    """
    data = torque_data(K, X, torques, accelerations)
    deviation = jnp.sqrt(len(data.states) * require.ridge(regularization, data.torques.dtype))
    return field_of_torques(K, data, deviation)


def field_of_torques(
    K: Lagrangian, data: TorqueData, deviation: Float[Array, ""]
) -> LagrangianField:
    """The field from torques with errors of this standard deviation; see `fit_lagrangian`."""
    features = lagrangian_features(K, data.states)
    B, y = strong_rows(features, data, deviation)
    m = features.count
    R, weights = _anchored_solution(features, B, y)
    residual = deviation * (y - B @ weights).reshape(-1, m)
    noise = jnp.broadcast_to(deviation, (m,))
    field = lagrangian_field(features, weights, R, noise, residual, data.states)
    joints = ()
    if K.friction is None:
        columns = plain_friction(features, data.states[:, m:]).reshape(-1, 2 * m)
        joints = missing_friction(B, y, columns / deviation)
    said = verdicts(field, joints)
    if said:
        require.warn(" ".join(said))
    return field


def verdicts(field: LagrangianField, joints: tuple[int, ...]) -> list[str]:
    """Sentences about the faults of a learned machine, to be issued as a warning."""
    said = [field.refusal] if field.refusal else []
    if joints:
        said.append(
            f"the torques are much likelier with friction in joint {', '.join(map(str, joints))}: "
            "without it the mass matrix is wrong. Take hk.Lagrangian(…, friction=True)."
        )
    return said


@precise_jit
def strong_rows(
    features: LagrangianFeatures, data: TorqueData, deviation: Float[Array, ""]
) -> tuple[Float[Array, "R r"], Float[Array, " R"]]:
    """The rows of torques at known accelerations, over their standard deviation."""

    @jax.checkpoint
    def torque_rows(point):
        return features.torque_features(*point)

    rows = jax.lax.map(torque_rows, (data.states, data.accelerations), batch_size=64)
    rows, torques = features.with_gains(features.whiten(rows), data.torques)
    return rows.reshape(-1, features.columns) / deviation, torques.reshape(-1) / deviation


def known_entries(K: Lagrangian) -> Float[np.ndarray, "m m"]:
    """The known mass matrix, NaN where it is not known."""
    assert K.known_mass_matrix is not None
    return np.asarray(K.known_mass_matrix[1], float)  # None is NaN


def with_anchor(
    features: LagrangianFeatures, B: Float[Array, "R r"], y: Float[Array, " R"]
) -> tuple[Float[Array, "S r"], Float[Array, " S"]]:
    """The rows B, y with one more row for each known entry of the mass matrix."""
    known_matrix = features.kernel.known_mass_matrix
    if known_matrix is None:
        return B, y
    q, M = np.asarray(known_matrix[0]), known_entries(features.kernel)
    i, j = np.nonzero(np.triu(np.isfinite(M)))
    size = _ANCHOR * np.abs(M[i, j]).max()
    rows = features.whiten(features.mass_matrix_features(jnp.asarray(q, B.dtype))[i, j])
    values = jnp.asarray(M[i, j] / size, B.dtype)
    return jnp.concatenate([B, rows / size]), jnp.concatenate([y, values])


def ridge_solution(
    B: Float[Array, "R r"], y: Float[Array, " R"]
) -> tuple[Float[Array, "r r"], Float[Array, " r"]]:
    """R with RᵀR = BᵀB + I, and w = (RᵀR)⁻¹Bᵀy, by orthogonal triangularisation."""
    r = B.shape[1]
    F = append_rows(no_rows(r, B.dtype), B, y)
    return F[:r, :r], solve_triangular(F[:r, :r], F[:r, r])


_anchored_solution = precise_jit(lambda *rows: ridge_solution(*with_anchor(*rows)))


def missing_friction(
    B: Float[Array, "R r"], y: Float[Array, " R"], columns: Float[Array, "R k"]
) -> tuple[int, ...]:
    """The joints whose friction makes the torques much likelier; `columns` are v and tanh(v/ε).

    The size of the noise maximises the likelihood, both with and without friction. Otherwise a
    ridge that is too small, or a kernel that is too stiff, would look like friction.
    """
    unit = columns / jnp.maximum(jnp.linalg.norm(columns, axis=0), 1e-300)[None]
    unit = unit * jnp.linalg.norm(y)  # a priori friction may be as large as the torques
    gains = _friction_gains(B, y, unit)
    return tuple(int(i) for i in np.flatnonzero(np.asarray(gains) > _FRICTION_GAIN))


# The gain of log p for which friction is reported: 10 is the limit of "missing force" in `learn`.
# The squared residual must also fall by a twentieth, so that tiny misfits of exact data do not
# count.
_FRICTION_GAIN = 10.0


@precise_jit
def _friction_gains(B, y, columns) -> Float[Array, " m"]:
    def profile(B):
        R, w = ridge_solution(B, y)
        square = jnp.sum((y - B @ w) ** 2) + w @ w
        value = 0.5 * len(y) * jnp.log(square) + jnp.log(jnp.abs(jnp.diagonal(R))).sum()
        return value, square

    before, square = profile(B)
    m = columns.shape[1] // 2

    def gain(i):
        pair = columns[:, jnp.stack([i, m + i])]
        after, square_after = profile(jnp.concatenate([B, pair], axis=1))
        return jnp.where(square_after < 0.95 * square, before - after, 0.0)

    return jax.lax.map(gain, jnp.arange(m))


@precise_jit
def plain_friction(features: LagrangianFeatures, V: Float[Array, "N m"]) -> Float[Array, "N m k"]:
    """The columns v and tanh(v/ε) of each joint at the velocities V, k = 2m."""
    return jax.vmap(lambda v: friction_of_joints(Friction(1.0, 1.0), v, features.rest_speed))(V)
