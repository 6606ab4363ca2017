"""The problem that a solver is given, and the interface of solvers.

A `Problem` holds the rows of observations, a kernel, a ridge, and the known part of the field.
`fit`, `condition`, `tune` and every loss begin here, and nothing after it asks which kinds of
observations there were. A solver returns a field, or an `AbstractConditional`, the Gaussian field
given the rows.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField, KnownPart, at_points, known_part, potential_of
from hamkernel._fields.joined import at_inputs
from hamkernel._machine import RowSharding, is_on_one_device, on_one_device, rows_of
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.kinds import AbstractObservations, inputs_or_parameters
from hamkernel._observations.measurements import Measurements, measurements, measurements_of
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.completed import completed
from hamkernel._structures.joined import AbstractJoinedKernel


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """y = L f + ε for f ~ GP(known, kernel); the rows of the known part are subtracted from y.

    Attributes:
        kernel: K.
        rows: the observations less the known part, on automatic axes of a mesh of devices.
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
        """Points and velocities if there are no other rows, which a solver can read in tiles."""
        return self.rows.states

    def on_one_device(self) -> Problem:
        """This problem with its rows on one device; ValueError if they are on several processes."""
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
    throw: bool = True,
) -> Problem:
    """The problem of the data, checked; X and Y are `Velocities(X, Y)`.

    Raises:
        TypeError, ValueError: as `fit` says. A mean that is not finite at the data, and data whose
            squares overflow, are refused only with `throw`. AttributeError: there are energies and
            K has no potential.
    """
    spread = rows_of(X) if isinstance(X, jax.Array) else None
    K, rows = measurements(matrix_kernel(K), X, Y, inputs_or_parameters(inputs, parameters, K))
    K.check_points(rows.points)
    K = completed(K, rows.points, rows.dimension)
    if len(rows.energies) and K.no_potential:
        raise AttributeError(f"energies were given, and {K.no_potential}")
    regularization = require.ridge(regularization, rows.targets.dtype)
    known = known_part(K, mean, rows.dimension, rows.targets.dtype)
    left = without_known(K, rows, known, throw)
    if throw:
        _refuse_overflow(left, regularization)
    return Problem(K, left, regularization, known, spread)


def _refuse_overflow(rows: Measurements, regularization: Float[Array, ""]) -> None:
    """ValueError where ‖y‖² or ‖f‖² ≤ ‖y‖²/(Nλ) is larger than the dtype can hold."""
    if not require.is_concrete(rows.targets, regularization):
        return
    y = require.on_host(rows.targets)
    size, limit = float(abs(y).max()), float(jnp.finfo(y.dtype).max)
    smallest = min(1.0, rows.count * float(regularization))
    if size > (limit * smallest / len(y)) ** 0.5:
        raise ValueError(
            f"the data are as large as {size:.2g}, and their squares, or these over N λ, overflow "
            f"in {y.dtype}, whose largest number is {limit:.2g}. Change the units, so that the "
            "data are of the order of 1."
        )


def new_rows(
    K: AbstractMatrixKernel, data: AbstractObservations, old: Measurements, known: Any
) -> Measurements:
    """The rows of new data that is added to other rows, less those of the known part."""
    return without_known(K, measurements_of(K, data, previous=old)[1], known)


def without_known(
    K: AbstractMatrixKernel, rows: Measurements, known: Any, throw: bool = True
) -> Measurements:
    """The rows of observations less those of the known part of the field.

    Raises:
        AttributeError: energies, and the known part has no potential. ValueError: the known part
            is not finite at the data, if it is to `throw`.
    """
    if known is None:
        return rows
    potential = _known_potential(K, known) if len(rows.energies) else known
    field, potential = (jax.tree_util.Partial(at_points, each) for each in (known, potential))
    values = rows.of(field, potential)
    if throw:
        bad = require.not_finite(values)
        values = require.value(values, bad, lambda: _not_finite(rows, bad))
    return rows.subtract(values)


def _not_finite(rows: Measurements, bad: Any) -> str:
    where = ""
    if isinstance(bad, np.ndarray) and require.is_concrete(rows):
        of = np.unique(rows.labels()[np.flatnonzero(bad)])
        where = f" of {len(of)} of the {rows.count} observations, the first of them number {of[0]}"
        local, block = int(of[0]), rows.blocks[0]
        if local < block.count == len(block.points):
            where += f" at x = {np.asarray(block.points[local])}"
    return (
        f"mean is NaN or infinite at the data{where}. The kernel learns what mean leaves of the "
        "data, so mean must be finite there: look at what it divides by, and at the logarithms and "
        "roots in it, or leave those observations out."
    )


def _known_potential(K: AbstractMatrixKernel, known: Any):
    """The potential of the known part, as a function of the points of K."""
    if not isinstance(known, KnownPart) or not isinstance(K, AbstractJoinedKernel):
        return potential_of(known, K)
    drift = at_inputs(known, 0, None)
    if drift is None:  # G u, which is no part of the drift
        return lambda s: 0 * s[0]
    of_drift = potential_of(drift, K.of_states)
    return lambda s: of_drift(s[: -known.count])


Own = TypeVar("Own", bound="AbstractConditional")


class AbstractConditional(eqx.Module):
    """A Gaussian field f ~ GP(0, K) given rows of observations.

    Attributes:
        field: the conditional mean.
        rows: the observations.
        ridge: σ² = Nλ, the variance of the noise of a row, shape ().
    """

    field: eqx.AbstractVar[AbstractField]
    rows: eqx.AbstractVar[Measurements]
    ridge: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """The covariance of the rows of two blocks, given the data."""

    @abc.abstractmethod
    def updated(self: Own, new: Measurements) -> Own:
        """The Gaussian field given the old rows and new ones, with the same σ²."""

    @abc.abstractmethod
    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        """Fields drawn given the data, every leaf with a leading axis of `count`."""


LearnedField = TypeVar("LearnedField", bound=AbstractField, covariant=True)


class AbstractSolver(eqx.Module, Generic[LearnedField]):
    """A method by which `fit` finds the field."""

    no_factor: ClassVar[str | None] = None  # the reason why `_given` is not available, if so
    is_low_rank: ClassVar[bool] = False  # whether `tune` minimises the loss of its `_basis`

    def _basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> Any:
        """The rule that gives each kernel the functions of its low-rank fit; None if dense."""
        del K, rows, regularization
        return None

    @abc.abstractmethod
    def _fitted(self, problem: Problem, throw: bool = True, progress: bool = False) -> LearnedField:
        """The field. If the solve fails and `throw` is False, its numbers are NaN."""

    def _given(
        self, problem: Problem, throw: bool = True, progress: bool = False
    ) -> AbstractConditional:
        """The Gaussian field given the rows; TypeError if the solver keeps no factor."""
        raise TypeError(self.no_factor)
