"""The problem that a solver is given, and the interface of solvers.

A `Problem` holds the rows of observations, a kernel, a ridge, and the known part of the field.
`fit`, `condition`, `tune` and every loss make one first; later code does not ask which kinds of
observations there were. A solver returns a field, or an `AbstractConditional`, the Gaussian process
conditioned on the rows.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField, KnownPart, known_part, map_states, potential_of
from hamkernel._fields.joined import fix_inputs
from hamkernel._machine import RowSharding, is_on_one_device, row_sharding, to_one_device
from hamkernel._observations.blocks import AbstractBlock
from hamkernel._observations.kinds import AbstractObservations, inputs_or_parameters
from hamkernel._observations.measurements import Measurements, measurements, measurements_of
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.completed import complete
from hamkernel._structures.joined import AbstractJoinedKernel


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """y = L f + ε for f ~ GP(known, kernel); the rows of the known part are subtracted from y.

    Attributes:
        kernel: K.
        rows: the observations minus the known part, on automatic axes of a mesh of devices.
        regularization: λ, shape ().
        known: the mean at the points of the rows; None if it is zero.
        spread: the sharding of the caller's X; None if X lies on one device.
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

    def to_one_device(self) -> Problem:
        """This problem with all rows on one device; ValueError if several processes hold them."""
        if all(is_on_one_device(array) for array in jax.tree.leaves(self.rows)):
            return self
        move = jax.tree.map(lambda array: to_one_device("the data", array), self.rows)
        return dataclasses.replace(self, rows=move)


def make_problem(
    K: Any,
    X: Any,
    Y: Any,
    regularization: ArrayLike,
    mean: Any = None,
    inputs: Any = None,
    parameters: Any = None,
    throw: bool = True,
) -> Problem:
    """The regularised least-squares problem of checked data; X and Y mean `Velocities(X, Y)`.

    Raises:
        TypeError, ValueError: as in `fit`. Only with `throw`, ValueError for a mean that is not
            finite at the data, or data whose squares overflow. AttributeError: there are energies
            and K has no potential.
    """
    spread = row_sharding(X) if isinstance(X, jax.Array) else None
    K, rows = measurements(matrix_kernel(K), X, Y, inputs_or_parameters(inputs, parameters, K))
    K.check_points(rows.points)
    K = complete(K, rows.points, rows.dimension)
    if len(rows.energies) and K.no_potential:
        raise AttributeError(f"energies were given, and {K.no_potential}")
    regularization = require.ridge(regularization, rows.targets.dtype)
    known_field = known_part(K, mean, rows.dimension, rows.targets.dtype)
    remaining = subtract_known(K, rows, known_field, throw)
    if throw:
        _refuse_overflow(remaining, regularization)
    return Problem(K, remaining, regularization, known_field, spread)


def _refuse_overflow(rows: Measurements, regularization: Float[Array, ""]) -> None:
    """ValueError where ‖y‖² or ‖f‖² ≤ ‖y‖²/(Nλ) is larger than the dtype can hold."""
    if not require.is_concrete(rows.targets, regularization):
        return
    y = require.host_array(rows.targets)
    size, limit = float(abs(y).max()), float(jnp.finfo(y.dtype).max)
    smallest = min(1.0, rows.count * float(regularization))
    if size > (limit * smallest / len(y)) ** 0.5:
        raise ValueError(
            f"the data are as large as {size:.2g}, and their squares, or squares over N λ, "
            f"overflow in {y.dtype}, whose largest number is {limit:.2g}. Change the units, so "
            "that the data are of the order of 1."
        )


def new_rows(
    K: AbstractMatrixKernel, data: AbstractObservations, old: Measurements, known_field: Any
) -> Measurements:
    """The measurements of additional data, minus the measurements of the known part."""
    return subtract_known(K, measurements_of(K, data, previous=old)[1], known_field)


def subtract_known(
    K: AbstractMatrixKernel, rows: Measurements, known_field: Any, throw: bool = True
) -> Measurements:
    """The rows of observations minus the rows of the known part of the field.

    Raises:
        AttributeError: there are energies and the known part has no potential.
        ValueError: `throw`, and the known part is not finite at the data.
    """
    if known_field is None:
        return rows
    potential = _known_potential(K, known_field) if len(rows.energies) else known_field
    field, potential = (
        jax.tree_util.Partial(map_states, part) for part in (known_field, potential)
    )
    values = rows.evaluate(field, potential)
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
        f"mean is NaN or infinite at the data{where}. The kernel learns the data minus the mean, "
        "so mean must be finite there: look at its divisions, logarithms and roots, or leave "
        "these observations out."
    )


def _known_potential(K: AbstractMatrixKernel, known_field: Any):
    """The potential of the known part, as a function of the points of K."""
    if not isinstance(known_field, KnownPart) or not isinstance(K, AbstractJoinedKernel):
        return potential_of(known_field, K)
    drift = fix_inputs(known_field, 0, None)
    if drift is None:  # the known part is G u alone
        return lambda s: 0 * s[0]
    of_drift = potential_of(drift, K.state_kernel)
    return lambda s: of_drift(s[: -known_field.count])


Own = TypeVar("Own", bound="AbstractConditional")


class AbstractConditional(eqx.Module):
    """The Gaussian process f ~ GP(0, K) conditioned on rows of observations.

    Attributes:
        field: the conditional mean.
        rows: the observations.
        ridge: σ² = Nλ, the variance of the noise of a row, shape ().
    """

    field: AbstractField
    rows: Measurements
    ridge: Float[Array, ""]

    @abc.abstractmethod
    def covariance(self, left: AbstractBlock, right: AbstractBlock) -> Float[Array, "d e"]:
        """The covariance of the rows of two blocks, given the data."""

    @abc.abstractmethod
    def update(self: Own, new: Measurements) -> Own:
        """This process conditioned on new rows as well, with the same σ²."""

    @abc.abstractmethod
    def draws(self, key: Key[Array, ""], count: int, region: Float[Array, "2 n"]) -> AbstractField:
        """Draws of the conditioned process: a field whose leaves have a leading axis of `count`."""


LearnedField = TypeVar("LearnedField", bound=AbstractField, covariant=True)


class AbstractSolver(eqx.Module, Generic[LearnedField]):
    """A method that solves the regularised least squares of a `Problem`.

    A solver of your own implements `fit`, and `condition` if it keeps a factor:

        class Mine(AbstractSolver[KernelField]):
            def fit(self, problem, throw=True, progress=False):
                rows, ridge = problem.rows, problem.ridge
                ...  # (G + ridge I) c = rows.y
                return kernel_field(problem.kernel, rows.coefficients(c), …)
    """

    no_factor: ClassVar[str | None] = None  # why `condition` is not available; None if it is
    is_low_rank: ClassVar[bool] = False  # whether `tune` minimises the loss in `low_rank_basis`

    def low_rank_basis(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> Any:
        """The rule that makes the functions of a low-rank fit for each kernel; None if dense."""
        del K, rows, regularization
        return None

    @abc.abstractmethod
    def fit(self, problem: Problem, throw: bool = True, progress: bool = False) -> LearnedField:
        """The learned field, without the known part.

        Args:
            problem: kernel, rows, and λ.
            throw: whether a failed solve raises RuntimeError; otherwise the numbers of the field
                are NaN.
            progress: whether to show a progress bar.
        """

    def condition(
        self, problem: Problem, throw: bool = True, progress: bool = False
    ) -> AbstractConditional:
        """The process GP(0, K) conditioned on the rows, with its factor.

        Args are those of `fit`.

        Raises:
            TypeError: the solver keeps no factor.
        """
        raise TypeError(self.no_factor)


Field = TypeVar("Field", bound=AbstractField)


def check_field(
    field: Field,
    failed: Bool[ArrayLike, ""],
    message: str | Callable[[], str],
    throw: bool = True,
) -> Field:
    """The field; RuntimeError with `message`, or NaN without `throw`, if its solve `failed`."""
    if throw and require.is_concrete(failed):  # the field need not be taken apart
        return require.value(field, failed, message, RuntimeError)

    def learned_arrays(f: Any) -> list:
        return [getattr(f, name) for name in _LEARNED if getattr(f, name, None) is not None]

    values = require.value(learned_arrays(field), failed, message, RuntimeError, throw)
    return eqx.tree_at(learned_arrays, field, values)


_LEARNED = ("coefficients", "value_coefficients", "weights", "residual", "norm")


def check_solver(solver: Any) -> None:
    """TypeError unless `solver` is a solver or None."""
    if not (solver is None or isinstance(solver, AbstractSolver)):
        raise TypeError(f"solver must be an instance, for example hk.Cholesky(); got {solver!r}.")
