"""What a solver is given: data that fits its kernel, less what was known of the field before."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._fields.base import at_points, potential_of
from hamkernel._fields.controlled import without_inputs
from hamkernel._fields.known import KnownPart, known_part
from hamkernel._observations.base import AbstractObservations
from hamkernel._observations.data import observations, points_and_velocities, rows_of_data
from hamkernel._observations.rows import Rows
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.controlled import Controlled


def checked_states(
    K: AbstractMatrixKernel,
    X: Any,
    Y: Any,
    regularization: ArrayLike,
    mean: Any = None,
    inputs: Any = None,
) -> tuple[AbstractMatrixKernel, Float[Array, "N d"], Float[Array, "N n"], Float[Array, ""], Any]:
    """Kernel, points, velocities less what is known of them, λ, and what is known."""
    K, X, Y = points_and_velocities(K, X, Y, inputs)
    K.check_points(X)
    regularization = require.ridge(regularization, X.dtype)
    known = known_part(K, mean, Y.shape[1], X.dtype)
    return K, X, Y if known is None else Y - at_points(known, X), regularization, known


def checked_rows(
    K: AbstractMatrixKernel,
    X: Any,
    Y: Any,
    regularization: ArrayLike,
    mean: Any = None,
    inputs: Any = None,
) -> tuple[AbstractMatrixKernel, Rows, Float[Array, ""], Any]:
    """Kernel, the rows of the data less what is known of them, λ, and what is known."""
    K, rows = rows_of_data(K, observations(X, Y, inputs))
    K.check_points(rows.points)
    if len(rows.energies) and K.no_potential:
        raise AttributeError(f"energies were given, and {K.no_potential}")
    require.warn_of_float32(rows.targets)
    regularization = require.ridge(regularization, rows.targets.dtype)
    known = known_part(K, mean, rows.dimension, rows.targets.dtype)
    return K, without_known(K, rows, known), regularization, known


def new_rows(K: AbstractMatrixKernel, data: AbstractObservations, old: Rows, known: Any) -> Rows:
    """The rows of data that is added to other rows, less what is known of them."""
    return without_known(K, rows_of_data(K, data, beside=old)[1], known)


def without_known(K: AbstractMatrixKernel, rows: Rows, known: Any) -> Rows:
    """The rows of f less what is known; AttributeError for energies if that has no potential."""
    if known is None:
        return rows
    potential = _known_potential(K, known) if len(rows.energies) else None

    def values(points):
        assert potential is not None
        return at_points(potential, points)

    return rows.less(rows.of(jax.tree_util.Partial(at_points, known), values))


def _known_potential(K: AbstractMatrixKernel, known: Any):
    """The potential of what is known, as a function of the points of K."""
    if not isinstance(known, KnownPart) or not isinstance(K, Controlled):
        return potential_of(known, K)
    drift = without_inputs(known, 0)
    if drift is None:  # G u, which is no part of the drift
        return lambda s: 0 * s[0]
    of_drift = potential_of(drift, K.drift)
    return lambda s: of_drift(s[: -known.count])
