"""What `tune` minimises: a validation loss of the dense or of the low-rank fit, or the caller's."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._observations.base import AbstractObservations
from hamkernel._observations.rows import Rows
from hamkernel._solvers.bases import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._validation.folds import Folds, Partition
from hamkernel._validation.losses import (
    cross_validation_loss,
    generalized_cross_validation,
    generalized_loss_and_square,
    log_likelihood,
    log_marginal_likelihood,
    partition_loss_and_square,
)
from hamkernel._validation.observed import (
    rows_generalized_loss_and_square,
    rows_log_likelihood,
    rows_partition,
    rows_partition_loss_and_square,
)

Objective = Callable[[AbstractMatrixKernel, Array, Array, Array], Float[Array, ""]]
Criterion = Literal["cross_validation", "generalized_cross_validation", "marginal_likelihood"]

# Share of the residuals that a fit must leave free, tr(I − S)/D, to be judged by generalised
# cross-validation: it is 0/0 where a fit interpolates, and can be very small there.
LEAST_FREE = 0.2


class SearchCriterion(eqx.Module):
    """The function to minimise, in units in which a change of 0.01 is one per cent of a loss.

    A loss is searched by its logarithm; a negative log density per half a row, which is the
    logarithm of a square too; and the caller's objective as it is.
    """

    fn: Any  # a function, or the `Partial` of one of ours
    partition: Partition | None = eqx.field(static=True)
    logarithmic: bool = eqx.field(static=True)
    own: bool = eqx.field(static=True)  # the caller's, which may need all the data

    def loss(self, K, X, Y, regularization) -> tuple[Float[Array, ""], Float[Array, ""] | None]:
        """The objective, as `tune` reports it, and ‖a‖² of the fit where there is a wall for it."""
        extra = () if self.partition is None else (self.partition,)
        with require.traceable("the objective"):
            value = self.fn(K, X, Y, regularization, *extra)
        value, square = value if self.logarithmic else (value, None)
        value = require.floating(value, "the value of the objective")
        if jnp.shape(value) != ():
            raise ValueError(
                f"the objective returned shape {jnp.shape(value)}; one number, shape (), is needed."
            )
        return value, square

    def searched(self, loss, square, Y, size) -> Float[Array, ""]:
        """What the search minimises: the loss in its units, and the wall.

        The wall keeps away from fields that rounding makes rough where the loss is still right.
        f(x) = Σ K(x, xⱼ) aⱼ rounds by up to ε tr(G) ‖a‖, of which an adaptive step, or the
        iteration of an implicit one, sees 1e-2. It is to stay a share √ε of the velocities:
        ‖a‖ tr(G) √ε ≤ ‖y‖. Beyond the wall the square of the logarithm of what is too much is
        added: of 18 fields, for polynomial and trigonometric H with noise of 0, 1 and 10 %, all can
        then be integrated (`tests/benchmarks/tuned_fields.py`). The likelihood has no need of one:
        its Nλ is the variance of y − f = Nλ a. Of an objective of the caller's nothing is known.

        Args:
            loss: the value of `loss`, shape ().
            square: ‖a‖², shape ().
            Y: velocities.
            size: tr(G) of all points; None where the caller has said what λ may be.
        """
        value = loss
        if self.logarithmic:
            tiny = jnp.finfo(loss.dtype).tiny
            value = jnp.log(jnp.maximum(loss, tiny))
            if size is not None:
                relative = jnp.maximum(square, tiny) / jnp.maximum(jnp.sum(Y**2), tiny)
                eps = jnp.log(jnp.finfo(loss.dtype).eps).astype(loss.dtype)
                beyond = (jnp.log(relative) + eps) / 2 + jnp.log(size)
                value = value + jnp.maximum(beyond, 0) ** 2
        elif not self.own:
            value = value * (2 / Y.size)
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    def with_basis(self, basis: AbstractBasis) -> "SearchCriterion":
        """The same criterion of the low-rank fit in this basis."""
        # A Partial of a Partial would be another function, to be compiled, for each call of `tune`.
        fn = jax.tree_util.Partial(self.fn.func, **self.fn.keywords, basis=basis)
        return dataclasses.replace(self, fn=fn)

    def on(self, rows: np.ndarray) -> "SearchCriterion":
        """The same criterion for a subset of the points."""
        if self.partition is None:
            return self
        partition = Partition(len(rows), self.partition.labels[rows])
        return dataclasses.replace(self, partition=partition)


def criterion_of(objective: Criterion | Objective, N: int, folds: Folds) -> SearchCriterion:
    """What the objective of `tune` means for N points.

    A public loss is what its name is: it takes the folds and is searched by its logarithm.
    """
    partial = jax.tree_util.Partial
    if objective == "cross_validation" or objective is cross_validation_loss:
        partition = Partition(N, folds)
        return SearchCriterion(
            partial(partition_loss_and_square), partition, logarithmic=True, own=False
        )
    if objective == "generalized_cross_validation" or objective is generalized_cross_validation:
        fn = partial(generalized_loss_and_square, least_free=LEAST_FREE)
        return SearchCriterion(fn, None, logarithmic=True, own=False)
    if objective == "marginal_likelihood":
        fn = partial(_negative_log_likelihood)
        return SearchCriterion(fn, None, logarithmic=False, own=False)
    if objective is log_marginal_likelihood:
        raise TypeError(
            "log_marginal_likelihood is to be large and an objective is to be small: pass "
            "objective='marginal_likelihood'."
        )
    if not callable(objective):
        raise ValueError(
            "objective must be 'cross_validation', 'generalized_cross_validation', "
            "'marginal_likelihood' or a function (K, X, Y, regularization) -> (); "
            f"got {objective!r}."
        )
    other = require.other_arguments(objective, "K", "X", "Y", "regularization")
    if other is not None:
        raise TypeError(
            "an objective is called with (K, X, Y, regularization), by position, and returns one "
            f"number; this one takes ({other})."
        )
    return SearchCriterion(as_pytree(objective), None, logarithmic=False, own=True)


def criterion_of_rows(
    objective: Criterion | Objective, data: AbstractObservations, rows: Rows, folds: Folds
) -> SearchCriterion:
    """The same of observations, for all of them at once: what it is called with is not looked at.

    A function of the caller's is called with (K, data, None, regularization).
    """
    named = criterion_of(objective, rows.count, folds)
    if named.own:
        fn = jax.tree_util.Partial(_own_of_data, named.fn, data)
    elif named.partition is not None:
        fn = jax.tree_util.Partial(
            _partition_loss_of, rows, partition=_Kept(rows_partition(rows, folds))
        )
    elif named.logarithmic:
        fn = jax.tree_util.Partial(_generalized_loss_of, rows)
    else:
        fn = jax.tree_util.Partial(_negative_log_likelihood_of, rows)
    return SearchCriterion(fn, None, logarithmic=named.logarithmic, own=True)


class _Kept(eqx.Module):
    """A partition as a PyTree without leaves."""

    value: Partition = eqx.field(static=True)


def _own_of_data(fn, data, K, X, Y, regularization):
    return fn(K, data, None, regularization)


def _partition_loss_of(rows, K, X, Y, regularization, *, partition):
    return rows_partition_loss_and_square(K, rows, regularization, partition.value)


def _generalized_loss_of(rows, K, X, Y, regularization):
    return rows_generalized_loss_and_square(K, rows, regularization, LEAST_FREE)


def _negative_log_likelihood_of(rows, K, X, Y, regularization):
    return -rows_log_likelihood(K, rows, regularization)


def _negative_log_likelihood(K, X, Y, regularization, basis=None):
    return -log_likelihood(K, X, Y, regularization, basis)
