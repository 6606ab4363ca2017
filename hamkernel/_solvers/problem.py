"""What is solved: rows of observations for a kernel, a ridge, and what was known before.

`fit`, `condition`, `tune` and every loss begin here, and nothing after it asks what was measured.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._fields.base import at_points, potential_of
from hamkernel._fields.joined import at_inputs
from hamkernel._fields.known import KnownPart, known_part
from hamkernel._machine import RowSharding, is_on_one_device, on_one_device, rows_of
from hamkernel._observations.kinds import AbstractObservations, beside
from hamkernel._observations.measurements import Measurements, measurements, measurements_of
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.joined import AbstractJoinedKernel


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """y = L f + ε for f ~ GP(known, kernel), y less the rows of what is known.

    Attributes:
        kernel: K.
        rows: the observations less what is known of them, on automatic axes of a mesh of devices.
        regularization: λ, shape ().
        known: the mean at the points of the rows; None if it is zero.
        spread: how the rows of the states that were given are spread over devices; None if they
            are not.
    """

    kernel: AbstractMatrixKernel
    rows: Measurements
    regularization: Float[Array, ""]
    known: Any = None
    spread: RowSharding | None = dataclasses.field(metadata={"static": True}, default=None)

    @property
    def ridge(self) -> Float[Array, ""]:
        """Nλ, the variance of a row of relative noise 1."""
        return self.rows.count * self.regularization

    @property
    def states(self) -> tuple[Float[Array, "N d"], Float[Array, "N n"]] | None:
        """Points and velocities, where these are all the rows: they can be seen tile by tile."""
        return self.rows.states

    def on_one_device(self) -> Problem:
        """The same with the rows on one device."""
        if all(is_on_one_device(array) for array in jax.tree.leaves(self.rows)):
            return self
        move = jax.tree.map(lambda array: on_one_device("the data", array), self.rows)
        return dataclasses.replace(self, rows=move)


def problem(
    K: Any,
    X: Any,
    Y: Any,
    regularization: ArrayLike,
    mean: Any = None,
    inputs: Any = None,
    parameters: Any = None,
) -> Problem:
    """The problem of the data, checked; X and Y are `Velocities(X, Y)`.

    Raises:
        TypeError, ValueError: as `fit` says. AttributeError: energies without a potential.
    """
    spread = rows_of(X) if isinstance(X, jax.Array) else None
    K, rows = measurements(matrix_kernel(K), X, Y, beside(inputs, parameters, K))
    K.check_points(rows.points)
    if len(rows.energies) and K.no_potential:
        raise AttributeError(f"energies were given, and {K.no_potential}")
    regularization = require.ridge(regularization, rows.targets.dtype)
    known = known_part(K, mean, rows.dimension, rows.targets.dtype)
    return Problem(K, without_known(K, rows, known), regularization, known, spread)


def new_rows(
    K: AbstractMatrixKernel, data: AbstractObservations, old: Measurements, known: Any
) -> Measurements:
    """The rows of data that is added to other rows, less what is known of them."""
    return without_known(K, measurements_of(K, data, previous=old)[1], known)


def without_known(K: AbstractMatrixKernel, rows: Measurements, known: Any) -> Measurements:
    """The rows of f less what is known; AttributeError for energies if that has no potential."""
    if known is None:
        return rows
    potential = _known_potential(K, known) if len(rows.energies) else known
    field, potential = (jax.tree_util.Partial(at_points, each) for each in (known, potential))
    return rows.subtract(rows.of(field, potential))


def _known_potential(K: AbstractMatrixKernel, known: Any):
    """The potential of what is known, as a function of the points of K."""
    if not isinstance(known, KnownPart) or not isinstance(K, AbstractJoinedKernel):
        return potential_of(known, K)
    drift = at_inputs(known, 0, None)
    if drift is None:  # G u, which is no part of the drift
        return lambda s: 0 * s[0]
    of_drift = potential_of(drift, K.of_states)
    return lambda s: of_drift(s[: -known.count])
